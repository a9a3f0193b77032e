"""How a solve ended, what it cost, and what a solver is."""

from __future__ import annotations

import dataclasses
import enum
from typing import TYPE_CHECKING, Protocol

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, Int

if TYPE_CHECKING:
    from cablejax.mpc.problem import ShapingProblem


class Outcome(enum.IntEnum):
    """How a solve ended. Inside compiled code it is an int32."""

    CONVERGED = 0
    """No feasible direction improves the plan by more than the tolerance, or than rounding can tell."""
    STEP_LIMIT = 1
    """The evaluation budget was used up; the plan is feasible and no worse than the guess."""
    HELD = 2
    """The plan would hardly improve on holding still: the grippers hold."""
    NONFINITE = 3
    """The model or the observation gave NaN or infinity: the grippers hold."""
    TRAVELLING = 4
    """No plan was better than holding, far from where the target's ends are held: the grippers go there."""
    INFEASIBLE = 5
    """The bounds contradict each other: there is no feasible plan, and the grippers hold."""
    SINGULAR = 6
    """The Gauss-Newton matrix is singular and the solver does not damp it: the plan is the last feasible one."""
    NO_ROOM = 7
    """The bound on one step is zero: the only plan is to hold."""
    OUTSIDE = 8
    """The grippers start beyond their bounds: the plan is the best of those that bring them back at once."""

    @property
    def message(self) -> str:
        """The outcome as one sentence, for people."""
        return _MESSAGES[self]


_MESSAGES = {
    Outcome.CONVERGED: "Converged: no feasible change improves the plan by more than the tolerance.",
    Outcome.STEP_LIMIT: "The budget was used up; the plan is feasible and no worse than the guess. Raise the limit.",
    Outcome.HELD: "Holding still is as good as the best plan found.",
    Outcome.NONFINITE: "The model gave NaN or infinity; the plan is the last feasible one. Check weights and history.",
    Outcome.TRAVELLING: "The grippers travel to where the target's ends are held.",
    Outcome.INFEASIBLE: "The bounds contradict each other; nothing was planned. Check distances, radius and workspace.",
    Outcome.SINGULAR: "The Gauss-Newton matrix is singular: use TrustRegion or Dogleg, or a positive motion_weight.",
    Outcome.NO_ROOM: "The bound on one step is zero: the only plan is to hold.",
    Outcome.OUTSIDE: "The grippers start outside their bounds; the plan brings them back.",
}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Plan:
    """What a solver returns.

    Attributes:
        motion: feasible motions [m], shape [T, Q, 3].
        evaluations: rollouts of the model that were spent on trial plans, shape [].
        outcome: an `Outcome`, shape [].
        linearisations: gradients or Jacobians that were spent, shape []; None = the solver needs none.
        optimality: largest move of one gripper under a unit projected gradient step [m], at the last plan whose
            gradient was taken, shape []; None = the solver takes none.
    """

    motion: Float[Array, "*batch T Q 3"]
    evaluations: Int[Array, "*batch"]
    outcome: Int[Array, "*batch"]
    linearisations: Int[Array, "*batch"] | None = None
    optimality: Float[Array, "*batch"] | None = None


class Solver(Protocol):
    """A hashable object, typically a frozen dataclass that is its own configuration, called inside compiled code."""

    def __call__(self, problem: ShapingProblem, guess: Float[Array, "T Q 3"]) -> Plan:
        """A plan no worse than `problem.feasible.project(guess)`."""
        ...


def outcome_of(result: optx.RESULTS) -> Int[Array, ""]:
    """The outcome that an optimistix result stands for."""
    known = (
        (optx.RESULTS.successful, Outcome.CONVERGED),
        (optx.RESULTS.nonfinite, Outcome.NONFINITE),
        (optx.RESULTS.singular, Outcome.SINGULAR),
    )
    code = jnp.asarray(Outcome.STEP_LIMIT, jnp.int32)
    for candidate, outcome in known:
        code = jnp.where(result == candidate, outcome, code)
    return code.astype(jnp.int32)
