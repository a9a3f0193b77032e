"""Plans by path integrals: no derivatives, many rollouts; a baseline."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from cablejax.mpc.plan import Plan
from cablejax.mpc.problem import ShapingProblem
from cablejax.mpc.rollout import Rollout
from cablejax.mpc.sampling import better_plan, drawn_plans, first_plan, sampled_plan
from cablejax.mpc.settings import check_budget, check_positive


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

    def __call__(self, problem: ShapingProblem, guess: Rollout) -> Plan:
        deviation = self.spread * problem.feasible.radius * jnp.ones_like(guess.motion)

        def iterate(carry, key):
            best, mean = carry
            drawn = drawn_plans(problem, key, mean, deviation, self.samples)
            known = jnp.isfinite(drawn.value)
            lowest = drawn.value.min()
            span = jnp.where(known, drawn.value - lowest, 0.0).max() + jnp.finfo(guess.motion.dtype).tiny
            weight = jnp.where(known, jnp.exp(-(drawn.value - lowest) / (self.temperature * span)), 0.0)
            weight = weight / jnp.maximum(weight.sum(), 1e-12)
            mean = jnp.where(known.any(), jnp.tensordot(weight, drawn.motion, axes=1), mean)
            return (better_plan(best, drawn, jnp.argmin(drawn.value)), mean), None

        first = first_plan(problem, guess)
        keys = jax.random.split(jax.random.key(self.seed), self.iterations)
        (best, mean), _ = jax.lax.scan(iterate, (first, first.motion), keys)
        last = first_plan(problem, problem.start(mean))
        best = jax.tree.map(lambda a, b: jnp.where(last.value < best.value, a, b), last, best)
        return sampled_plan(problem, best, 2 + self.samples * self.iterations)
