"""Table III of Wang et al., RA-L 2022: U, S and Z by cables of 0.1 to 3 times the usual stiffness, by every method.

python experiments/06_stiffness.py                    # one seed, three methods, one stiffness: some minutes
python experiments/06_stiffness.py --full             # all of it, hours on two cores; resumable
python experiments/06_stiffness.py --full --executor 2                     # in two processes
python experiments/06_stiffness.py --full --executor tcp://HOST:8786       # on a Dask cluster
python experiments/06_stiffness.py --full --report docs/results/stiffness.md    # the page, of what is done so far
"""

from __future__ import annotations

import functools
import os

os.environ.setdefault("NPROC", "4")

from closed_loop.cases import NEARBY, STIFFNESS_RATIOS, nearby_cases, stiffness_cases
from closed_loop.experiment import Experiment, Extent, main
from closed_loop.methods import LEARNER, METHODS, NO_PRIOR_LEARNER
from closed_loop.paper import DIRECT, RESIDUAL
from closed_loop.suite import PATIENCE

if __name__ == "__main__":
    main(
        Experiment(
            name="stiffness",
            script="06_stiffness.py",
            title="U, S and Z by cables of other stiffness",
            about=(
                "The plant is C MuJoCo in space with contact and friction cones, its cable of 24 links 0.1 to 3 times "
                "as stiff as the reference cable. Every trial starts from a straight cable whose heading, place and "
                "slack depend on the seed; a cell is the mean over stiffnesses and seeds. A run ends after 60 "
                f"commands, or after {PATIENCE} in which the error does not change. The settling time is the time "
                "after which the error stays near its last value: within a tenth of that value, or of the error's "
                "total change if that is smaller, or within 1 mm. Wang et al. do not define theirs."
            ),
            small=Extent(
                functools.partial(stiffness_cases, ("U", "S", "Z"), (2.0,)),
                seeds=range(1),
                methods=(DIRECT, RESIDUAL, LEARNER, NO_PRIOR_LEARNER),
            ),
            full=Extent(
                lambda seeds: stiffness_cases(("U", "S", "Z"), STIFFNESS_RATIOS, seeds) + nearby_cases(seeds),
                seeds=range(5),
                methods=tuple(METHODS),
            ),
            tables=("III", NEARBY),
        )
    )
