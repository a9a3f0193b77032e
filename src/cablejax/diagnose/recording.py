"""A gap log made ready for diagnosis: checked, on an even clock, angles continuous."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from cablejax.gaplog import validate
from cablejax.types import GapLog

# Samples are padded to a multiple of this, so that logs of nearly equal length share one compiled program.
_PADDING = 50
_UNEVEN = 0.2
_FAR = 0.1
_WRONG_LENGTH = 0.12


class DiagnosisError(ValueError):
    """A log that cannot be diagnosed."""


@dataclasses.dataclass(frozen=True)
class Recording:
    """One log as the diagnosis uses it.

    Attributes:
        keypoints: [m], NaN = not observed or padding, shape [E, T, N, 2].
        gripper_pose: theta continuous, the last one held over the padding, shape [E, T, 2, 3].
        gripper_command: zero over the padding, shape [E, T, 2, 3].
        hold: shape [E, T], or None.
        interval: between samples [s], shape [E].
        length: valid samples, shape [E].
        caveats: what had to be repaired or is missing, in words.
    """

    keypoints: Float[np.ndarray, "E T N 2"]
    gripper_pose: Float[np.ndarray, "E T 2 3"]
    gripper_command: Float[np.ndarray, "E T 2 3"]
    hold: np.ndarray | None
    interval: Float[np.ndarray, "E"]
    length: np.ndarray
    caveats: tuple[str, ...]

    @property
    def has_commands(self) -> bool:
        """Whether commands were logged; all zero while the grippers move means that they were not."""
        return bool(np.abs(self.gripper_command).any()) or float(np.ptp(self.gripper_pose, axis=1).max()) <= 1e-3

    def as_log(self, meta: dict[str, Any]) -> GapLog:
        """The log after repairs, without the padding."""
        longest = int(self.length.max())
        steps = np.minimum(np.arange(longest)[None], self.length[:, None] - 1)
        return GapLog(
            time=steps * self.interval[:, None],
            keypoints=self.keypoints[:, :longest].astype(np.float32),
            gripper_pose=self.gripper_pose[:, :longest].astype(np.float32),
            gripper_command=self.gripper_command[:, :longest].astype(np.float32),
            episode_length=self.length.astype(np.int32),
            hold=None if self.hold is None else self.hold[:, :longest],
            meta=meta,
        )


def prepare(log: GapLog) -> Recording:
    """Checks a planar log and puts its samples on an even clock.

    Raises:
        GapLogError: the log does not follow its format.
        DiagnosisError: not planar, not two grippers, too short, or keypoints that do not fit the cable or the grippers.
    """
    validate(log)
    if log.keypoints.shape[-1] != 2 or log.gripper_pose.shape[2] != 2:
        raise DiagnosisError(
            f"The log has keypoints in {log.keypoints.shape[-1]} dimensions and {log.gripper_pose.shape[2]} grippers, "
            "expected a cable on a table (2) between two grippers."
        )
    n_episodes = len(log.episode_length)
    caveats: list[str] = []
    if n_episodes == 1:
        caveats.append(
            "One episode only: nothing can be held out, so the shrinkage is that of the fit itself and every "
            "probability is less certain than it looks."
        )
    episodes, intervals = [], []
    for e in range(n_episodes):
        n = int(log.episode_length[e])
        if n < 20:
            raise DiagnosisError(f"Episode {e} has {n} samples, expected at least 20.")
        step = np.diff(log.time[e, :n])
        interval = float(np.round(np.median(step), 6))
        even = np.abs(step - interval) <= _UNEVEN * interval
        if not even.all():
            caveats.append(
                f"The clock of episode {e} jumps {int((~even).sum())} times: put on an even clock of {interval:g} s."
            )
        episodes.append(_even(log, e, n, interval) if not even.all() else _plain(log, e, n))
        intervals.append(interval)
    if max(intervals) > 1.0:
        raise DiagnosisError(f"The samples are {max(intervals):g} s apart, expected at most 1 s.")
    longest = max(len(x[0]) for x in episodes)
    total = -(-longest // _PADDING) * _PADDING
    shape = (n_episodes, total)
    points = np.full((*shape, log.keypoints.shape[2], 2), np.nan)
    pose, command = np.zeros((*shape, 2, 3)), np.zeros((*shape, 2, 3))
    hold = np.zeros(shape, bool)
    for e, (p, g, c, h) in enumerate(episodes):
        n = len(p)
        points[e, :n], pose[e, :n], command[e, : n - 1], hold[e, :n] = p, g, c[: n - 1], h
        pose[e, n:] = g[-1]
    pose[..., 2] = np.unwrap(pose[..., 2], axis=1)
    recording = Recording(
        keypoints=points,
        gripper_pose=pose,
        gripper_command=command,
        hold=None if log.hold is None else hold,
        interval=np.array(intervals),
        length=np.array([len(x[0]) for x in episodes]),
        caveats=(),
    )
    caveats += _plausible(log, recording)
    if log.hold is None or not hold.any():
        caveats.append("No holds are marked: the noise is taken to be white, and a slow drift would count as a gap.")
    if not recording.has_commands:
        caveats.append("No commands were logged although the grippers move: effects of the arms cannot be told.")
    return dataclasses.replace(recording, caveats=tuple(caveats))


def _plain(log, e, n):
    hold = np.zeros(n, bool) if log.hold is None else log.hold[e, :n]
    return log.keypoints[e, :n], log.gripper_pose[e, :n], log.gripper_command[e, :n], hold


def _even(log, e, n, interval):
    """The samples at even times; keypoints only where there is one near in time."""
    time = log.time[e, :n] - log.time[e, 0]
    grid = np.arange(int(np.floor(time[-1] / interval + 1e-6)) + 1) * interval
    pose = np.stack([np.interp(grid, time, column) for column in _continuous(log.gripper_pose[e, :n])], axis=1)
    nearest = np.abs(time[None] - grid[:, None]).argmin(axis=1)
    close = np.abs(time[nearest] - grid) <= 0.25 * interval
    points = np.where(close[:, None, None], log.keypoints[e, nearest], np.nan)
    before = np.clip(np.searchsorted(time, grid + 1e-9, side="right") - 1, 0, n - 1)
    hold = np.zeros(len(grid), bool) if log.hold is None else log.hold[e, before] & close
    return points, pose.reshape(-1, 2, 3), log.gripper_command[e, before], hold


def _continuous(pose):
    pose = pose.astype(float).copy()
    pose[..., 2] = np.unwrap(pose[..., 2], axis=0)
    return pose.reshape(len(pose), -1).T


def _plausible(log: GapLog, recording: Recording) -> list[str]:
    """Refuses keypoints of another cable; reports what weakens the diagnosis."""
    points, caveats = recording.keypoints, []
    seen = np.asarray(np.isfinite(points).all(axis=-1))
    valid = np.arange(points.shape[1])[None] < recording.length[:, None]
    missing = 1 - seen[valid].mean()
    if missing > 0.9:
        raise DiagnosisError(f"{missing:.0%} of the keypoints are missing: nothing to diagnose.")
    if missing > 0.1:
        caveats.append(f"{missing:.0%} of the keypoints are missing: small or local effects may go unseen.")
    for gripper, end in ((0, 0), (1, -1)):
        distance = np.linalg.norm(points[:, :, end] - recording.gripper_pose[:, :, gripper, :2], axis=-1)
        away = np.nanmedian(np.where(valid, distance, np.nan)) if seen[:, :, end].any() else 0.0
        if away > _FAR:
            raise DiagnosisError(
                f"Keypoint {'0' if end == 0 else 'N - 1'} is {away:.2f} m from gripper {gripper}, expected it at the "
                "gripper: are the keypoints and the poses in one frame, in metres, and of one cable?"
            )
    length = log.meta["cable"]["length_m"]
    span = np.linalg.norm(recording.gripper_pose[:, :, 1, :2] - recording.gripper_pose[:, :, 0, :2], axis=-1)
    if span[valid].max() > 1.001 * length:
        raise DiagnosisError(
            f"The grippers are up to {span[valid].max():.3f} m apart, more than the cable's length of {length} m: "
            "correct meta.cable.length_m."
        )
    nominal = np.diff(log.meta["keypoint_arclength_m"])
    chord = np.linalg.norm(np.diff(points, axis=2), axis=-1)
    ratio = float(np.nanmedian(chord / nominal)) if np.isfinite(chord).any() else 1.0
    if abs(ratio - 1) > _WRONG_LENGTH:
        raise DiagnosisError(
            f"The keypoints lie {ratio:.2f} times as far apart as meta.keypoint_arclength_m says: correct the length, "
            "the unit, or the marks."
        )
    uneven = np.abs(np.asarray(log.meta["keypoint_arclength_m"]) - np.linspace(0, length, points.shape[2])).max()
    if uneven > 1e-3 * length:
        raise DiagnosisError(
            "The keypoints are not uniform in arc length from 0 to the cable's length, as meta.keypoint_arclength_m "
            "says; the simulator places them so. Resample them first."
        )
    return caveats
