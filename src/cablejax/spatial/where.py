"""Where a simulation in space is off: along the cable, in which files, at which speeds."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from cablejax.diagnose.where import HORIZONS, LEVEL, Where
from cablejax.diagnose.where_words import describe
from cablejax.spatial.gap import RESOLVABLE, mean_of_finite, squares
from cablejax.spatial.geometry import LocalChange
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
    changes: Sequence[LocalChange],
) -> Where:
    """Keypoints, episodes and speeds at which the nominal simulator is off.

    Args:
        log: in space.
        windows: of the log.
        nominal: predictions of the nominal simulator at the log's samples [m].
        before: the same of the windows [m].
        noise: standard deviation of a coordinate [m].
        changes: of the set-up between recordings.
    """
    off = np.minimum(np.abs(np.asarray(log.keypoints, float) - nominal), 1.0)
    squared = squares(before, windows)

    def above(values, axis=None):
        return 1e3 * np.sqrt(np.maximum(mean_of_finite(values, axis) - noise**2, 0.0))

    episodes = np.full(len(log.keypoints), np.nan)
    for e in np.unique(windows.episode):
        episodes[e] = above(off[e] ** 2)
    speed = np.linalg.norm(np.diff(windows.position, axis=1, prepend=windows.position[:, :1]), axis=-1).max(axis=2)
    fast = (speed > np.median(speed[windows.valid]))[..., None, None]
    where = Where(
        gap_mm=float(above(squared)),
        smallest_mm=1e3 * RESOLVABLE * noise,
        along_cable_mm=np.nan_to_num(above(off**2, (0, 1, 3))),
        bend_per_m=None,
        per_episode_mm=episodes,
        episode_p=None,
        keypoint_p=None,
        heat=np.sqrt(mean_of_finite(off**2, -1)) / max(noise, 1e-6),
        horizons_mm=_by_time(squared, windows.interval, above),
        regimes={
            "speed: fast": float(above(np.where(fast, squared, np.nan))),
            "speed: slow": float(above(np.where(fast, np.nan, squared))),
        },
        frames={},
        contrasts={},
        regime_masks={},
        sentences=(),
    )
    arclength, names = np.asarray(log.meta["keypoint_arclength_m"]), [f"file {n}" for n in labels(log, "file", "take")]
    found = describe(where, arclength, np.array([noise]), LEVEL, names)
    return dataclasses.replace(where, sentences=(*(change.sentence for change in changes), *found))


def _by_time(squared, interval: float, above) -> dict[float, float]:
    """Gap [mm] by seconds since a window's beginning, each from the one before on."""
    result, before = {}, 0
    for horizon in HORIZONS:
        end = round(horizon / interval)
        if before < squared.shape[1]:
            result[horizon] = float(above(squared[:, before:end]))
        before = end
    return {horizon: size for horizon, size in result.items() if np.isfinite(size)}
