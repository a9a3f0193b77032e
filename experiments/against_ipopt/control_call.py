"""Times IPOPT until its plan is as good as that of a control call's solver.

A control call does not iterate to convergence: it makes one linearisation and a few trial plans. This solve, compiled
and in the controller's single precision, is compared with IPOPT from the same start. IPOPT gets the same compiled
objective and gradient, and is timed until its first feasible plan that is as good.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from against_ipopt.judge import EQUAL
from against_ipopt.planning_problems import PlanningCase, ProblemMaker
from against_ipopt.referee import RefereeConfig, referee, value_of
from cablejax.mpc import Solver

REFEREE = RefereeConfig(max_iterations=200, max_seconds=60.0)


def race(
    make: ProblemMaker, case: PlanningCase, solvers: Mapping[str, Solver], config: RefereeConfig = REFEREE
) -> dict[str, Any]:
    """One problem by each solver and by IPOPT; call it once before it counts, since the first call compiles.

    Args:
        make: problems in single precision.
        case: the problem.
        solvers: by name.
        config: of IPOPT.

    Returns:
        A row that JSON can hold: `start`, the objective there [m^2]; by solver `objective` [m^2], `seconds`, and
        IPOPT's `ipopt_seconds` until it was as good, None if it never was; and of `ipopt` where it ended.
    """
    problem, guess = make(case), jnp.asarray(case.guess, make.precision)
    start = np.asarray(problem.feasible.project(guess))
    found = referee(problem, case.limits(), start, config)
    row: dict[str, Any] = {
        "name": case.name,
        "start": float(value_of(problem, jnp.asarray(start))),
        "ipopt": {"objective": found.objective, "seconds": found.seconds, "iterations": found.iterations},
    }
    for name, solver in solvers.items():
        seconds = []
        for _ in range(5):
            began = time.perf_counter()
            plan = jax.block_until_ready(_plan(solver, problem, guess))
            seconds.append(time.perf_counter() - began)
        objective = float(plan.value)
        theirs = found.seconds_to(objective * (1 + EQUAL))
        row[name] = {
            "objective": objective,
            "seconds": float(np.median(seconds)),
            "ipopt_seconds": finite(theirs),
        }
    return row


def improved(rows: Sequence[dict[str, Any]], solver: str) -> list[dict[str, Any]]:
    """What a solver did where it improved its start; the other problems say nothing about speed."""
    return [row[solver] for row in rows if row[solver]["objective"] < row["start"] * (1 - EQUAL)]


def ratios(rows: Sequence[dict[str, Any]], solver: str) -> Float[np.ndarray, " R"]:
    """IPOPT's seconds over the solver's, where that improved its start; infinite where IPOPT was never as good."""
    pairs = [(one["ipopt_seconds"], one["seconds"]) for one in improved(rows, solver)]
    return np.array([np.inf if theirs is None else theirs / ours for theirs, ours in pairs])


def finite(number: float) -> float | None:
    """For JSON, which knows no infinity."""
    return float(number) if np.isfinite(number) else None


@functools.partial(jax.jit, static_argnums=0)
def _plan(solver, problem, guess):
    return solver(problem, problem.start(guess))
