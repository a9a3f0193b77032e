"""Resamples one episode on an even clock.

The simulator and everything that looks at correlation in time want samples a fixed interval apart. Clocks of real
recordings jitter, drift and drop samples. Between two samples the grippers move with the twist that was held, so their
poses, measured and commanded, are linear there; keypoints are smooth, and a cubic through four of them is good to a few
hundredths of a millimetre where a straight line, or the nearest sample, would be off by as much as a small gap.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from cablejax.arrays import positions_at
from cablejax.gaplog import Episode

# Of an episode of one sample [s].
_ANY_INTERVAL = 0.1
# A clock whose samples are all within this share of the interval from an even one is even.
_EVEN = 0.01
# Samples farther apart than this many intervals have a gap between them, which is not bridged.
_GAP = 1.7
# A sample within this share of the interval from the clock is taken as it is next to a gap.
_CLOSE = 0.05


def usual_interval(time: Float[np.ndarray, "T"]) -> float:
    """Usual sample interval of an episode [s]: the mean, or the median where some samples are lost."""
    if len(time) < 2:
        return _ANY_INTERVAL
    step = np.diff(time)
    mean, median = float(step.mean()), float(np.median(step))
    return float(np.round(mean if step.max() <= _GAP * median else median, 9))


def furthest_off(time: Float[np.ndarray, "T"], interval: float) -> float:
    """Largest distance of a sample from an even clock [s]."""
    return float(np.abs(time - time[0] - interval * np.arange(len(time))).max())


def is_even(time: Float[np.ndarray, "T"], interval: float) -> bool:
    """Whether samples may be taken as they are."""
    return furthest_off(time, interval) <= _EVEN * interval


def on_even_clock(episode: Episode, interval: float) -> Episode:
    """The episode at even times, from 0 on.

    What was commanded is integrated over the times at which it was held, so that exact arms stay exact. In a gap
    between samples keypoints are not observed, and what was commanded is taken to be what was done.

    Args:
        episode: as recorded, its angles continuous.
        interval: of the new clock [s].
    """
    time = episode.time - episode.time[0]
    grid, before, after = even_times(time, interval)
    held = np.diff(time)[:, None, None]
    done = np.diff(episode.gripper_pose, axis=0)
    steps = np.where(held <= _GAP * interval, episode.gripper_command[:-1] * held, done)
    path = np.concatenate([np.zeros((1, 2, 3)), np.cumsum(steps, axis=0)])
    commanded = np.diff(positions_at(grid, time, path), axis=0) / interval
    return dataclasses.replace(
        episode,
        time=grid,
        keypoints=keypoints_at(grid, time, episode.keypoints, interval),
        gripper_pose=positions_at(grid, time, episode.gripper_pose),
        gripper_command=np.concatenate([commanded, np.zeros((1, 2, 3))]),
        hold=episode.hold[before] & episode.hold[after],
    )


def even_times(
    time: Float[np.ndarray, "T"], interval: float
) -> tuple[Float[np.ndarray, "G"], Int[np.ndarray, "G"], Int[np.ndarray, "G"]]:
    """The times of an even clock from 0 to the end [s], and for each the samples before and after it."""
    grid = np.arange(int(np.floor(time[-1] / interval + 1e-6)) + 1) * interval
    before = np.clip(np.searchsorted(time, grid + 1e-9, side="right") - 1, 0, len(time) - 1)
    return grid, before, np.minimum(before + 1, len(time) - 1)


def keypoints_at(
    grid: Float[np.ndarray, "G"], time: Float[np.ndarray, "T"], points: Float[np.ndarray, "T N D"], interval: float
) -> Float[np.ndarray, "G N D"]:
    """Keypoints interpolated cubically where two samples before and after are observed, else linearly, else NaN."""
    n = len(time)
    left = np.clip(np.searchsorted(time, grid, side="right") - 1, 0, n - 2)
    share = (grid - time[left]) / (time[left + 1] - time[left])
    whole = time[left + 1] - time[left] <= _GAP * interval
    line = (1 - share)[:, None, None] * points[left] + share[:, None, None] * points[left + 1]
    nodes = left[:, None] + np.arange(-1, 3)
    inside = (nodes[:, 0] >= 0) & (nodes[:, 3] < n)
    nodes = np.clip(nodes, 0, n - 1)
    inside &= (np.diff(time[nodes], axis=1) <= _GAP * interval).all(axis=1)
    weights = _lagrange(grid, time[np.where(inside[:, None], nodes, np.arange(4))]) if n >= 4 else None
    curve = np.full_like(line, np.nan)
    if weights is not None:
        curve = np.where(inside[:, None, None], np.einsum("gk,gknd->gnd", weights, points[nodes]), np.nan)
    between = np.where(np.isfinite(curve), curve, line)
    nearest = np.where(share < 0.5, left, left + 1)
    close = (np.abs(time[nearest] - grid) <= _CLOSE * interval)[:, None, None]
    alone = np.where(close, points[nearest], np.nan)
    return np.where(whole[:, None, None] & np.isfinite(between), between, alone)


def _lagrange(at: Float[np.ndarray, "G"], nodes: Float[np.ndarray, "G 4"]) -> Float[np.ndarray, "G 4"]:
    """Weights of four nodes in the value of the cubic through them."""
    columns = []
    for i in range(4):
        others = [j for j in range(4) if j != i]
        columns.append(np.prod([(at - nodes[:, j]) / (nodes[:, i] - nodes[:, j]) for j in others], axis=0))
    return np.stack(columns, axis=1)
