"""Result codes of bounded solves, their statistics, and their solution."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, Int

from cablejax.bounded.certificate import Certificate, certify
from cablejax.bounded.objective import value_of
from cablejax.bounded.sets import AbstractSet


class Result(enum.IntEnum):
    """Result code of a solve, from the solvers to the controller's report. Inside compiled code it is an int32."""

    CONVERGED = 0
    """The projected gradient is within the tolerance."""
    STEP_LIMIT = 1
    """The steps were used up."""
    NONFINITE = 2
    """The function or its derivatives gave NaN or infinity where the solve could not go round."""
    EMPTY_SET = 3
    """The bounds contradict each other: there is no feasible point."""
    STALLED = 4
    """No step improves the function by more than rounding, though the projected gradient is above the tolerance."""

    @property
    def message(self) -> str:
        """The result as a sentence that says what to do."""
        return _MESSAGES[self]


_MESSAGES = {
    Result.CONVERGED: "Converged: the projected gradient is within the tolerance.",
    Result.STEP_LIMIT: "The steps were used up, the projected gradient is still above the tolerance: raise max_steps.",
    Result.NONFINITE: "The start, the function or its derivatives are NaN or infinite: check them at and near "
    "`solution.value`.",
    Result.EMPTY_SET: "The bounds contradict each other: there is no feasible point.",
    Result.STALLED: "No step improves the function by more than rounding: use float64, or a greater tolerance.",
}

_OF_OPTIMISTIX = (
    (optx.RESULTS.successful, Result.CONVERGED),
    (optx.RESULTS.nonfinite, Result.NONFINITE),
    (optx.RESULTS.stagnation, Result.STALLED),
)


def result_of(theirs: optx.RESULTS) -> Int[Array, ""]:
    """The `Result` of a solve by optimistix; `STEP_LIMIT` for all codes that these solvers do not set."""
    code = jnp.asarray(Result.STEP_LIMIT, jnp.int32)
    for result, ours in _OF_OPTIMISTIX:
        code = jnp.where(theirs == result, ours, code)
    return code


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Stats:
    """Cost of a solve; every field has shape [].

    Attributes:
        iterations: steps of the solver.
        evaluations: of the function alone.
        linearisations: gradients or Jacobians.
    """

    iterations: Int[Array, "*batch"]
    evaluations: Int[Array, "*batch"]
    linearisations: Int[Array, "*batch"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Solution:
    """Solution of `minimise` and `least_squares`.

    Attributes:
        value: the best feasible point found.
        objective: the function there (half the sum of squares), differentiable where `value` is, shape [].
        result: a `Result`, shape [].
        stats: what it cost.
        optimality: largest element of `P(y - g) - y` at the last point whose gradient was taken, shape [].
    """

    value: Float[Array, "*shape"]
    objective: Float[Array, "*batch"]
    result: Int[Array, "*batch"]
    stats: Stats
    optimality: Float[Array, "*batch"]

    def certificate(self, fn: Callable[[Array, Any], Array], feasible: AbstractSet, args: Any = None) -> Certificate:
        """The first-order conditions at `value`, from the gradient of `fn` there; of residuals, half their squares'."""

        def objective(y):
            return value_of(fn(y, args))

        return certify(jax.grad(objective)(self.value), feasible, self.value)
