"""Tables IV and V of Wang et al., RA-L 2022: U and S by two cables of another simulator family, instead of real ones.

python experiments/07_other_simulator.py                   # one seed, one cable, two methods: some minutes
python experiments/07_other_simulator.py --full            # all of it; resumable, --executor shares the work
python experiments/07_other_simulator.py --full --report docs/results/other_simulator.md
"""

from __future__ import annotations

import functools
import os

os.environ.setdefault("NPROC", "4")

from closed_loop.cases import real_cable_cases
from closed_loop.experiment import Experiment, Extent, main
from closed_loop.methods import METHODS, NO_PRIOR_LEARNER
from closed_loop.paper import DIRECT

if __name__ == "__main__":
    main(
        Experiment(
            name="other_simulator",
            script="07_other_simulator.py",
            title="U and S by cables of another simulator family",
            about=(
                "The plants are Cosserat rods of PyElastica on a table with Stribeck friction "
                "(`experiments/closed_loop/rod_plant.py`). They share no code, friction law or discretisation "
                "with the training simulator. Table IV corresponds to the paper's Ethernet cable, table V to its USB "
                "cable. The paper's own figures, of real cables, are next to ours for scale only. The rows of the "
                "graph network with the static prior were run with an earlier controller, which waited for eight "
                "commands instead of two before it took back motions that had worsened the shape."
            ),
            small=Extent(
                functools.partial(real_cable_cases, ("U", "S"), tables=("IV",)),
                seeds=range(1),
                methods=(DIRECT, NO_PRIOR_LEARNER),
            ),
            full=Extent(functools.partial(real_cable_cases, ("U", "S")), seeds=range(5), methods=tuple(METHODS)),
            tables=("IV", "V"),
        )
    )
