"""What a solver of the planning problem takes and returns, and how a solve ended."""

from __future__ import annotations

import dataclasses
import enum
from typing import TYPE_CHECKING, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from cablejax.bounded.certificate import Certificate, certify
from cablejax.bounded.results import Result, Solution

if TYPE_CHECKING:
    from cablejax.mpc.problem import ShapingProblem
    from cablejax.mpc.rollout import Rollout


class Outcome(enum.IntEnum):
    """How a solve ended. Inside compiled code it is an int32."""

    CONVERGED = 0
    """No feasible direction improves the plan by more than the tolerance."""
    STEP_LIMIT = 1
    """The evaluation budget was used up; the plan is feasible and no worse than the guess."""
    HELD = 2
    """The plan would hardly improve on holding still: the grippers hold."""
    NONFINITE = 3
    """The model or the observation gave NaN or infinity: the grippers hold."""
    RESTARTING = 4
    """The error stayed where it is, as in another shape between the same grippers: the cable is straightened first."""
    INFEASIBLE = 5
    """The bounds contradict each other: there is no feasible plan, and the grippers hold."""
    STALLED = 6
    """No step improves the plan by more than rounding can tell; it is feasible and no worse than the guess."""

    @property
    def message(self) -> str:
        """The outcome as one sentence, for people."""
        return _MESSAGES[self]


_MESSAGES = {
    Outcome.CONVERGED: "Converged: no feasible change improves the plan by more than the tolerance.",
    Outcome.STEP_LIMIT: "The budget was used up; the plan is feasible and no worse than the guess. Raise the limit.",
    Outcome.HELD: "Holding still is as good as the best plan found.",
    Outcome.NONFINITE: "The model gave NaN or infinity; the grippers hold. Check weights, history and target.",
    Outcome.RESTARTING: "The cable is being straightened: it was in another shape than the target's.",
    Outcome.INFEASIBLE: "The bounds contradict each other; the grippers hold. Check distances, radius and workspace.",
    Outcome.STALLED: "No step improves the plan by more than rounding; use float64 for a smaller tolerance.",
}

_OUTCOMES = {
    Result.CONVERGED: Outcome.CONVERGED,
    Result.STEP_LIMIT: Outcome.STEP_LIMIT,
    Result.NONFINITE: Outcome.NONFINITE,
    Result.EMPTY_SET: Outcome.INFEASIBLE,
    Result.STALLED: Outcome.STALLED,
}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Plan:
    """What a solver returns.

    Attributes:
        motion: feasible motions [m], shape [T, Q, 3].
        value: their objective [m^2], shape [].
        evaluations: rollouts of the model that were spent on trial plans, shape [].
        outcome: an `Outcome`, shape [].
        linearisations: gradients or Jacobians that were spent, shape []; None = the solver needs none.
        optimality: largest element of a unit projected gradient step [m] at the last plan whose gradient was taken,
            shape []; None = the solver takes none.
    """

    motion: Float[Array, "*batch T Q 3"]
    value: Float[Array, "*batch"]
    evaluations: Int[Array, "*batch"]
    outcome: Int[Array, "*batch"]
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
    outcome = jnp.asarray(Outcome.STEP_LIMIT, jnp.int32)
    for result, ours in _OUTCOMES.items():
        outcome = jnp.where(solution.result == result, ours, outcome)
    return Plan(
        motion=solution.value,
        value=solution.objective,
        evaluations=solution.stats.evaluations,
        outcome=outcome.astype(jnp.int32),
        linearisations=solution.stats.linearisations,
        optimality=solution.optimality,
    )
