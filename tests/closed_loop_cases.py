"""Made-up trials for the tests of closed loops."""

import dataclasses
import math

import numpy as np

from closed_loop.trials import Trial


def course(terminal_cm: float = 0.25, settled_s: float = 8.0, best_cm: float = math.inf) -> tuple[float, ...]:
    """Errors [cm] of a run of 40 commands that settles after so many seconds, and was once as low as `best_cm`."""
    early = 40 if math.isinf(settled_s) else round(settled_s)
    errors = [25.0, *[5.0] * (early - 1), *[terminal_cm] * (41 - early)]
    errors[1] = min(errors[1], best_cm)
    return tuple(errors)


TRIAL = Trial(
    table="III",
    method="residual",
    scenario="U",
    stiffness=2.0,
    seed=0,
    errors_cm=course(),
    stopped=None,
    mpc_ms_median=100.0,
    wall_s=12.5,
)


def trial(**changes) -> Trial:
    return dataclasses.replace(TRIAL, **changes)


def small_table(table: str = "III") -> list[Trial]:
    """Two methods, two scenarios, two stiffnesses, three seeds; the residual is always 0.1 cm lower."""
    rng = np.random.default_rng(0)
    rows = []
    for scenario in ("S", "U"):
        for stiffness in (0.5, 2.0):
            for seed in range(3):
                error = 0.3 + 0.2 * rng.random() + 0.1 * stiffness
                common = {"table": table, "scenario": scenario, "stiffness": stiffness, "seed": seed}
                rows.append(trial(**common, method="residual", errors_cm=course(error)))
                rows.append(trial(**common, method="direct", errors_cm=course(error + 0.1, settled_s=9.0)))
    return rows
