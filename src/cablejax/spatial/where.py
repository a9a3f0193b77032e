"""Localises the error of a simulation in space: along the cable, by file, and by speed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from cablejax.diagnose.where import HORIZONS, Where
from cablejax.diagnose.where_sizes import above, sizes_of
from cablejax.spatial.cable import bounded
from cablejax.spatial.gap import smallest_gap, squares
from cablejax.spatial.windows import Windows, labels
from cablejax.types import GapLog


def in_log(log: GapLog, windows: Windows, predicted: Float[np.ndarray, "W T F 3"]) -> Float[np.ndarray, "E T N 3"]:
    """Predictions at the log's samples; held keypoints as observed, NaN where nothing was predicted."""
    points = np.full(log.keypoints.shape, np.nan)
    first, last = windows.held[0], windows.n_keypoints - windows.held[1]
    for e, begin, valid, part in zip(windows.episode, windows.begin, windows.valid, predicted, strict=True):
        count = int(valid.sum())
        points[e, begin : begin + count] = log.keypoints[e, begin : begin + count]
        points[e, begin : begin + count, first:last] = part[:count]
    return points


def where_of(
    log: GapLog,
    windows: Windows,
    nominal: Float[np.ndarray, "E T N 3"],
    before: Float[np.ndarray, "W T F 3"],
    noise: float,
    changes: Sequence[str],
) -> Where:
    """Keypoints, episodes and speeds at which the nominal simulator is off.

    Args:
        log: in space.
        windows: of the log.
        nominal: predictions of the nominal simulator at the log's samples [m].
        before: the same of the windows [m].
        noise: standard deviation of a coordinate [m].
        changes: of the set-up between recordings, in words.
    """
    off = bounded(np.asarray(log.keypoints, float) - nominal) ** 2
    off = np.where(np.isfinite(log.keypoints) & np.isfinite(nominal), off, np.nan)
    squared = squares(before, windows)
    speed = np.linalg.norm(np.diff(windows.position, axis=1, prepend=windows.position[:, :1]), axis=-1).max(axis=2)
    fast = (speed > np.median(speed[windows.valid]))[..., None, None]
    return sizes_of(
        off,
        noise,
        np.asarray(log.meta["keypoint_arclength_m"]),
        smallest_mm=1e3 * smallest_gap(noise, windows),
        names=[f"file {name}" for name in labels(log, "file", "take")],
        gap_mm=float(above(squared, noise)),
        horizons_mm=_by_time(squared, windows.interval, noise),
        regimes={
            "speed: fast": float(above(np.where(fast, squared, np.nan), noise)),
            "speed: slow": float(above(np.where(fast, np.nan, squared), noise)),
        },
        first=changes,
    )


def _by_time(squared, interval: float, noise: float) -> dict[float, float]:
    """Gap [mm] by seconds since a window's beginning, each from the one before on."""
    result, before = {}, 0
    for horizon in HORIZONS:
        end = round(horizon / interval)
        if before < squared.shape[1]:
            result[horizon] = float(above(squared[:, before:end], noise))
        before = end
    return {horizon: size for horizon, size in result.items() if np.isfinite(size)}
