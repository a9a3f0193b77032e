"""Gauss-Newton with a line search inside the feasible set."""

from __future__ import annotations

import dataclasses

from jaxtyping import Array, Float

from cablejax.bounded.gauss_newton import ProjectedGaussNewton
from cablejax.mpc.least_squares import check_budget, check_positive, least_squares_plan, longest_move
from cablejax.mpc.outcome import Plan
from cablejax.mpc.problem import ShapingProblem


@dataclasses.dataclass(frozen=True)
class GaussNewton:
    """Solver: Gauss-Newton models without damping, and backtracking. See `bounded.ProjectedGaussNewton`.

    Needs a positive `motion_weight`; without, the model may be singular, and the outcome says so.

    Attributes:
        max_iterations: trial plans at most; each needs at most one linearisation.
        tolerance: stop once a unit gradient step, projected, would move no gripper by more than this [m].
        inner_iterations: splitting iterations on each quadratic model.
    """

    max_iterations: int = 2
    tolerance: float = 2e-5
    inner_iterations: int = 30

    def __post_init__(self):
        check_budget(self, "max_iterations", "inner_iterations")
        check_positive(self, "tolerance")

    def __call__(self, problem: ShapingProblem, guess: Float[Array, "T Q 3"]) -> Plan:
        solver = ProjectedGaussNewton(
            problem.feasible,
            rtol=0.0,
            atol=self.tolerance,
            norm=longest_move,
            inner_iterations=self.inner_iterations,
        )
        return least_squares_plan(problem, solver, guess, self.max_iterations)
