"""Error of a simulation on the recorded windows: its size, its place, and its shrinkage by an explanation."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from cablejax.arrays import mean_of_finite
from cablejax.diagnose.belief import Calibration
from cablejax.diagnose.diagnosis import Gap
from cablejax.diagnose.evidence import Evidence
from cablejax.diagnose.gap import measure_gap
from cablejax.diagnose.protocol import Explanation, explanation
from cablejax.diagnose.where import HORIZONS, Where, above, sizes_of
from cablejax.gaplog import labels
from cablejax.spatial.cable import SpatialCable, bounded
from cablejax.spatial.growing import SHARES, early
from cablejax.spatial.windows import Windows
from cablejax.types import GapLog

RESOLVABLE = 3.0
"""An error up to so many times the noise is none."""

SURE_OF_OWN = 1.5
"""Nor up to so many times what noise in the beginning of windows and the rod's edges cause."""

OWN = Calibration().smallest_gap(0.0)
"""Nor is one that the simulator may have by itself [m], of a cable of up to a metre: as on a table."""


def smallest_gap(noise: float, windows: Windows, own: float = 0.0) -> float:
    """The smallest root mean square error of a coordinate that counts as a gap [m]; larger for longer cables.

    Args:
        noise: standard deviation of a coordinate [m].
        windows: of the cable.
        own: error that nothing in the cable causes, see `own_error` [m].
    """
    return float(np.linalg.norm([RESOLVABLE * noise, OWN * max(1.0, windows.arclength[-1]), SURE_OF_OWN * own]))


def with_gap(
    cable: SpatialCable, nominal: Float[np.ndarray, "W T F 3"], noise: float
) -> tuple[SpatialCable, float, float]:
    """The cable in the longest beginnings of its windows in which there is a gap; in whole windows if there is none.

    An undamped, soft nominal cable may amplify noise until it is as far off as the true cable. Its error before that
    still shows what it has wrong.

    Args:
        cable: nominal, with the edges of predictions.
        nominal: its motion in the windows [m].
        noise: standard deviation of a coordinate [m].

    Returns:
        The cable, the smallest error there that counts as a gap [m], and the error of its own, see `own_error` [m].
    """
    found = []
    for share in (1.0, *SHARES[::-1]):
        part = early(cable, share)
        own = own_error(part, explanation(), nominal, noise)
        found.append((part, smallest_gap(noise, cable.windows, own), own))
        if is_gap(nominal, part.windows, found[-1][1]):
            return found[-1]
    return found[0]


def is_gap(nominal: Float[np.ndarray, "W T F 3"], windows: Windows, smallest: float) -> bool:
    """Whether the nominal simulator's error in the windows, root mean square, is larger than this [m]."""
    squared = squares(nominal, windows)
    seen = np.isfinite(squared)
    return bool(squared[seen].sum() > smallest**2 * seen.sum())


def own_error(cable: SpatialCable, one: Explanation, motion: Float[np.ndarray, "W T F 3"], noise: float) -> float:
    """The error of a coordinate that the simulation has by itself, root mean square [m].

    A window begins with the shape and the velocity that its first two samples show, and noise makes both wrong: by as
    much noise again. And the rod has edges, whose error the next order of their extrapolation shows.

    Args:
        cable: with the edges of predictions.
        one: what is simulated; nothing for the nominal cable.
        motion: what it simulates in the windows [m].
        noise: standard deviation of a coordinate [m].
    """

    def size(off: Float[np.ndarray, "W T F 3"]) -> float:
        return float(np.sqrt(np.mean(bounded(off)[cable.windows.valid] ** 2)))

    points = cable.windows.keypoints.copy()
    points[:, :2] += np.random.default_rng(0).normal(0.0, noise, points[:, :2].shape)
    begun = cable.on(dataclasses.replace(cable.windows, keypoints=points))
    return float(np.hypot(size(begun.motion(one) - motion), size(cable.left_by_edges(one))))


def constant_offset(predicted: Float[np.ndarray, "W T F 3"], windows: Windows) -> float:
    """Constant offset of the markers [m]: root mean square over coordinates of their mean error in a recording.

    Markers that sit off the centreline, or off their stated places, are part of it, and so is what the simulator has
    wrong at rest; the noise has none of it.
    """
    off = np.where(np.isfinite(windows.observed), windows.observed - predicted, np.nan)
    means = []
    for group in np.unique(windows.group):
        mean = mean_of_finite(off[windows.group == group].reshape(-1, *off.shape[2:]), 0)
        means.append(mean[np.isfinite(mean)])
    return float(np.sqrt((np.concatenate(means) ** 2).mean()))


def squares(predicted: Float[np.ndarray, "W T F 3"], windows: Windows) -> Float[np.ndarray, "W T F 3"]:
    """Squared errors of free coordinates, bounded by a metre, NaN where nothing was recorded."""
    observed = _compared(windows)
    return np.where(np.isfinite(observed), bounded(predicted - observed) ** 2, np.nan)


def _compared(windows: Windows) -> Float[np.ndarray, "W T F 3"]:
    """The observed keypoints, NaN in the two samples that a simulation begins from."""
    observed = windows.observed
    observed[:, :2] = np.nan
    return observed


def gap_of(
    before: Float[np.ndarray, "W T F 3"],
    after: Float[np.ndarray, "W T F 3"],
    cable: SpatialCable,
    noise: float,
    smallest: float,
) -> Gap:
    """Errors of two predictions of the windows, and the shrinkage from one to the other.

    Args:
        before: of the nominal simulator [m].
        after: with the effects that were found, each window from a fit that has not seen it [m].
        cable: in the windows as recorded.
        noise: standard deviation of a coordinate [m].
        smallest: error from which on there is a gap [m], see `smallest_gap`.
    """
    windows = cable.windows
    observed = _compared(windows)
    evidence = Evidence(
        simulator=cable,
        episodes=np.arange(len(windows)),
        observed=observed,
        nominal=before,
        noise=np.full((observed.shape[2], 1), noise),
        temper=np.ones(len(windows)),
        freedom=1.0,
        motion=windows.group,
    )
    gap = measure_gap(
        evidence,
        *(observed + np.sqrt(squares(part, windows)) for part in (before, after)),
        interval=np.full(len(windows), windows.interval),
        length=windows.valid.sum(axis=1),
        held_out=tuple(range(len(windows))),
        resolvable=is_gap(before, windows, smallest),
    )
    return dataclasses.replace(gap, held_out_episodes=tuple(sorted({int(e) for e in windows.episode})))


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
    before: Float[np.ndarray, "W T F 3"],
    noise: float,
    smallest: float,
    changes: Sequence[str],
) -> Where:
    """Keypoints, episodes and speeds at which the nominal simulator is off.

    Args:
        log: in space.
        windows: of the log, those that count.
        before: predictions of the nominal simulator in them [m].
        noise: standard deviation of a coordinate [m].
        smallest: error from which on there is a gap [m], see `smallest_gap`.
        changes: of the set-up between recordings, in words.
    """
    nominal = in_log(log, windows, before)
    off = bounded(np.asarray(log.keypoints, float) - nominal) ** 2
    off = np.where(np.isfinite(log.keypoints) & np.isfinite(nominal), off, np.nan)
    squared = squares(before, windows)
    speed = np.linalg.norm(np.diff(windows.position, axis=1, prepend=windows.position[:, :1]), axis=-1).max(axis=2)
    fast = (speed > np.median(speed[windows.valid]))[..., None, None]
    sizes = {
        "speed: fast": float(above(np.where(fast, squared, np.nan), noise)),
        "speed: slow": float(above(np.where(fast, np.nan, squared), noise)),
    }
    return sizes_of(
        off,
        noise,
        np.asarray(log.meta["keypoint_arclength_m"]),
        smallest_mm=1e3 * smallest,
        names=[f"file {name}" for name in labels(log, "file", "take")],
        gap_mm=float(above(squared, noise)),
        horizons_mm=_by_time(squared, windows.interval, noise),
        # grippers that rest all the time are never fast
        regimes={name: size for name, size in sizes.items() if np.isfinite(size)},
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
