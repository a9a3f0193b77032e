"""How a plan changes with the problem: the target, the model's weights, the history, the bounds."""

from __future__ import annotations

import jax
from jaxtyping import Array, Float

from cablejax.bounded.implicit import with_derivatives
from cablejax.mpc.problem import ShapingProblem


def differentiable_plan(problem: ShapingProblem, motion: Float[Array, "T Q 3"]) -> Float[Array, "T Q 3"]:
    """`motion` itself, with the derivatives that the minimum of the problem has in all arrays of `problem`.

    In forward and reverse mode, as the fixed point `u = P(u - grad J(u))`: also right where bounds are active. The
    motion must be a converged plan, from any solver. Takes one Hessian-vector product for each of its numbers.

    Args:
        problem: where its arrays are traced, they are differentiated in.
        motion: a minimum of it [m].
    """
    return with_derivatives(
        jax.lax.stop_gradient(motion), lambda motion, problem: problem.value(motion), problem.feasible, problem
    )
