"""Spectral projected gradient descent."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from cablejax.bounded.adjoint import FixedPointAdjoint
from cablejax.bounded.spectral import SpectralProjectedGradient
from cablejax.mpc.least_squares import check_positive, longest_move
from cablejax.mpc.outcome import Plan, outcome_of
from cablejax.mpc.problem import ShapingProblem


@dataclasses.dataclass(frozen=True)
class ProjectedGradient:
    """Solver: gradient steps of Barzilai-Borwein length along the projection arc. See
    `bounded.SpectralProjectedGradient`.

    Every evaluation costs one rollout, and an accepted one its gradient in reverse mode.

    Attributes:
        max_evaluations: trial plans, the guess included. A fixed small number is the deadline mode.
        tolerance: stop once a unit gradient step, projected, would move no gripper by more than this [m].
        initial_step: length of the first step, relative to the gradient. The objective's Hessian is near 1 per step of
            the horizon that a motion is felt in, and up to about 17 for the six-step sum, hence 0.1.
        memory: a trial is compared with the worst of this many last accepted values (Grippo, Lampariello, Lucidi
            1986); 1 makes every accepted step a descent.
    """

    max_evaluations: int = 12
    tolerance: float = 2e-5
    initial_step: float = 0.1
    memory: int = 1

    def __post_init__(self):
        if self.max_evaluations < 2 or self.memory < 1:
            raise ValueError(
                f"ProjectedGradient(max_evaluations={self.max_evaluations}, memory={self.memory}): expected at least "
                "2 evaluations (the guess and one step) and a memory of at least 1."
            )
        check_positive(self, "tolerance", "initial_step")

    def __call__(self, problem: ShapingProblem, guess: Float[Array, "T Q 3"]) -> Plan:
        solution = optx.minimise(
            lambda motion, problem: problem.value(motion),
            SpectralProjectedGradient(
                problem.feasible,
                rtol=0.0,
                atol=self.tolerance,
                norm=longest_move,
                memory=self.memory,
                initial_length=self.initial_step,
                lengths=(1e-3, 1e2),
            ),
            problem.feasible.project(guess),
            args=problem,
            max_steps=self.max_evaluations,
            adjoint=FixedPointAdjoint(),
            throw=False,
        )
        return Plan(
            motion=solution.value,
            evaluations=jnp.asarray(solution.stats["num_steps"], jnp.int32),
            outcome=outcome_of(solution.result),
            optimality=solution.stats["optimality"],
        )
