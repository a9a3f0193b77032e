"""Powell's dogleg inside the feasible set."""

from __future__ import annotations

import dataclasses

from jaxtyping import Array, Float

from cablejax.bounded.dogleg import ProjectedDogleg
from cablejax.mpc.least_squares import check_budget, check_positive, least_squares_plan, longest_move
from cablejax.mpc.outcome import Plan
from cablejax.mpc.problem import ShapingProblem


@dataclasses.dataclass(frozen=True)
class Dogleg:
    """Solver: a trust region around Gauss-Newton models, steps along a dogleg. See `bounded.ProjectedDogleg`.

    Attributes:
        max_iterations: trial plans at most; each needs at most one linearisation.
        tolerance: stop once a unit gradient step, projected, would move no gripper by more than this [m].
        inner_iterations: splitting iterations on each quadratic model.
        secant: learn the residuals' own curvature from the change of the Jacobian.
    """

    max_iterations: int = 2
    tolerance: float = 2e-5
    inner_iterations: int = 30
    secant: bool = False

    def __post_init__(self):
        check_budget(self, "max_iterations", "inner_iterations")
        check_positive(self, "tolerance")

    def __call__(self, problem: ShapingProblem, guess: Float[Array, "T Q 3"]) -> Plan:
        solver = ProjectedDogleg(
            problem.feasible,
            rtol=0.0,
            atol=self.tolerance,
            norm=longest_move,
            secant=self.secant,
            inner_iterations=self.inner_iterations,
        )
        return least_squares_plan(problem, solver, guess, self.max_iterations)
