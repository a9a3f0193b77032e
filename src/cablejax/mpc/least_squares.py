"""How the bounded least squares solvers are run on a shaping problem."""

from __future__ import annotations

import math

import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from cablejax.bounded.adjoint import FixedPointAdjoint
from cablejax.bounded.least_squares import AbstractProjectedLeastSquares
from cablejax.mpc.outcome import Plan, outcome_of
from cablejax.mpc.problem import ShapingProblem


def least_squares_plan(
    problem: ShapingProblem, solver: AbstractProjectedLeastSquares, guess: Float[Array, "T Q 3"], max_iterations: int
) -> Plan:
    """The plan that a bounded least squares solver finds from a guess; differentiable in the problem."""
    shape = guess.shape
    solution = optx.least_squares(
        lambda flat, problem: problem.residuals(flat.reshape(shape)),
        solver,
        problem.feasible.project(guess).ravel(),
        args=problem,
        options={"linearise": lambda flat, problem: problem.linearise(flat.reshape(shape))},
        max_steps=max_iterations,
        adjoint=FixedPointAdjoint(),
        throw=False,
    )
    return Plan(
        motion=solution.value.reshape(shape),
        evaluations=jnp.asarray(solution.stats["num_steps"], jnp.int32),
        outcome=outcome_of(solution.result),
        linearisations=solution.stats["linearisations"],
        optimality=solution.stats["optimality"],
    )


def longest_move(flat: Float[Array, "..."]) -> Float[Array, ""]:
    """Largest motion of one gripper in one step [m]."""
    return jnp.linalg.norm(flat.reshape(-1, 3), axis=-1).max()


def check_budget(settings: object, *names: str) -> None:
    """Raises ValueError unless these settings of a solver are at least one."""
    if any(getattr(settings, name) < 1 for name in names):
        given = ", ".join(f"{name}={getattr(settings, name)}" for name in names)
        raise ValueError(f"{type(settings).__name__}({given}): expected at least one of each.")


def check_positive(settings: object, *names: str) -> None:
    """Raises ValueError unless these settings of a solver are positive and finite."""
    for name in names:
        value = getattr(settings, name)
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{type(settings).__name__}.{name} is {value}, expected a positive finite number.")
