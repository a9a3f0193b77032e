"""Plans with nothing left to gain: for reference, and before asking for a plan's derivatives."""

from __future__ import annotations

import dataclasses

from cablejax.bounded.levenberg_marquardt import BoundedLevenbergMarquardt
from cablejax.bounded.quasi_newton import BoundedQuasiNewton
from cablejax.mpc.bounded_plan import bounded_plan
from cablejax.mpc.plan import Plan
from cablejax.mpc.problem import ShapingProblem
from cablejax.mpc.rollout import Rollout
from cablejax.mpc.settings import check_budget, check_positive


@dataclasses.dataclass(frozen=True)
class Accurate:
    """Solver: a few linearisations, which get near a good minimum, then quasi-Newton steps of one gradient each.

    For float64 and a network with rounded corners (`dynamics.smooth`): another has no point to end at.

    Attributes:
        linearisations: of the first part, at most.
        trials_per_linearisation: trial plans after each.
        gradients: of the second part, at most.
        tolerance: stop once a unit projected gradient step moves no coordinate by more than this [m]. Where bounds
            press, the KKT residual is greater by the ratio of gradient and step bound, some 100 times.
    """

    linearisations: int = 2
    trials_per_linearisation: int = 3
    gradients: int = 200
    tolerance: float = 1e-10

    def __post_init__(self):
        check_budget(self, "linearisations", "trials_per_linearisation", "gradients")
        check_positive(self, "tolerance")

    def parts(self) -> tuple[BoundedLevenbergMarquardt, BoundedQuasiNewton]:
        """The solver that begins, and the one that goes on from there."""
        first = BoundedLevenbergMarquardt(atol=self.tolerance, trials_per_linearisation=self.trials_per_linearisation)
        return first, BoundedQuasiNewton(atol=self.tolerance)

    def __call__(self, problem: ShapingProblem, guess: Rollout) -> Plan:
        """The plan from a guess; differentiable in the problem where it has converged."""
        first, second = self.parts()
        near = bounded_plan(problem, guess, first, self.linearisations)
        plan = bounded_plan(problem, problem.rollout(near.motion), second, self.gradients)
        return dataclasses.replace(
            plan,
            evaluations=near.evaluations + plan.evaluations,
            linearisations=near.linearisations + plan.linearisations,  # pyright: ignore[reportOperatorIssue]
        )
