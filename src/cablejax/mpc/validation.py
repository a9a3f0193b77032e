"""Validates users' input: targets, histories, measurements."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from cablejax.types import History, Measurement

# Grippers may be farther apart than the cable is long by noise and by the offset of a tool, not by this factor.
_FAR = 2.0
# Between fewer keypoints a cable may be folded, and measure as little along them as a far shorter one.
_FEWEST = 6


def check_target(target: Float[Array | np.ndarray, "*batch N 2"]) -> None:
    """Raises ValueError unless the target is an array of finite keypoints [N, 2], N at least 3: fewer have no shape.

    Neighbours at one point are refused too: no direction leads from one to the other, and its derivative is NaN.
    """
    if not isinstance(target, (np.ndarray, jax.Array)):
        raise ValueError(
            f"The target is a {type(target).__name__}, expected an array of keypoints [N, 2]"
            f"{': its `keypoints`' if hasattr(target, 'keypoints') else ''}."
        )
    shape = np.shape(target)
    finite = isinstance(target, Tracer) or bool(np.isfinite(target).all())
    fault = " and complex values" if np.iscomplexobj(target) else "" if finite else " with non-finite values"
    if len(shape) < 2 or shape[-2] < 3 or shape[-1] != 2 or fault:
        raise ValueError(
            f"The target has shape {shape}{fault}, expected finite real keypoints [N, 2] in metres, three or more."
        )
    if not isinstance(target, Tracer) and (same := np.argwhere((np.diff(target, axis=-2) == 0).all(axis=-1))).size:
        first = int(same[0, -1])
        raise ValueError(
            f"The target's keypoints {first} and {first + 1} are at one point, expected keypoints along a cable, each "
            "away from the one before: sample the shape again."
        )


def check_history(target: Float[Array | np.ndarray, "N 2"], history: History) -> None:
    """Raises ValueError unless the history has a sample, fits the target's number of keypoints, and is finite."""
    _check_floating("The history's keypoints", history.keypoints)
    _check_floating("The history's gripper poses", history.gripper_pose)
    if np.ndim(history.keypoints) != 3 or len(history.keypoints) < 1:
        raise ValueError(
            f"The history has keypoints of shape {np.shape(history.keypoints)}, expected [H, N, 2] with at least one "
            "sample: repeat the first observation H times for a cable at rest."
        )
    check_measurement(target, Measurement(history.keypoints[-1], history.gripper_pose))
    given = [leaf for leaf in (history.keypoints, history.gripper_pose) if not isinstance(leaf, Tracer)]
    if not all(np.isfinite(leaf).all() for leaf in given):
        raise ValueError("The initial history has non-finite values: start from a complete observation.")


def check_reach(length: float, history: History) -> None:
    """Raises ValueError if a cable of this length [m] does not reach to the grippers, or is far longer than seen."""
    pose, points = history.gripper_pose, history.keypoints
    if isinstance(pose, Tracer) or isinstance(points, Tracer):
        return
    apart = float(np.linalg.norm(np.asarray(pose[0, :2] - pose[1, :2])))
    along = float(np.linalg.norm(np.diff(np.asarray(points[-1]), axis=0), axis=-1).sum())
    if len(points[-1]) >= _FEWEST and along * _FAR < length:
        raise ValueError(
            f"The cable measures {along:.3g} m along its keypoints, but MPCConfig.cable_length is {length:g} m: use "
            "`MPCConfig.for_length`, and keypoints in metres."
        )
    if apart > _FAR * length:
        raise ValueError(
            f"The grippers are {apart:.3g} m apart, but the cable is {length:g} m long (`MPCConfig.for_length`): "
            "expected poses and keypoints in metres."
        )


def check_dynamics(dynamics: Callable[..., Any], weights: Any, history: History) -> None:
    """Raises ValueError unless a model can be called, and gives a displacement [N, 2] for every keypoint."""
    twist = jnp.zeros((2, 3), history.keypoints.dtype)
    try:
        given = jax.eval_shape(dynamics, weights, history, twist)
    except (TypeError, AttributeError) as error:
        raise ValueError(
            f"The model could not be called: {error} Expected `dynamics(weights, history, twist)` for one cable."
        ) from error
    shape, expected = getattr(given, "shape", None), history.keypoints.shape[1:]
    if shape != expected:
        what = f"an array of shape {shape}" if shape is not None else type(given).__name__
        raise ValueError(f"The model gave {what}, expected displacements [m] of shape {expected}.")


def check_measurement(target: Float[Array | np.ndarray, "N 2"], measurement: Measurement) -> None:
    """Raises ValueError unless a measurement has the shape of the target's keypoints and of two grippers' poses."""
    keypoints, gripper_pose, twist = measurement
    _check_floating("Measured keypoints", keypoints)
    _check_floating("Measured gripper poses", gripper_pose)
    if keypoints.shape != np.shape(target) or gripper_pose.shape != (2, 3):
        raise ValueError(
            f"Measurement with keypoints {keypoints.shape} and gripper poses {gripper_pose.shape}, "
            f"expected {np.shape(target)} as the target and (2, 3)."
        )
    if twist is not None and np.shape(twist) != (2, 3):
        raise ValueError(f"Measurement with a twist of shape {np.shape(twist)}, expected (2, 3).")


def _check_floating(what: str, value: object) -> None:
    kind = f"an array of {value.dtype}" if isinstance(value, (np.ndarray, jax.Array)) else type(value).__name__
    if not (isinstance(value, (np.ndarray, jax.Array)) and np.issubdtype(value.dtype, np.floating)):
        raise ValueError(
            f"{what} are {kind}, expected an array of floating-point numbers: convert them with "
            "`numpy.asarray(values, float)`."
        )
