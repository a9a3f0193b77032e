"""A dynamics model and its residual, composed into one dynamics model."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from jaxtyping import Array, Float

from cablejax.residual.ridge import ResidualModel, apply
from cablejax.types import History

Dynamics = Callable[[Any, History, Float[Array, "Q 3"]], Float[Array, "N 2"]]
"""A one-step model `(weights, history, twist) -> X(t + 1) - X(t)` [m]; `weights` is any pytree of arrays."""


def slopes_of(dynamics: Dynamics) -> Dynamics:
    """What to differentiate in reverse mode where a good approximation of the Jacobian will do: the attribute `slopes`
    of a dynamics model that has one, of equal values and cheaper derivatives; otherwise the model itself."""
    return getattr(dynamics, "slopes", dynamics)


@dataclasses.dataclass(frozen=True)
class Corrected:
    """The dynamics `f(X, R) + R J + b` whose weights are the pair (weights of f, `ResidualModel`).

    Differentiable in whatever `dynamics` is differentiable in, and in the residual. Equal if their models are equal.

    Attributes:
        dynamics: f.
    """

    dynamics: Dynamics

    def __call__(
        self, weights: tuple[Any, ResidualModel], history: History, twist: Float[Array, "Q 3"]
    ) -> Float[Array, "N 2"]:
        offline, residual = weights
        return self.dynamics(offline, history, twist) + apply(residual, twist)

    @property
    def slopes(self) -> Dynamics:
        """That of `dynamics`, corrected."""
        return Corrected(slopes_of(self.dynamics))
