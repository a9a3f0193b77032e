"""Planners by sampling: the cross-entropy method and path integrals. No derivatives, many rollouts; baselines."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cablejax.bounded.results import Result
from cablejax.limits import check
from cablejax.mpc.plan import Plan
from cablejax.mpc.problem import Rollout, ShapingProblem

# Of the samples; the same in every call.
_SEED = 0
# Best samples of an iteration, and the share of the old mean and spread that stays.
_ELITES, _SMOOTHING = 8, 0.1
# Standard deviation of the samples, relative to the bound on one step's motion: at first, and in all iterations.
_ELITE_SPREAD, _WEIGHED_SPREAD = 0.5, 0.3
# Relative to the spread of the samples' values.
_TEMPERATURE = 0.1


@dataclasses.dataclass(frozen=True)
class _Sampling:
    """Common settings of these planners.

    Attributes:
        samples: plans per iteration.
        iterations: how often.
    """

    samples: int = 64
    iterations: int = 5

    def __post_init__(self):
        check(self, samples="count", iterations="count")


class CrossEntropy(_Sampling):
    """Solver: the cross-entropy method (de Boer et al., Ann. Oper. Res. 134, 2005).

    Plans are drawn from a normal distribution and projected; the best of them say the next mean and spread.
    """

    def __call__(self, problem: ShapingProblem, guess: Rollout) -> Plan:
        """Draws plans around a mean, moves the mean to the best of them, and returns the best plan drawn."""

        def iterate(carry, key):
            best, mean, deviation = carry
            drawn = drawn_plans(problem, key, mean, deviation, self.samples)
            mean, deviation = towards_the_best(mean, deviation, drawn)
            return (better_plan(best, drawn, jnp.argmin(drawn.value)), mean, deviation), None

        first = first_plan(problem, guess)
        deviation = _ELITE_SPREAD * problem.feasible.radius * jnp.ones_like(guess.motion)
        keys = jax.random.split(jax.random.key(_SEED), self.iterations)
        (best, _, _), _ = jax.lax.scan(iterate, (first, first.motion, deviation), keys)
        return sampled_plan(problem, best, self.samples * self.iterations)


class PathIntegral(_Sampling):
    """Solver: model predictive path integral control (Williams et al., ICRA 2017).

    Plans around the mean are weighted by `exp(-value / temperature)`; their weighted mean is the next one.
    """

    def __call__(self, problem: ShapingProblem, guess: Rollout) -> Plan:
        """Draws plans around a mean, moves the mean to their weighted average, and returns the best plan."""
        deviation = _WEIGHED_SPREAD * problem.feasible.radius * jnp.ones_like(guess.motion)

        def iterate(carry, key):
            best, mean = carry
            drawn = drawn_plans(problem, key, mean, deviation, self.samples)
            known = jnp.isfinite(drawn.value)
            lowest = drawn.value.min()
            span = jnp.where(known, drawn.value - lowest, 0.0).max() + jnp.finfo(guess.motion.dtype).tiny
            weight = jnp.where(known, jnp.exp(-(drawn.value - lowest) / (_TEMPERATURE * span)), 0.0)
            weight = weight / jnp.maximum(weight.sum(), 1e-12)
            mean = jnp.where(known.any(), jnp.tensordot(weight, drawn.motion, axes=1), mean)
            return (better_plan(best, drawn, jnp.argmin(drawn.value)), mean), None

        first = first_plan(problem, guess)
        keys = jax.random.split(jax.random.key(_SEED), self.iterations)
        (best, mean), _ = jax.lax.scan(iterate, (first, first.motion), keys)
        last = first_plan(problem, problem.start(mean))
        best = jax.tree.map(lambda a, b: jnp.where(last.value < best.value, a, b), last, best)
        return sampled_plan(problem, best, 1 + self.samples * self.iterations)


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


def towards_the_best(mean: Array, deviation: Array, drawn: Valued) -> tuple[Array, Array]:
    """The cross-entropy method's next mean and spread; as they are where no plan has a value."""
    order = jnp.argsort(drawn.value)[:_ELITES]
    known = jnp.isfinite(drawn.value[order])
    weight = (known / jnp.maximum(known.sum(), 1)).astype(mean.dtype)
    centre = jnp.tensordot(weight, drawn.motion[order], axes=1)
    spread = jnp.sqrt(jnp.tensordot(weight, (drawn.motion[order] - centre) ** 2, axes=1))
    kept = jnp.where(known.any(), _SMOOTHING, 1.0).astype(mean.dtype)
    return kept * mean + (1 - kept) * centre, kept * deviation + (1 - kept) * spread


def better_plan(best: Valued, drawn: Valued, index: Array) -> Valued:
    """The better one of a plan and one of those drawn."""
    return jax.tree.map(lambda old, new: jnp.where(drawn.value[index] < best.value, new[index], old), best, drawn)


def sampled_plan(problem: ShapingProblem, best: Valued, evaluations: int) -> Plan:
    """The best plan as a solver returns it."""
    result = jnp.where(jnp.isfinite(best.value), Result.STEP_LIMIT, Result.NONFINITE)
    empty = problem.feasible.empty() | problem.feasible.outside(best.motion, best.motion)
    result = jnp.where(empty, Result.EMPTY_SET, result)
    return Plan(best.motion, best.value, jnp.asarray(evaluations, jnp.int32), result.astype(jnp.int32))
