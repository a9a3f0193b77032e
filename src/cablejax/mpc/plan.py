"""Plans: the interface of planners, and derivatives with respect to the problem."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import jax
from jaxtyping import Array, Float, Int

from cablejax.bounded.certificate import Certificate, certify
from cablejax.bounded.implicit import with_derivatives
from cablejax.bounded.results import Solution
from cablejax.mpc.problem import Rollout, ShapingProblem


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Plan:
    """Result of a solver.

    Attributes:
        motion: feasible motions [m], shape [T, Q, 3].
        value: their objective [m^2], shape [].
        evaluations: rollouts of the model that were spent on trial plans, shape []; for `ProjectedGradient` the guess
            is one.
        result: a `bounded.Result`: how the solve ended, shape [].
        linearisations: gradients or Jacobians that were spent, shape []; None = the solver needs none.
        optimality: largest element of a unit projected gradient step [m] at the last plan whose gradient was taken,
            shape []; None = the solver takes none.
    """

    motion: Float[Array, "*batch T Q 3"]
    value: Float[Array, "*batch"]
    evaluations: Int[Array, "*batch"]
    result: Int[Array, "*batch"]
    linearisations: Int[Array, "*batch"] | None = None
    optimality: Float[Array, "*batch"] | None = None

    def certificate(self, problem: ShapingProblem) -> Certificate:
        """The first-order conditions of a minimum at the plan, from one gradient of the objective [m]."""
        return certify(jax.grad(problem.value)(self.motion), problem.feasible, self.motion)


class Solver(Protocol):
    """A hashable object, typically a frozen dataclass that is its own configuration, called inside compiled code."""

    def __call__(self, problem: ShapingProblem, guess: Rollout) -> Plan:
        """A plan no worse than the guess, which is feasible: see `ShapingProblem.start`."""
        ...


def plan_from(solution: Solution) -> Plan:
    """The plan that a bounded solve found."""
    return Plan(
        motion=solution.value,
        value=solution.objective,
        evaluations=solution.stats.evaluations,
        result=solution.result,
        linearisations=solution.stats.linearisations,
        optimality=solution.optimality,
    )


def differentiable_plan(problem: ShapingProblem, motion: Float[Array, "T Q 3"]) -> Float[Array, "T Q 3"]:
    """`motion` itself, with the derivatives that the minimum of the problem has in all arrays of `problem`.

    In forward and reverse mode, as the fixed point `u = P(u - grad J(u))`: also right where bounds are active. The
    motion must be a converged plan, from any solver. Takes one Hessian-vector product for each of its numbers.

    Args:
        problem: where its arrays are traced, they are differentiated in.
        motion: a minimum of it [m].
    """
    return with_derivatives(
        jax.lax.stop_gradient(motion), lambda motion, problem: problem.value(motion), problem.feasible, problem
    )
