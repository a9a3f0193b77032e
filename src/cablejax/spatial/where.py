"""Where a simulation in space is off: along the cable, in which files, at which speeds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from cablejax.diagnose.where import Where
from cablejax.report.effect_words import millimetres
from cablejax.spatial.gap import RESOLVABLE, errors_ahead, mean_of_finite, squares
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
    level = max(noise, 1e-6)
    along = 1e3 * np.sqrt(np.nan_to_num(mean_of_finite(off**2, (0, 1, 3))))
    episodes = np.full(len(log.keypoints), np.nan)
    for e in np.unique(windows.episode):
        episodes[e] = 1e3 * float(np.sqrt(mean_of_finite(off[e] ** 2, None)))
    arclength = log.meta["keypoint_arclength_m"]
    speed = np.linalg.norm(np.diff(windows.position, axis=1, prepend=windows.position[:, :1]), axis=-1).max(axis=2)
    fast = (speed > np.median(speed[windows.valid]))[..., None, None] & np.isfinite(squared)
    regimes = {
        "speed: fast": 1e3 * float(np.sqrt(squared[fast].mean())),
        "speed: slow": 1e3 * float(np.sqrt(squared[~fast & np.isfinite(squared)].mean())),
    }
    worst = int(np.nanargmax(episodes))
    names = labels(log, "file", "take")
    sentences = [change.sentence for change in changes]
    sentences += [
        f"The gap is largest at keypoint {int(along.argmax())}, {arclength[int(along.argmax())]:.2f} m along the "
        f"cable: {millimetres(along.max())}. A cable held at both ends deviates most in its middle whatever the cause.",
        f"The worst file is {names[worst]} with {millimetres(episodes[worst])}; the median file has "
        f"{millimetres(np.nanmedian(episodes))}.",
        f"While the grippers move fast the gap is {millimetres(regimes['speed: fast'])}, slowly "
        f"{millimetres(regimes['speed: slow'])}.",
    ]
    missing = np.ones(len(episodes))
    return Where(
        gap_mm=1e3 * float(np.sqrt(np.nanmean(squared))),
        smallest_mm=1e3 * RESOLVABLE * level,
        along_cable_mm=along,
        bend_per_m=np.zeros(len(along) - 2),
        per_episode_mm=episodes,
        episode_p=np.where(episodes > 1e3 * RESOLVABLE * level, 0.0, missing),
        keypoint_p=np.where(along > 1e3 * RESOLVABLE * level, 0.0, 1.0),
        heat=np.sqrt(mean_of_finite(off**2, -1)) / level,
        horizons_mm=errors_ahead(squared, windows.interval),
        regimes=regimes,
        frames={},
        contrasts={},
        regime_masks={},
        sentences=tuple(sentences),
    )
