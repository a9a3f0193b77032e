"""Plans by the bounded least squares solvers."""

from __future__ import annotations

import dataclasses

from jaxtyping import Array, Float

from cablejax.bounded.dogleg import BoundedDogleg
from cablejax.bounded.gauss_newton import BoundedGaussNewton
from cablejax.bounded.least_squares import AbstractBoundedLeastSquares
from cablejax.bounded.levenberg_marquardt import BoundedLevenbergMarquardt
from cablejax.bounded.solve import least_squares
from cablejax.mpc.plan import Plan, plan_from
from cablejax.mpc.problem import ShapingProblem
from cablejax.mpc.settings import check_budget, check_positive


@dataclasses.dataclass(frozen=True)
class TrustRegion:
    """Solver: damped Gauss-Newton models of the objective, minimised over the feasible set.

    Attributes:
        max_iterations: trial plans at most. One costs a linearisation, as much as about four gradients, and a rollout.
        tolerance: stop once a unit projected gradient step moves no coordinate by more than this [m].
        damping: at the start, relative to the diagonal of J'J.
        secant: whether the curvature of the residuals is learned: worth it beyond some five iterations, in float64.
    """

    max_iterations: int = 2
    tolerance: float = 2e-5
    damping: float = 1e-3
    secant: bool = False

    def __post_init__(self):
        check_budget(self, "max_iterations")
        check_positive(self, "tolerance", "damping")

    def __call__(self, problem: ShapingProblem, guess: Float[Array, "T Q 3"]) -> Plan:
        solver = BoundedLevenbergMarquardt(atol=self.tolerance, damping=self.damping, secant=self.secant)
        return _least_squares_plan(problem, solver, guess, self.max_iterations)


@dataclasses.dataclass(frozen=True)
class Dogleg:
    """Solver: a trust region around Gauss-Newton models, its steps along the dogleg inside the feasible set.

    Attributes:
        max_iterations: trial plans at most.
        tolerance: as in `TrustRegion` [m].
        secant: likewise.
    """

    max_iterations: int = 2
    tolerance: float = 2e-5
    secant: bool = False

    def __post_init__(self):
        check_budget(self, "max_iterations")
        check_positive(self, "tolerance")

    def __call__(self, problem: ShapingProblem, guess: Float[Array, "T Q 3"]) -> Plan:
        solver = BoundedDogleg(atol=self.tolerance, secant=self.secant)
        return _least_squares_plan(problem, solver, guess, self.max_iterations)


@dataclasses.dataclass(frozen=True)
class GaussNewton:
    """Solver: Gauss-Newton models without damping, minimised over the feasible set, and a line search towards that.

    Attributes:
        max_iterations: trial plans at most.
        tolerance: as in `TrustRegion` [m].
        secant: likewise.
    """

    max_iterations: int = 3
    tolerance: float = 2e-5
    secant: bool = False

    def __post_init__(self):
        check_budget(self, "max_iterations")
        check_positive(self, "tolerance")

    def __call__(self, problem: ShapingProblem, guess: Float[Array, "T Q 3"]) -> Plan:
        solver = BoundedGaussNewton(atol=self.tolerance, secant=self.secant)
        return _least_squares_plan(problem, solver, guess, self.max_iterations)


def _least_squares_plan(
    problem: ShapingProblem, solver: AbstractBoundedLeastSquares, guess: Float[Array, "T Q 3"], max_iterations: int
) -> Plan:
    """The plan that a bounded least squares solver finds from a guess; differentiable in the problem."""
    solution = least_squares(
        lambda motion, problem: problem.residuals(motion),
        solver,
        guess,
        problem.feasible,
        problem,
        linearise=lambda motion, problem: problem.linearise(motion),
        max_steps=max_iterations,
        throw=False,
    )
    return plan_from(solution)
