"""One-step models: their interface, their derivatives, and their correction by a learned residual."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cablejax.residual.ridge import ResidualModel, apply
from cablejax.types import History

Dynamics = Callable[[Any, History, Float[Array, "Q 3"]], Float[Array, "N 2"]]
"""A one-step model `(weights, history, twist) -> X(t + 1) - X(t)` [m]; `weights` is any pytree of arrays."""


class Linearised(NamedTuple):
    """A one-step model linearised at zero command, `f(X, R) ~ drift + gain R`; several steps have a leading axis W.

    Attributes:
        drift: its displacement without a command, f(X, 0) [m], shape [N, 2].
        gain: its derivative by the command, there [m / (m/s)] and [m / (rad/s)], shape [N, 2, Q, 3].
    """

    drift: Float[Array, "*batch N 2"]
    gain: Float[Array, "*batch N 2 Q 3"]


def linearised(dynamics: Dynamics, weights: Any, history: History, *, with_gain: bool) -> Linearised:
    """Linearises a model at zero command: one evaluation, and 3Q forward-mode tangents in one batch for the gain.

    Args:
        dynamics: the model.
        weights: its arrays.
        history: where it is evaluated.
        with_gain: whether the gain is needed; it is zero otherwise.
    """
    rest = jnp.zeros_like(history.gripper_pose)

    def twice(twist: Float[Array, "Q 3"]):
        displacement = dynamics(weights, history, twist)
        return displacement, displacement

    if with_gain:
        gain, drift = jax.jacfwd(twice, has_aux=True)(rest)
        return Linearised(drift, gain)
    drift = dynamics(weights, history, rest)
    return Linearised(drift, jnp.zeros((*drift.shape, *rest.shape), drift.dtype))


class StepJacobian(NamedTuple):
    """Derivatives of a step's displacement [m].

    Attributes:
        keypoints: by the history's keypoints [m], shape [N, 2, H, N, 2].
        gripper_pose: by the grippers' poses [m, rad], shape [N, 2, Q, 3].
        twist: by the command [m/s, rad/s], shape [N, 2, Q, 3].
    """

    keypoints: Float[Array, "N 2 H N 2"]
    gripper_pose: Float[Array, "N 2 Q 3"]
    twist: Float[Array, "N 2 Q 3"]


def step_jacobian(dynamics: Dynamics, weights: Any, history: History, twist: Float[Array, "Q 3"]) -> StepJacobian:
    """The derivatives of `dynamics(weights, history, twist)`, in reverse mode.

    A model with a method `jacobian` of the same arguments knows a cheaper way, and how exact that is.
    """
    cheaper = getattr(dynamics, "jacobian", None)
    if cheaper is not None:
        return cheaper(weights, history, twist)
    return reverse(lambda history, twist: dynamics(weights, history, twist), history, twist)


def reverse(
    displacement: Callable[[History, Float[Array, "Q 3"]], Float[Array, "n 2"]],
    history: History,
    twist: Float[Array, "Q 3"],
) -> StepJacobian:
    """The derivatives of any n rows of a displacement, 2n cotangents in one batch."""

    def rows(keypoints, gripper_pose, twist):
        return displacement(dataclasses.replace(history, keypoints=keypoints, gripper_pose=gripper_pose), twist)

    return StepJacobian(*jax.jacrev(rows, argnums=(0, 1, 2))(history.keypoints, history.gripper_pose, twist))


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
        """Derivatives of f, and J."""
        offline, residual = weights
        of_f = step_jacobian(self.dynamics, offline, history, twist)
        return of_f._replace(twist=of_f.twist + residual.gain.T.reshape(of_f.twist.shape))
