"""A planning problem handed to a solver of `cablejax.bounded`."""

from __future__ import annotations

import optimistix as optx

from cablejax.bounded.solve import least_squares
from cablejax.mpc.plan import Plan, plan_from
from cablejax.mpc.problem import ShapingProblem
from cablejax.mpc.rollout import Rollout


def bounded_plan(
    problem: ShapingProblem,
    guess: Rollout,
    solver: optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser,
    max_steps: int,
) -> Plan:
    """The plan that a bounded solver finds from a guess; differentiable in the problem where it has converged."""
    solution = least_squares(
        lambda motion, given: given[0].residuals(motion),
        solver,
        guess.motion,
        problem.feasible,
        (problem, guess),
        linearise=lambda motion, given: given[0].linearise(motion, known=given[1]),
        max_steps=max_steps,
        throw=False,
    )
    return plan_from(solution)
