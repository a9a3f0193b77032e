"""Levenberg-Marquardt steps that stay inside the feasible set."""

from __future__ import annotations

import dataclasses

import optimistix as optx
from jaxtyping import Array, Float

from cablejax.bounded.levenberg_marquardt import ProjectedLevenbergMarquardt
from cablejax.mpc.least_squares import check_budget, check_positive, least_squares_plan, longest_move
from cablejax.mpc.outcome import Plan
from cablejax.mpc.problem import ShapingProblem


@dataclasses.dataclass(frozen=True)
class TrustRegion:
    """Solver: damped Gauss-Newton models of the objective, minimised over the feasible set.

    See `bounded.ProjectedLevenbergMarquardt`; active bounds are part of the model and not an afterthought.

    Attributes:
        max_iterations: trial plans at most; each needs at most one linearisation, which costs as much as about nine
            gradients. A fixed small number is the deadline mode: bounded time in one compiled call.
        tolerance: stop once a unit gradient step, projected, would move no gripper by more than this [m].
        damping: initial damping, relative to the largest eigenvalue of J'J.
        inner_iterations: splitting iterations on each quadratic model; they cost no model evaluations.
        secant: learn the residuals' own curvature from the change of the Jacobian. It pays from the third iteration on.
    """

    max_iterations: int = 2
    tolerance: float = 2e-5
    damping: float = 1e-3
    inner_iterations: int = 30
    secant: bool = False

    def __post_init__(self):
        check_budget(self, "max_iterations", "inner_iterations")
        check_positive(self, "tolerance", "damping")

    def __call__(self, problem: ShapingProblem, guess: Float[Array, "T Q 3"]) -> Plan:
        solver = ProjectedLevenbergMarquardt(
            problem.feasible,
            rtol=0.0,
            atol=self.tolerance,
            norm=longest_move,
            damping=self.damping,
            secant=self.secant,
            inner_iterations=self.inner_iterations,
            search=optx.ClassicalTrustRegion(high_cutoff=0.75),
        )
        return least_squares_plan(problem, solver, guess, self.max_iterations)
