"""Plans by the bounded least squares solvers."""

from __future__ import annotations

import abc
import dataclasses

from cablejax.bounded.dogleg import BoundedDogleg
from cablejax.bounded.gauss_newton import BoundedGaussNewton
from cablejax.bounded.least_squares import AbstractBoundedLeastSquares
from cablejax.bounded.levenberg_marquardt import BoundedLevenbergMarquardt
from cablejax.mpc.bounded_plan import bounded_plan
from cablejax.mpc.plan import Plan
from cablejax.mpc.problem import ShapingProblem
from cablejax.mpc.rollout import Rollout
from cablejax.mpc.settings import check_budget, check_positive


@dataclasses.dataclass(frozen=True)
class _LeastSquaresPlanner(abc.ABC):
    """What these planners share.

    Attributes:
        max_iterations: linearisations at most; one costs as much as about ten rollouts.
        trials_per_linearisation: trial plans after each, a rollout each; the Jacobian follows them by Broyden's update.
        tolerance: stop once a unit projected gradient step moves no coordinate by more than this [m].
    """

    max_iterations: int = 1
    trials_per_linearisation: int = 5
    tolerance: float = 2e-5

    def __post_init__(self):
        check_budget(self, "max_iterations")
        check_budget(self, "trials_per_linearisation")
        check_positive(self, "tolerance")

    @abc.abstractmethod
    def bounded(self) -> AbstractBoundedLeastSquares:
        """The solver that finds the plan."""

    def __call__(self, problem: ShapingProblem, guess: Rollout) -> Plan:
        """The plan from a guess; differentiable in the problem where it has converged."""
        return bounded_plan(problem, guess, self.bounded(), self.max_iterations)


@dataclasses.dataclass(frozen=True)
class TrustRegion(_LeastSquaresPlanner):
    """Solver: damped Gauss-Newton models of the objective, minimised over the feasible set.

    Attributes:
        max_iterations, trials_per_linearisation, tolerance: see `_LeastSquaresPlanner`.
        damping: at the start, relative to the diagonal of J'J.
    """

    damping: float = dataclasses.field(default=1e-3, kw_only=True)

    def __post_init__(self):
        super().__post_init__()
        check_positive(self, "damping")

    def bounded(self) -> AbstractBoundedLeastSquares:
        return BoundedLevenbergMarquardt(
            atol=self.tolerance,
            damping=self.damping,
            secant=False,
            trials_per_linearisation=self.trials_per_linearisation,
        )


class Dogleg(_LeastSquaresPlanner):
    """Solver: a trust region around Gauss-Newton models, its steps along the dogleg inside the feasible set."""

    def bounded(self) -> AbstractBoundedLeastSquares:
        return BoundedDogleg(atol=self.tolerance, secant=False, trials_per_linearisation=self.trials_per_linearisation)


@dataclasses.dataclass(frozen=True)
class GaussNewton(_LeastSquaresPlanner):
    """Solver: Gauss-Newton models without damping, minimised over the feasible set, and a line search towards that."""

    def bounded(self) -> AbstractBoundedLeastSquares:
        return BoundedGaussNewton(atol=self.tolerance, trials_per_linearisation=self.trials_per_linearisation)
