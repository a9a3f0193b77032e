"""Point clouds of any size, made fit for compiled functions: finite, planar, of a fixed number of rows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float


class PaddedCloud(NamedTuple):
    """A cloud on the table in a fixed number of rows.

    Attributes:
        points: [m], zeros where `mask` is false, float32, shape [S, 2].
        mask: which rows are points, shape [S].
        dropped: points that were not finite.
    """

    points: Float[np.ndarray, "S 2"]
    mask: Bool[np.ndarray, " S"]
    dropped: int


def padded(points: Float[np.ndarray, "n D"], capacity: int) -> PaddedCloud:
    """The finite points of a cloud in `capacity` rows: a random part of them if there are more. Deterministic.

    Args:
        points: positions [m], shape [n, 2] or [n, 3], of which z is left out; n may be 0.
        capacity: rows S of the result, the same for every frame, so that nothing is compiled twice.

    Raises:
        ValueError: the points have another shape or are not numbers.
    """
    array = np.asarray(points)
    if array.size == 0:
        array = np.zeros((0, 2))
    if array.ndim != 2 or array.shape[1] not in (2, 3) or not np.issubdtype(array.dtype, np.number):
        raise ValueError(
            f"A cloud has shape {array.shape} and type {array.dtype}, expected numbers of shape [n, 2] or [n, 3]: one "
            "row per point, in metres, in the frame of the grippers."
        )
    finite = np.isfinite(array).all(axis=1)
    kept = array[finite, :2].astype(np.float32)
    if len(kept) > capacity:
        kept = kept[np.random.default_rng(0).choice(len(kept), capacity, replace=False)]
    rows = np.zeros((capacity, 2), np.float32)
    rows[: len(kept)] = kept
    return PaddedCloud(rows, np.arange(capacity) < len(kept), int(np.sum(~finite)))
