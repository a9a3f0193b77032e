"""A planning problem handed to a solver of `cablejax.bounded`."""

from __future__ import annotations

import optimistix as optx
from jaxtyping import Array, Float

from cablejax.bounded.solve import least_squares
from cablejax.mpc.plan import Plan, plan_from
from cablejax.mpc.problem import ShapingProblem


def bounded_plan(
    problem: ShapingProblem,
    guess: Float[Array, "T Q 3"],
    solver: optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser,
    max_steps: int,
) -> Plan:
    """The plan that a bounded solver finds from a guess; differentiable in the problem where it has converged."""
    solution = least_squares(
        lambda motion, problem: problem.residuals(motion),
        solver,
        guess,
        problem.feasible,
        problem,
        linearise=lambda motion, problem: problem.linearise(motion),
        max_steps=max_steps,
        throw=False,
    )
    return plan_from(solution)
