"""Plans by spectral projected gradient descent."""

from __future__ import annotations

import dataclasses

from cablejax.bounded.solve import minimise
from cablejax.bounded.spectral import SpectralProjectedGradient
from cablejax.mpc.plan import Plan, plan_from
from cablejax.mpc.problem import ShapingProblem
from cablejax.mpc.rollout import Rollout
from cablejax.mpc.settings import check_positive


@dataclasses.dataclass(frozen=True)
class ProjectedGradient:
    """Solver: gradient steps of Barzilai-Borwein length along the projection arc `P(u - s a g)`.

    Every evaluation costs one rollout, and an accepted one its gradient in reverse mode.

    Attributes:
        max_evaluations: trial plans, the guess included.
        tolerance: stop once a unit gradient step, projected, would move no coordinate by more than this [m].
        initial_step: a before the first curvature is known. The objective's Hessian is near 1 per step of the horizon
            that a motion is felt in, and up to about 17 for the six-step sum, hence 0.1.
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

    def __call__(self, problem: ShapingProblem, guess: Rollout) -> Plan:
        solver = SpectralProjectedGradient(
            atol=self.tolerance, memory=self.memory, initial_length=self.initial_step, lengths=(1e-3, 1e2)
        )
        solution = minimise(
            lambda motion, problem: problem.value(motion),
            solver,
            guess.motion,
            problem.feasible,
            problem,
            max_steps=self.max_evaluations,
            throw=False,
        )
        return plan_from(solution)
