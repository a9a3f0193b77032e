"""A dynamics model and its residual, composed into one dynamics model."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from jaxtyping import Array, Float

from cablejax.residual.ridge import ResidualModel, apply
from cablejax.types import History

Dynamics = Callable[[Any, History, Float[Array, "Q 3"]], Float[Array, "N 2"]]
"""A one-step model `(weights, history, twist) -> X(t + 1) - X(t)` [m]; `weights` is any pytree of arrays."""


def corrected(dynamics: Dynamics) -> Dynamics:
    """The dynamics `f(X, R) + R J + b` whose weights are the pair (weights of f, `ResidualModel`).

    Differentiable in whatever `dynamics` is differentiable in, and in the residual.
    """

    def with_residual(
        weights: tuple[Any, ResidualModel], history: History, twist: Float[Array, "Q 3"]
    ) -> Float[Array, "N 2"]:
        offline, residual = weights
        return dynamics(offline, history, twist) + apply(residual, twist)

    return with_residual
