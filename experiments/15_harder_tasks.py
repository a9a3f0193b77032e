"""Targets that are recorded shapes of other cables, and runs that are disturbed in the middle: 100 of each.

python experiments/15_harder_tasks.py                    # six of each, one method: some minutes
python experiments/15_harder_tasks.py --full             # all of it; resumable, --executor shares the work
python experiments/15_harder_tasks.py --full --report docs/results/harder_tasks.md
python experiments/15_harder_tasks.py --full --seeds 0:12    # tasks to choose on; those of the table are kept apart
"""

from __future__ import annotations

import os

os.environ.setdefault("NPROC", "4")

from closed_loop.experiment import Experiment, Extent, main
from closed_loop.harder import DISTURBED, HELD_OUT, RECORDED, harder_cases
from closed_loop.methods import DRIVE, LEARNER, NO_PRIOR, NO_PRIOR_LEARNER
from closed_loop.paper import DIRECT

if __name__ == "__main__":
    main(
        Experiment(
            name="harder_tasks",
            script="15_harder_tasks.py",
            title="Shapes of other cables, and disturbances",
            about=(
                "The plant is C MuJoCo in space with contact and friction cones; commands of one second from a "
                "straight start. Keypoints only, 90 commands: the target is the shape in which another cable, of "
                "random stiffness, friction and bend at rest, was left by friction; the cable that is shaped is twice "
                "as stiff as the one trained on, and the best that it could do is the nearest shape in which it rests "
                "without friction, its grippers as far apart as the controller's bounds ask for, which the straight "
                "drive does not keep. Disturbed, 60 commands: U, S or Z, and after 29 s something happens, or the "
                "observation is poor all the time; the cable is half, once or twice as stiff. A run is judged by the "
                "mean error of its last ten seconds. Tasks: `experiments/closed_loop/harder.py`."
            ),
            small=Extent(harder_cases, seeds=range(6), methods=(NO_PRIOR_LEARNER,)),
            full=Extent(
                harder_cases,
                seeds=range(HELD_OUT, HELD_OUT + 100),
                methods=(DRIVE, DIRECT, LEARNER, NO_PRIOR, NO_PRIOR_LEARNER),
            ),
            tables=(RECORDED, DISTURBED),
        )
    )
