"""A planner that iterates to convergence: the reference plan that is compared with IPOPT's."""

from __future__ import annotations

import dataclasses

from cablejax.bounded import BoundedLevenbergMarquardt, BoundedQuasiNewton
from cablejax.limits import check
from cablejax.mpc import Plan, Rollout, ShapingProblem
from cablejax.mpc.planners import bounded_plan

# Trial plans after each linearisation of the first part.
_FIRST_TRIALS = 3


@dataclasses.dataclass(frozen=True)
class Accurate:
    """Solver: a few linearisations, which get near a good minimum, then quasi-Newton steps of one gradient each.

    For float64 and a network with rounded corners (`against_ipopt.rounded`): another has no point to end at.

    Attributes:
        linearisations: of the first part, at most.
        gradients: of the second part, at most.
        tolerance: stop once a unit projected gradient step moves no coordinate by more than this [m]. Where bounds
            press, the KKT residual is greater by the ratio of gradient and step bound, some 100 times.
    """

    linearisations: int = 2
    gradients: int = 200
    tolerance: float = 1e-10

    def __post_init__(self):
        check(self, linearisations="count", gradients="count", tolerance="positive")

    def parts(self) -> tuple[BoundedLevenbergMarquardt, BoundedQuasiNewton]:
        """The solver that begins, and the one that goes on from there."""
        first = BoundedLevenbergMarquardt(atol=self.tolerance, trials_per_linearisation=_FIRST_TRIALS)
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
