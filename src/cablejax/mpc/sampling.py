"""Planning by sampling: no derivatives, many rollouts. Baselines for the solvers that have derivatives."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cablejax.mpc.least_squares import check_budget, check_positive
from cablejax.mpc.outcome import Outcome, Plan
from cablejax.mpc.problem import ShapingProblem


@dataclasses.dataclass(frozen=True)
class CrossEntropy:
    """Solver: the cross-entropy method (de Boer et al., Ann. Oper. Res. 134, 2005).

    Plans are drawn from a normal distribution and projected; the best of them say the next mean and spread.

    Attributes:
        samples: plans per iteration.
        elites: best of them.
        iterations: how often.
        spread: initial standard deviation, relative to the bound on one step's motion.
        smoothing: share of the old mean and spread that stays.
        seed: of the samples; the same in every call.
    """

    samples: int = 64
    elites: int = 8
    iterations: int = 5
    spread: float = 0.5
    smoothing: float = 0.1
    seed: int = 0

    def __post_init__(self):
        check_budget(self, "samples", "elites", "iterations")
        check_positive(self, "spread")
        if self.elites > self.samples or not 0 <= self.smoothing < 1:
            raise ValueError(
                f"CrossEntropy(elites={self.elites}, smoothing={self.smoothing}): expected no more elites than samples "
                "and a smoothing in [0, 1)."
            )

    def __call__(self, problem: ShapingProblem, guess: Float[Array, "T Q 3"]) -> Plan:
        def iterate(carry, key):
            best, mean, deviation = carry
            drawn = _drawn(problem, key, mean, deviation, self.samples)
            order = jnp.argsort(drawn.value)[: self.elites]
            elite = drawn.motion[order]
            mean = self.smoothing * mean + (1 - self.smoothing) * elite.mean(axis=0)
            deviation = self.smoothing * deviation + (1 - self.smoothing) * elite.std(axis=0)
            return (_better(best, drawn, order[0]), mean, deviation), None

        first = _first(problem, guess)
        deviation = self.spread * problem.feasible.radius * jnp.ones_like(guess)
        keys = jax.random.split(jax.random.key(self.seed), self.iterations)
        (best, _, _), _ = jax.lax.scan(iterate, (first, first.motion, deviation), keys)
        return _sampled_plan(best, 1 + self.samples * self.iterations)


@dataclasses.dataclass(frozen=True)
class PathIntegral:
    """Solver: model predictive path integral control (Williams et al., ICRA 2017).

    Plans around the mean are weighted by `exp(-value / temperature)`; their weighted mean is the next one.

    Attributes:
        samples: plans per iteration.
        iterations: how often.
        spread: standard deviation of the samples, relative to the bound on one step's motion.
        temperature: relative to the spread of the samples' values.
        seed: of the samples; the same in every call.
    """

    samples: int = 64
    iterations: int = 5
    spread: float = 0.3
    temperature: float = 0.1
    seed: int = 0

    def __post_init__(self):
        check_budget(self, "samples", "iterations")
        check_positive(self, "spread", "temperature")

    def __call__(self, problem: ShapingProblem, guess: Float[Array, "T Q 3"]) -> Plan:
        deviation = self.spread * problem.feasible.radius * jnp.ones_like(guess)

        def iterate(carry, key):
            best, mean = carry
            drawn = _drawn(problem, key, mean, deviation, self.samples)
            known = jnp.isfinite(drawn.value)
            lowest = drawn.value.min()
            span = jnp.where(known, drawn.value - lowest, 0.0).max() + jnp.finfo(guess.dtype).tiny
            weight = jnp.where(known, jnp.exp(-(drawn.value - lowest) / (self.temperature * span)), 0.0)
            weight = weight / jnp.maximum(weight.sum(), 1e-12)
            mean = jnp.where(known.any(), jnp.tensordot(weight, drawn.motion, axes=1), mean)
            return (_better(best, drawn, jnp.argmin(drawn.value)), mean), None

        first = _first(problem, guess)
        keys = jax.random.split(jax.random.key(self.seed), self.iterations)
        (best, mean), _ = jax.lax.scan(iterate, (first, first.motion), keys)
        last = _first(problem, mean)
        best = jax.tree.map(lambda a, b: jnp.where(last.value < best.value, a, b), last, best)
        return _sampled_plan(best, 2 + self.samples * self.iterations)


class _Valued(NamedTuple):
    motion: Float[Array, "*S T Q 3"]
    value: Float[Array, "*S"]  # infinite where the model gives NaN


def _first(problem: ShapingProblem, motion: Float[Array, "T Q 3"]) -> _Valued:
    motion = problem.feasible.project(motion)
    value = problem.value(motion)
    return _Valued(motion, jnp.where(jnp.isfinite(value), value, jnp.inf))


def _drawn(problem: ShapingProblem, key: Array, mean: Array, deviation: Array, samples: int) -> _Valued:
    noise = jax.random.normal(key, (samples, *mean.shape), mean.dtype)
    # Step by step is near enough for samples, and much cheaper than the nearest plan; but it knows no bound on changes.
    inside = problem.feasible.restore if problem.feasible.change is None else problem.feasible.project
    motion = jax.vmap(inside)(mean + deviation * noise)
    value = jax.vmap(problem.value)(motion)
    return _Valued(motion, jnp.where(jnp.isfinite(value), value, jnp.inf))


def _better(best: _Valued, drawn: _Valued, index: Array) -> _Valued:
    return jax.tree.map(lambda old, new: jnp.where(drawn.value[index] < best.value, new[index], old), best, drawn)


def _sampled_plan(best: _Valued, evaluations: int) -> Plan:
    outcome = jnp.where(jnp.isfinite(best.value), Outcome.STEP_LIMIT, Outcome.NONFINITE)
    return Plan(best.motion, jnp.asarray(evaluations, jnp.int32), outcome.astype(jnp.int32))
