"""Planners on the bounded solvers, and every planner by its name."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar

import optimistix as optx

from cablejax.bounded.dogleg import BoundedDogleg
from cablejax.bounded.gauss_newton import BoundedGaussNewton
from cablejax.bounded.least_squares import AbstractBoundedLeastSquares
from cablejax.bounded.levenberg_marquardt import BoundedLevenbergMarquardt
from cablejax.bounded.solve import least_squares, minimise
from cablejax.bounded.spectral import SpectralProjectedGradient
from cablejax.limits import check
from cablejax.mpc.plan import Plan, Solver, plan_from
from cablejax.mpc.problem import Rollout, ShapingProblem
from cablejax.mpc.sampling import CrossEntropy, PathIntegral

# Step of `ProjectedGradient` before the first curvature is known. The objective's Hessian is near 1 per step of the
# horizon that a motion is felt in, and up to about 17 for the six-step sum, hence 0.1.
_INITIAL_STEP = 0.1


def bounded_plan(
    problem: ShapingProblem,
    guess: Rollout,
    solver: optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser,
    max_steps: int,
) -> Plan:
    """The plan that a bounded solver finds from a feasible guess, see `ShapingProblem.start`.

    Differentiable in the problem where it has converged.
    """

    def linearise(motion, given):
        problem, guess = given
        # the first linearisation is at the guess; if there are more, one extra rollout costs little
        return problem.linearise(motion, known=guess if max_steps == 1 else None)

    solution = least_squares(
        lambda motion, given: given[0].residuals(motion),
        solver,
        guess.motion,
        problem.feasible,
        (problem, guess),
        linearise=linearise,
        max_steps=max_steps,
        throw=False,
    )
    return plan_from(solution)


@dataclasses.dataclass(frozen=True)
class _LeastSquaresPlanner:
    """Common settings of these planners. None has a secant model: planning uses few steps.

    Attributes:
        max_iterations: linearisations at most; one costs as much as about ten rollouts.
        trials_per_linearisation: trial plans after each, a rollout each; the Jacobian follows them by Broyden's update.
        tolerance: stop once a unit projected gradient step moves no coordinate by more than this [m].
    """

    _bounded: ClassVar[type[AbstractBoundedLeastSquares]]

    max_iterations: int = 1
    trials_per_linearisation: int = 5
    tolerance: float = 2e-5

    def __post_init__(self):
        check(self, max_iterations="count", trials_per_linearisation="count", tolerance="positive")

    def __call__(self, problem: ShapingProblem, guess: Rollout) -> Plan:
        """The plan from a guess; differentiable in the problem where it has converged."""
        solver = self._bounded(
            atol=self.tolerance, secant=False, trials_per_linearisation=self.trials_per_linearisation
        )
        return bounded_plan(problem, guess, solver, self.max_iterations)


class LevenbergMarquardt(_LeastSquaresPlanner):
    """Solver: damped Gauss-Newton models of the objective, minimised over the feasible set."""

    _bounded = BoundedLevenbergMarquardt


class Dogleg(_LeastSquaresPlanner):
    """Solver: a trust region around Gauss-Newton models, its steps along the dogleg inside the feasible set."""

    _bounded = BoundedDogleg


class GaussNewton(_LeastSquaresPlanner):
    """Solver: Gauss-Newton models without damping, minimised over the feasible set, and a line search towards that."""

    _bounded = BoundedGaussNewton


@dataclasses.dataclass(frozen=True)
class ProjectedGradient:
    """Solver: gradient steps of Barzilai-Borwein length along the projection arc `P(u - s a g)`.

    Every evaluation costs one rollout, and an accepted one its gradient in reverse mode.

    Attributes:
        max_evaluations: trial plans, the guess included.
        tolerance: stop once a unit gradient step, projected, would move no coordinate by more than this [m].
        memory: a trial is compared with the worst of this many last accepted values (Grippo, Lampariello, Lucidi
            1986); 1 makes every accepted step a descent.
    """

    max_evaluations: int = 12
    tolerance: float = 2e-5
    memory: int = 1

    def __post_init__(self):
        check(self, max_evaluations="count", tolerance="positive", memory="count")
        if self.max_evaluations < 2:
            raise ValueError(
                f"ProjectedGradient.max_evaluations is {self.max_evaluations}, expected at least 2 evaluations: of the "
                "guess and of one step."
            )

    def __call__(self, problem: ShapingProblem, guess: Rollout) -> Plan:
        """Minimises the objective from `guess` and returns the plan."""
        solver = SpectralProjectedGradient(
            atol=self.tolerance, memory=self.memory, initial_length=_INITIAL_STEP, lengths=(1e-3, 1e2)
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


SOLVERS: Mapping[str, Solver] = MappingProxyType(
    {
        "levenberg-marquardt": LevenbergMarquardt(),
        "projected-gradient": ProjectedGradient(),
        "dogleg": Dogleg(),
        "gauss-newton": GaussNewton(),
        "two-trials": LevenbergMarquardt(trials_per_linearisation=2),
        "cross-entropy": CrossEntropy(),
        "path-integral": PathIntegral(),
    }
)
"""The planners by their names on the command line."""
