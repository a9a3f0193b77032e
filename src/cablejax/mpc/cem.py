"""Plans by the cross-entropy method: no derivatives, many rollouts; a baseline."""

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

    def __call__(self, problem: ShapingProblem, guess: Rollout) -> Plan:
        def iterate(carry, key):
            best, mean, deviation = carry
            drawn = drawn_plans(problem, key, mean, deviation, self.samples)
            order = jnp.argsort(drawn.value)[: self.elites]
            elite = drawn.motion[order]
            mean = self.smoothing * mean + (1 - self.smoothing) * elite.mean(axis=0)
            deviation = self.smoothing * deviation + (1 - self.smoothing) * elite.std(axis=0)
            return (better_plan(best, drawn, order[0]), mean, deviation), None

        first = first_plan(problem, guess)
        deviation = self.spread * problem.feasible.radius * jnp.ones_like(guess.motion)
        keys = jax.random.split(jax.random.key(self.seed), self.iterations)
        (best, _, _), _ = jax.lax.scan(iterate, (first, first.motion, deviation), keys)
        return sampled_plan(problem, best, 1 + self.samples * self.iterations)
