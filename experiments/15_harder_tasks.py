"""Targets that are recorded shapes of other cables, and runs that are disturbed in the middle: 100 of each.

python experiments/15_harder_tasks.py                    # six of each, one method: some minutes
python experiments/15_harder_tasks.py --full             # all of it; resumable, --executor shares the work
python experiments/15_harder_tasks.py --full --report docs/results/harder_tasks.md
python experiments/15_harder_tasks.py --full --seeds 0:12    # tasks for tuning; those of the table are held out
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
                "The plant is C MuJoCo in space with contact and friction cones. Every run starts from a straight "
                "cable and gets a command each second. For keypoints only (90 commands), the target is a shape in "
                "which friction left another cable, of random stiffness, friction and rest curvature. The shaped cable "
                "is twice as stiff as the reference cable. Its best possible result is the nearest frictionless "
                "resting shape that respects the controller's bounds on the grippers' distance; the straight drive "
                "does not respect them. In disturbed runs (60 commands; U, S or Z), something happens after 29 s, or "
                "the observation is poor throughout; the cable is half, once or twice as stiff as the reference cable. "
                "A run is judged by the mean error of its last ten seconds. `experiments/closed_loop/harder.py` makes "
                "the tasks."
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
