"""A dynamics model and its residual, composed into one dynamics model."""

from __future__ import annotations

import dataclasses
from typing import Any

from jaxtyping import Array, Float

from cablejax.residual.jacobian import Dynamics, StepJacobian, step_jacobian
from cablejax.residual.ridge import ResidualModel, apply
from cablejax.types import History


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
        """Displacement by the offline model plus the residual [m], shape [N, 2]."""
        offline, residual = weights
        return self.dynamics(offline, history, twist) + apply(residual, twist)

    def jacobian(
        self, weights: tuple[Any, ResidualModel], history: History, twist: Float[Array, "Q 3"]
    ) -> StepJacobian:
        """F's own, and J."""
        offline, residual = weights
        of_f = step_jacobian(self.dynamics, offline, history, twist)
        return of_f._replace(twist=of_f.twist + residual.gain.T.reshape(of_f.twist.shape))
