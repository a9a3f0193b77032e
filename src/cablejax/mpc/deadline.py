"""Plans in bounded time."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cablejax.bounded.gauss_newton import regularised
from cablejax.bounded.quadratic import minimise_quadratic
from cablejax.mpc.plan import Outcome, Plan
from cablejax.mpc.problem import ShapingProblem
from cablejax.mpc.settings import check_positive


@dataclasses.dataclass(frozen=True)
class Deadline:
    """Solver: one Gauss-Newton model, minimised over the feasible set, and the best plan on the way to its minimum.

    One linearisation and one batch of rollouts, whatever the problem: there is no loop that a problem could make
    longer, but that of the quadratic model, which has a fixed budget and takes about a millisecond.

    Attributes:
        damping: relative to the diagonal of J'J.
        fractions: of the way to the model's minimum, at which plans are tried, side by side.
    """

    damping: float = 1e-3
    fractions: tuple[float, ...] = (1.0, 0.5)

    def __post_init__(self):
        check_positive(self, "damping")
        if not self.fractions or not all(0 < fraction <= 1 for fraction in self.fractions):
            raise ValueError(f"Deadline.fractions is {self.fractions}, expected numbers in (0, 1].")

    def __call__(self, problem: ShapingProblem, guess: Float[Array, "T Q 3"]) -> Plan:
        start = problem.feasible.project(guess)
        residuals, jacobian = problem.linearise(start)
        gradient, hessian = jacobian.T @ residuals, jacobian.T @ jacobian
        convex = problem.feasible.at(start)
        damped = regularised(hessian + self.damping * jnp.diag(jnp.diag(hessian)))
        way = minimise_quadratic(damped, gradient, convex, start).point.reshape(start.shape) - start
        fractions = jnp.asarray(self.fractions, start.dtype)
        plans = jax.vmap(lambda fraction: convex.restore(start + fraction * way))(fractions)
        values = jax.vmap(problem.value)(plans)
        value = 0.5 * jnp.sum(residuals**2)
        values = jnp.where(jnp.isfinite(values), values, jnp.inf)
        best = jnp.argmin(values)
        sound = jnp.isfinite(value) & jnp.isfinite(gradient).all()
        empty = problem.feasible.empty()
        outcome = jnp.where(sound, Outcome.STEP_LIMIT, Outcome.NONFINITE)
        return Plan(
            motion=jnp.where(sound & (values[best] < value), plans[best], start),
            evaluations=jnp.asarray(len(self.fractions), jnp.int32),
            outcome=jnp.where(empty, Outcome.INFEASIBLE, outcome).astype(jnp.int32),
            linearisations=jnp.ones((), jnp.int32),
        )
