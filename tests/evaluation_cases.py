"""Made-up trials for the evaluation's tests."""

import dataclasses

import numpy as np

from cablejax.evaluation.trials import Trial

TRIAL = Trial(
    table="III",
    method="residual",
    scenario="U",
    stiffness=2.0,
    seed=0,
    initial_error_cm=25.0,
    terminal_error_cm=0.25,
    best_error_cm=0.2,
    settling_time_s=8.0,
    steps=40,
    stopped=None,
    mpc_ms_median=100.0,
    wall_s=12.5,
    errors_cm=(25.0, 3.0, 0.25, 0.25, 0.25),
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
                rows.append(trial(**common, method="residual", terminal_error_cm=error))
                rows.append(trial(**common, method="direct", terminal_error_cm=error + 0.1, settling_time_s=9.0))
    return rows
