"""What planning by sampling needs: plans drawn, made feasible and valued."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cablejax.mpc.plan import Outcome, Plan
from cablejax.mpc.problem import ShapingProblem
from cablejax.mpc.rollout import Rollout


class Valued(NamedTuple):
    """Plans and their values.

    Attributes:
        motion: [m], shape [S, T, Q, 3].
        value: infinite where the model gives NaN, shape [S].
    """

    motion: Float[Array, "*S T Q 3"]
    value: Float[Array, "*S"]


def first_plan(problem: ShapingProblem, guess: Rollout) -> Valued:
    """The guess and its value."""
    value = problem.value_of(guess)
    return Valued(guess.motion, jnp.where(jnp.isfinite(value), value, jnp.inf))


def drawn_plans(problem: ShapingProblem, key: Array, mean: Array, deviation: Array, samples: int) -> Valued:
    """Feasible plans from a normal distribution, and their values."""
    noise = jax.random.normal(key, (samples, *mean.shape), mean.dtype)
    # Step by step is near enough for samples, and much cheaper than the nearest plan; but it knows no bound on changes,
    # nor the way back from outside.
    motion = jax.vmap(problem.feasible.restore)(mean + deviation * noise)
    outside = jax.vmap(problem.feasible.violation)(motion) > 0.0
    motion = jax.lax.cond(outside.any(), jax.vmap(problem.feasible.project), lambda motion: motion, motion)
    value = jax.vmap(problem.value)(motion)
    return Valued(motion, jnp.where(jnp.isfinite(value), value, jnp.inf))


def better_plan(best: Valued, drawn: Valued, index: Array) -> Valued:
    """The better one of a plan and one of those drawn."""
    return jax.tree.map(lambda old, new: jnp.where(drawn.value[index] < best.value, new[index], old), best, drawn)


def sampled_plan(problem: ShapingProblem, best: Valued, evaluations: int) -> Plan:
    """The best plan as a solver returns it."""
    outcome = jnp.where(jnp.isfinite(best.value), Outcome.STEP_LIMIT, Outcome.NONFINITE)
    rounding = jnp.finfo(best.motion.dtype).eps ** 0.5
    broken = problem.feasible.empty() | ~(problem.feasible.violation(best.motion) <= rounding)
    outcome = jnp.where(broken, Outcome.INFEASIBLE, outcome)
    return Plan(best.motion, best.value, jnp.asarray(evaluations, jnp.int32), outcome.astype(jnp.int32))
