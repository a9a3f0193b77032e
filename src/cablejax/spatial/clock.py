"""Resamples a log in space to one interval."""

from __future__ import annotations

import dataclasses

import numpy as np

from cablejax.diagnose.clock import keypoints_at
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
    length = [
        int(np.floor((time[n - 1] - time[0]) / interval + 1e-6)) + 1
        for time, n in zip(log.time, log.episode_length, strict=True)
    ]
    clock = interval * np.arange(max(length))
    whole = {"time": np.tile(clock, (len(length), 1))}
    for name in ("keypoints", "gripper_pose", "gripper_command", "hold"):
        array = getattr(log, name)
        if array is not None:
            empty = np.nan if name == "keypoints" else 0
            whole[name] = np.full((len(length), max(length), *array.shape[2:]), empty, array.dtype)
    for e, (samples, n) in enumerate(zip(length, log.episode_length, strict=True)):
        time, grid = log.time[e, :n] - log.time[e, 0], clock[:samples]
        before = np.clip(np.searchsorted(time, grid + 1e-9, side="right") - 1, 0, n - 1)
        points = log.keypoints[e, :n].astype(float)
        if n > 1:
            # an episode may be slower than the clock: a gap is one in its own clock
            points = keypoints_at(grid, time, points, max(interval, float(np.median(np.diff(time)))))
        whole["keypoints"][e, :samples] = points
        whole["gripper_pose"][e] = poses_at(clock, time, log.gripper_pose[e, :n])
        whole["gripper_command"][e, :samples] = log.gripper_command[e, before]
        if log.hold is not None:
            whole["hold"][e, :samples] = log.hold[e, before] & log.hold[e, np.minimum(before + 1, n - 1)]
    report = (
        f"Samples are {1e3 * steps.min():.3g} to {1e3 * steps.max():.3g} ms apart: sampled again every "
        f"{1e3 * interval:.3g} ms."
    )
    return dataclasses.replace(log, episode_length=np.array(length, np.int32), **whole), (*repairs, report)
