"""Resamples a log in space to one interval."""

from __future__ import annotations

import dataclasses

import numpy as np

from cablejax.diagnose.clock import keypoints_at
from cablejax.gaplog import episodes_of, stack_episodes
from cablejax.poses import poses_at, without_misreadings
from cablejax.types import GapLog

# Clocks whose intervals are all within this share of the usual one are taken as they are.
_EVEN = 0.05


def on_one_clock(log: GapLog) -> tuple[GapLog, tuple[str, ...]]:
    """The log, sampled again where its clocks are uneven or differ between episodes, and sentences on what was changed.

    Readings of the grippers that jump away and back are taken out before.

    Positions and tangents of the grippers are linear between samples, as under the twists that were held; keypoints are
    those of `diagnose.clock.keypoints_at`.
    """
    pose, repairs = log.gripper_pose.copy(), []
    for e, n in enumerate(log.episode_length):
        pose[e, :n], jumps = without_misreadings(log.time[e, :n], pose[e, :n])
        repairs += [f"In episode {e} the pose of gripper {q} {words}" for q, words in jumps.items()]
    if repairs:
        log = dataclasses.replace(log, gripper_pose=pose)
    steps = np.concatenate([np.diff(time[:n]) for time, n in zip(log.time, log.episode_length, strict=True)])
    interval = float(np.median(steps)) if len(steps) else 0.0
    if not len(steps) or np.abs(steps - interval).max() <= _EVEN * interval:
        return log, tuple(repairs)
    episodes = []
    for one in episodes_of(log):
        time = one.time - one.time[0]
        grid = interval * np.arange(int(np.floor(time[-1] / interval + 1e-6)) + 1)
        before = np.clip(np.searchsorted(time, grid + 1e-9, side="right") - 1, 0, len(time) - 1)
        points = one.keypoints.astype(float)
        if len(time) > 1:
            # an episode may be slower than the clock: a gap is one in its own clock
            points = keypoints_at(grid, time, points, max(interval, float(np.median(np.diff(time)))))
        even = dataclasses.replace(
            one,
            time=grid,
            keypoints=points,
            gripper_pose=poses_at(grid, time, one.gripper_pose),
            gripper_command=one.gripper_command[before],
            hold=one.hold[before] & one.hold[np.minimum(before + 1, len(time) - 1)],
        )
        episodes.append(even)
    report = (
        f"Samples are {1e3 * steps.min():.3g} to {1e3 * steps.max():.3g} ms apart: sampled again every "
        f"{1e3 * interval:.3g} ms."
    )
    return stack_episodes(episodes, log.meta, holds=log.hold is not None), (*repairs, report)
