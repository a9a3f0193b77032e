"""The protocol of Liang et al. 2026: random targets from straight and from diverse starts, 50 each.

python experiments/08_random_targets.py                    # two of each, one method: some minutes
python experiments/08_random_targets.py --full             # all of it; resumable, --executor shares the work
python experiments/08_random_targets.py --full --report docs/results/random_targets.md
python experiments/08_random_targets.py --full --seeds 2000:2050  # held-out tasks
"""

from __future__ import annotations

import os

os.environ.setdefault("NPROC", "4")

from closed_loop.cases import random_cases
from closed_loop.experiment import Experiment, Extent, main
from closed_loop.methods import LEARNER, NO_PRIOR_LEARNER
from closed_loop.paper import DIRECT, RESIDUAL
from closed_loop.trials import LIANG_TABLE

if __name__ == "__main__":
    main(
        Experiment(
            name="random_targets",
            script="08_random_targets.py",
            title="Random targets from random starts",
            about=(
                "Planar shaping by two arms, 13 keypoints, at most 250 commands of one second; success is a root mean "
                "square error below 10 mm. `experiments/closed_loop/protocols.py` draws starts and targets, "
                "since Liang et al. publish no numerical ones; the cable is the MuJoCo plant's with contact and "
                "friction cones, twice as stiff as the reference cable; `gns-no-prior` was trained on cables of 0.05 "
                "to 3 times its stiffness. The published figures are on Liang et al.'s own tasks and simulator, for "
                "scale only."
            ),
            small=Extent(random_cases, seeds=range(2), methods=(NO_PRIOR_LEARNER,)),
            full=Extent(random_cases, seeds=range(50), methods=(DIRECT, RESIDUAL, LEARNER, NO_PRIOR_LEARNER)),
            tables=(LIANG_TABLE,),
        )
    )
