"""Puts a log in space on one clock: one interval, and the keypoints' times for the grippers' poses."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from cablejax.diagnose.clock import even_times, keypoints_at
from cablejax.diagnose.log_faults import clock_offset
from cablejax.gaplog import episodes_of, labels, stack_episodes
from cablejax.poses import poses_at, with_one_sign
from cablejax.types import GapLog

# Clocks whose intervals are all within this share of the usual one are taken as they are,
_EVEN = 0.05
# if the mean interval of each episode is within this: a jitter is none in the mean, another rate is.
_SAME_RATE = 0.003
# A pause so long in which a gripper moves so far leaves open how [s, m].
_PAUSE, _MOVED = 0.15, 5e-3
# Samples a second that are enough [Hz]; twice as many are averaged.
_RATE = 75.0


def thinned(log: GapLog) -> tuple[GapLog, tuple[str, ...]]:
    """Averages groups of samples of a log with a high sample rate, and returns a sentence on it.

    A window begins with the velocity between two samples, of which noise says the more the closer they are: that of
    0.3 mm is 0.1 m/s at 240 Hz. A cable moves little within a hundredth of a second.

    Args:
        log: its samples one interval apart.
    """
    steps = log.intervals
    count = int(1.0 / (_RATE * np.median(steps)) + 1e-6) if len(steps) else 1
    if count < 2:
        return log, ()

    def means(values: np.ndarray) -> np.ndarray:
        each = min(count, len(values))
        whole = values[: len(values) // each * each].astype(float)
        return whole.reshape(-1, each, *values.shape[1:]).mean(axis=1)

    episodes = []
    for one in episodes_of(log):
        pose = means(with_one_sign(one.gripper_pose))
        pose[..., 3:] /= np.linalg.norm(pose[..., 3:], axis=-1, keepdims=True)
        episodes.append(
            dataclasses.replace(
                one,
                time=means(one.time),
                keypoints=means(one.keypoints),
                gripper_pose=pose,
                gripper_command=means(one.gripper_command),
                hold=means(one.hold) == 1.0,
            )
        )
    report = (
        f"Samples are {1e3 * np.median(steps):.3g} ms apart: every {count} were averaged, since noise in two samples "
        "this close dominates the velocity at the start of a window."
    )
    return stack_episodes(episodes, log.meta, holds=log.hold is not None), (report,)


def on_one_clock(log: GapLog) -> tuple[GapLog, tuple[str, ...]]:
    """Resamples a log whose clocks are uneven or differ between episodes, and returns sentences on the changes.

    Many samples a second are `thinned`.

    Positions and tangents of the grippers are linear between samples, as under the twists that were held; keypoints are
    those of `diagnose.clock.keypoints_at`.

    Raises:
        ValueError: the grippers move while there are no samples for longer than that is right.
    """
    steps = log.intervals
    if not len(steps):
        return log, ()
    interval = float(np.median(steps))
    rates = [(time[n - 1] - time[0]) / (n - 1) for time, n in zip(log.time, log.episode_length, strict=True) if n > 1]
    same = np.abs(np.array(rates) - interval).max() <= _SAME_RATE * interval
    if same and np.abs(steps - interval).max() <= _EVEN * interval:
        return thinned(log)
    episodes = []
    splits = labels(log, "split", default="")
    for number, one in enumerate(episodes_of(log)):
        time = one.time - one.time[0]
        if splits[number] != "eval":  # which nothing is fitted to or scored on
            _require_motion_known(number, time, one.gripper_pose, interval)
        grid, before, after = even_times(time, interval)
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
            hold=one.hold[before] & one.hold[after],
        )
        episodes.append(even)
    report = (
        f"Samples are {1e3 * steps.min():.3g} to {1e3 * steps.max():.3g} ms apart: the log was resampled every "
        f"{1e3 * interval:.3g} ms."
    )
    log, fewer = thinned(stack_episodes(episodes, log.meta, holds=log.hold is not None))
    return log, (report, *fewer)


def _require_motion_known(
    episode: int, time: Float[np.ndarray, "T"], pose: Float[np.ndarray, "T 2 7"], interval: float
) -> None:
    """Raises ValueError where grippers move in a pause: a straight line between two poses is not how they moved."""
    steps = np.diff(time)
    if not len(steps):
        return
    moved = np.linalg.norm(np.diff(pose[..., :3], axis=0), axis=-1).max(axis=1)
    pauses = np.flatnonzero((steps > max(_PAUSE, 2.5 * interval, 2.5 * float(np.median(steps)))) & (moved > _MOVED))
    if len(pauses):
        k = int(pauses[0])
        raise ValueError(
            f"Episode {episode} has no samples for {steps[k]:.2g} s after {time[k]:.3g} s, where a gripper moves by "
            f"{1e3 * moved[k]:.0f} mm, and how is not known. Write what is before and after as two episodes."
        )


def with_poses_in_time(log: GapLog) -> tuple[GapLog, tuple[str, ...]]:
    """Shifts the grippers' poses in time to fit the keypoints on them, and returns a sentence if it did.

    Keypoints of which the pose is not recorded then count as not observed.

    Args:
        log: its samples one interval apart.
    """
    steps = log.intervals
    interval = np.full(len(log.time), np.median(steps) if len(steps) else 1.0)
    ends, place = log.keypoints[:, :, [0, -1]].astype(float), log.gripper_pose[..., :3].astype(float)
    offset = clock_offset(ends, place, log.episode_length, interval)
    if offset is None:
        return log, ()
    seconds, fit = offset
    episodes = []
    for one in episodes_of(log):
        then = one.time + seconds
        known = (then >= one.time[0]) & (then <= one.time[-1])
        points = np.where(known[:, None, None], one.keypoints, np.nan)
        episodes.append(
            dataclasses.replace(one, keypoints=points, gripper_pose=poses_at(then, one.time, one.gripper_pose))
        )
    report = (
        f"The keypoints at the grippers fit their poses {abs(seconds):.2g} s {'later' if seconds > 0 else 'earlier'}: "
        f"{fit}. Keypoints and poses have different clocks. This is not an effect in space but can look like one, so "
        "the poses were shifted by this offset."
    )
    return stack_episodes(episodes, log.meta, holds=log.hold is not None), (report,)
