"""Array helpers for all stages: checks, flags, choices, unobserved points, angles, lengths, turns, quaternions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int


def real(values: object, what: str) -> np.ndarray:
    """The values in double precision, as a new array.

    Raises:
        ValueError: they are not real numbers; `what` begins the message, for example "The actions have".
    """
    try:
        array = np.asarray(values)
        if array.dtype.kind in "biuf":
            return array.astype(float)
        came = "complex values" if array.dtype.kind == "c" else f"values of type {array.dtype}"
    except ValueError:
        came = "rows of different lengths"
    raise ValueError(f"{what} {came}, expected real numbers.")


def stretches(flags: Bool[np.ndarray, " T"]) -> Int[np.ndarray, "S 2"]:
    """Begin and end (exclusive) of each stretch of samples in which a flag is set."""
    return np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int))).reshape(-1, 2)


def filled(points: Float[np.ndarray, "N D"]) -> Float[np.ndarray, "N D"]:
    """Points with NaN interpolated between their neighbours in the order of the points; at least one must be finite."""
    seen, index = np.isfinite(points).all(axis=1), np.arange(len(points))
    return np.stack([np.interp(index, index[seen], column[seen]) for column in points.T], axis=1)


def evenly(count: int, most: int) -> list[int]:
    """Indices of up to `most` of `count` things, evenly spread, the first and the last among them."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(int).tolist()


def mean_of_finite(values: np.ndarray, axis: tuple[int, ...] | int | None) -> np.ndarray:
    """Mean of the finite values; NaN where there are none."""
    seen = np.isfinite(values)
    count = seen.sum(axis=axis)
    return np.where(count > 0, np.where(seen, values, 0.0).sum(axis=axis) / np.maximum(count, 1), np.nan)


def wrapped(angle):
    """The same angle within [-pi, pi) [rad]. NumPy in, NumPy out; JAX in, JAX out."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def rms_length(vectors: Float[Any, "*B N D"]) -> Float[Any, "*B"]:
    """Root mean square length of N vectors. NumPy in, NumPy out; JAX in, JAX out."""
    xp = vectors.__array_namespace__()
    return xp.sqrt(xp.mean(xp.sum(vectors**2, axis=-1), axis=-1))


def quarter_turn(vectors: Float[Any, "*B 2"]) -> Float[Any, "*B 2"]:
    """Vectors of the plane, turned by a quarter to the left. NumPy in, NumPy out; JAX in, JAX out."""
    return vectors.__array_namespace__().stack([-vectors[..., 1], vectors[..., 0]], axis=-1)


def turns(vectors: Float[Any, "*B N 2"]) -> Float[Any, "*B N1"]:
    """Angle from each vector of the plane to the next [rad]. NumPy in, NumPy out; JAX in, JAX out."""
    xp, a, b = vectors.__array_namespace__(), vectors[..., :-1, :], vectors[..., 1:, :]
    return xp.arctan2(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0], xp.sum(a * b, axis=-1))


def quaternion_product(a: Float[Any, "*B 4"], b: Float[Any, "*B 4"]) -> Float[Any, "*B 4"]:
    """Hamilton product, scalar first. NumPy in, NumPy out; JAX in, JAX out."""
    xp = a.__array_namespace__()
    scalar = a[..., :1] * b[..., :1] - xp.sum(a[..., 1:] * b[..., 1:], axis=-1, keepdims=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + xp.cross(a[..., 1:], b[..., 1:])
    return xp.concatenate([scalar, vector], axis=-1)


def positions_at(
    at: Float[np.ndarray, " G"], time: Float[np.ndarray, " T"], position: Float[np.ndarray, "T *B"]
) -> Float[np.ndarray, "G *B"]:
    """Positions at other times, by linear interpolation; constant before the first and after the last."""
    columns = [np.interp(at, time, column) for column in position.reshape(len(position), -1).T]
    return np.stack(columns, axis=1).reshape(len(at), *position.shape[1:])
