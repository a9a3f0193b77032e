"""One planning problem by our solver and by IPOPT: objectives, feasibility, optimality, and the clock."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cablejax.bounded import BoundedLevenbergMarquardt, certify
from cablejax.evaluation.planning_problems import PlanningCase, ProblemMaker
from cablejax.evaluation.referee import RefereeConfig, referee
from cablejax.evaluation.solver_path import PathFinder
from cablejax.mpc import ShapingProblem
from cablejax.shaping import Model

EQUAL = 1e-6
"""Relative difference of objectives that counts as none."""
STEPS = 60
"""Trial plans of ours at most."""
TOLERANCE = 1e-9
"""Of ours on the projected gradient in float64 [m]; in float32 100 times that."""


@dataclasses.dataclass(frozen=True)
class Contestant:
    """Our accurate setting, in both precisions.

    Attributes:
        make: problems in float64.
        make_single: in float32.
        find: the solver in float64.
        find_single: in float32.
    """

    make: ProblemMaker
    make_single: ProblemMaker
    find: PathFinder
    find_single: PathFinder


def contestant(model: Model) -> Contestant:
    """`BoundedLevenbergMarquardt` on a model's problems; call it, and all else here, with x64 enabled in JAX."""

    def finder(tolerance: float) -> PathFinder:
        return PathFinder(
            lambda motion, problem: problem.residuals(motion),
            BoundedLevenbergMarquardt(atol=tolerance),
            lambda motion, problem: problem.linearise(motion),
        )

    with jax.enable_x64(False):
        make_single = ProblemMaker(model, np.float32)
    return Contestant(ProblemMaker(model), make_single, finder(TOLERANCE), finder(100 * TOLERANCE))


def judge(ours: Contestant, case: PlanningCase, referees: Sequence[RefereeConfig]) -> dict[str, Any]:
    """One problem by all; both begin at the same feasible plan.

    Returns:
        A row that JSON can hold: of ours `start` and `objective` [m^2], `violation` [m], `kkt` (residual of the
        certificate), `steps`, `converged`, `seconds`, `single_objective` and `single_violation` of the plan found in
        float32, evaluated in float64; and for each referee, under `limited` or `exact`, what it found and the seconds
        in which either first reached the objective that both reach.
    """
    problem, limits = ours.make(case), case.limits()
    start = np.asarray(problem.feasible.project(jnp.asarray(case.guess)))
    path = ours.find(problem, problem.feasible, start, STEPS)
    point = jnp.asarray(path.points[-1])
    row: dict[str, Any] = {
        "name": case.name,
        "start": float(path.objectives[0]),
        "objective": float(path.objectives[-1]),
        "violation": limits.violation(path.points[-1]),
        "kkt": float(certify(_slope(problem, point), problem.feasible, point).residual),
        "steps": len(path.seconds) - 1,
        "converged": path.converged,
        "seconds": float(path.seconds[-1]),
    }
    with jax.enable_x64(False):
        single = ours.make_single(case)
        plan = ours.find_single(single, single.feasible, start.astype(np.float32), STEPS).points[-1]
    row["single_objective"] = float(_value(problem, jnp.asarray(plan, jnp.float64)))
    row["single_violation"] = limits.violation(plan)
    for config in referees:
        found = referee(problem, limits, start, config)
        both = max(found.objective, row["objective"]) * (1 + EQUAL)
        row["exact" if config.exact else "limited"] = {
            "objective": found.objective,
            "violation": found.violation,
            "status": found.status,
            "iterations": found.iterations,
            "evaluations": found.evaluations,
            "seconds": found.seconds,
            "seconds_to_both": found.seconds_to(both),
            "ours_seconds_to_both": path.seconds_to(both),
        }
    return row


def excess(row: dict[str, Any], which: str) -> float:
    """By how much our objective is above the referee's, relative to it."""
    return (row["objective"] - row[which]["objective"]) / row[which]["objective"]


def comparable_seconds(rows: Sequence[dict[str, Any]], which: str) -> tuple[np.ndarray, np.ndarray]:
    """Our and the referee's seconds to an equal objective, where both end within `EQUAL` of each other.

    Left out are problems whose start is already as good as that: they say nothing about speed.
    """
    pairs = [
        (row[which]["ours_seconds_to_both"], row[which]["seconds_to_both"])
        for row in rows
        if which in row and abs(excess(row, which)) <= EQUAL
    ]
    both = np.array([pair for pair in pairs if pair[0] > 0 and np.isfinite(pair[1])]).reshape(-1, 2)
    return both[:, 0], both[:, 1]


@jax.jit
def _value(problem: ShapingProblem, motion):
    return problem.value(motion)


@jax.jit
def _slope(problem: ShapingProblem, motion):
    return jax.grad(problem.value)(motion)
