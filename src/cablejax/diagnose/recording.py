"""Prepares a gap log for diagnosis: checked, on an even clock, angles continuous."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from cablejax.diagnose.clock import furthest_off, is_even, on_even_clock, usual_interval
from cablejax.diagnose.log_faults import as_measured, clock_offset, command_fault, early_keypoints, tool_offset
from cablejax.diagnose.noise import still
from cablejax.gaplog import Episode, episodes_of, validate
from cablejax.gaplog_join import commands_derived
from cablejax.log_setup import cable_fault
from cablejax.types import GapLog

# Samples are padded to a multiple of this, so that logs of nearly equal length share one compiled program.
_PADDING = 50
_SHORTEST = 20
# Share of gravity in the plane of the table beyond which it is none.
_STEEP = 0.9


class DiagnosisError(ValueError):
    """A log that cannot be diagnosed."""


@dataclasses.dataclass(frozen=True)
class Recording:
    """One log as the diagnosis uses it.

    Attributes:
        keypoints: [m], NaN = not observed or padding, shape [E, T, N, 2].
        gripper_pose: theta continuous, the last one held over the padding, shape [E, T, 2, 3].
        gripper_command: zero over the padding, shape [E, T, 2, 3].
        hold: where the grippers rest too, shape [E, T], or None.
        interval: between samples [s], shape [E].
        length: valid samples, shape [E].
        commanded: episodes whose commands are known, shape [E].
        caveats: what had to be repaired or is missing, in words.
    """

    keypoints: Float[np.ndarray, "E T N 2"]
    gripper_pose: Float[np.ndarray, "E T 2 3"]
    gripper_command: Float[np.ndarray, "E T 2 3"]
    hold: np.ndarray | None
    interval: Float[np.ndarray, "E"]
    length: np.ndarray
    commanded: Bool[np.ndarray, "E"]
    caveats: tuple[str, ...]

    @property
    def valid(self) -> Bool[np.ndarray, "E T"]:
        """Samples that are no padding."""
        return np.arange(self.gripper_pose.shape[1])[None] < self.length[:, None]

    @property
    def has_commands(self) -> bool:
        """Whether commands were logged; all zero while the grippers move means that they were not."""
        if not self.commanded.any():
            return False
        return bool(
            np.abs(self.gripper_command).any() or np.ptp(self.gripper_pose[self.commanded], axis=1).max() <= 1e-3
        )

    @property
    def recorded_pose(self) -> Float[np.ndarray, "E T 2 3"]:
        """The gripper poses, NaN beyond an episode's end."""
        return np.where(self.valid[:, :, None, None], self.gripper_pose, np.nan)

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
    log, caveats = as_measured(log)
    if log.meta["table"] is None:
        caveats.append("The log states no table: the cable is taken to lie on one without friction.")
    short = [e for e in range(n_episodes) if log.episode_length[e] < _SHORTEST]
    if len(short) == n_episodes:
        raise DiagnosisError(
            f"The longest episode has {log.episode_length.max()} samples, expected one of at least {_SHORTEST}."
        )
    unseen = [e for e, one in enumerate(episodes_of(log)) if not np.isfinite(one.keypoints).any()]
    caveats += _left_out(short, f"for having fewer than {_SHORTEST} samples")
    caveats += _left_out(unseen, "because no keypoint was observed")
    episodes, intervals = [], []
    derived = commands_derived(log)
    for e, recorded in enumerate(episodes_of(log)):
        episode = _continuous(recorded, observed=e not in short, commanded=not derived[e])
        interval = usual_interval(episode.time)
        if not is_even(episode.time, interval):
            caveats.append(
                f"The clock of episode {e} is up to {1e3 * furthest_off(episode.time, interval):.0f} ms off an even "
                f"one: the episode was resampled every {interval:g} s."
            )
            episode = on_even_clock(episode, interval)
        episodes.append(episode)
        intervals.append(interval)
    lengths = [len(episode.time) for episode in episodes]
    total = -(-max(lengths) // _PADDING) * _PADDING
    shape = (n_episodes, total)
    points = np.full((*shape, log.keypoints.shape[2], 2), np.nan)
    pose, command = np.zeros((*shape, 2, 3)), np.zeros((*shape, 2, 3))
    hold = np.zeros(shape, bool)
    for e, (episode, n) in enumerate(zip(episodes, lengths, strict=True)):
        points[e, :n], pose[e, :n], hold[e, :n] = episode.keypoints, episode.gripper_pose, episode.hold
        pose[e, n:], command[e, : n - 1] = episode.gripper_pose[-1], episode.gripper_command[: n - 1]
        # both grippers by the same whole turns, so that an episode which repeats another one is known by its angles
        pose[e, ..., 2] += 2 * np.pi * np.round((pose[0, 0, 0, 2] - pose[e, 0, 0, 2]) / (2 * np.pi))
    marked, hold = hold, still(hold, pose, float(log.meta["cable"]["length_m"]))
    if wrong := int((marked & ~hold).sum()):
        caveats.append(
            f"{wrong} of {int(marked.sum())} samples are marked as holds although the grippers move. They are not used "
            "as holds."
        )
    recording = Recording(
        keypoints=points,
        gripper_pose=pose,
        gripper_command=command,
        hold=None if log.hold is None else hold,
        interval=np.array(intervals),
        length=np.array(lengths),
        commanded=~derived,
        caveats=(),
    )
    caveats += _plausible(log, recording)
    valid = recording.valid & recording.commanded[:, None]
    if recording.has_commands and (fault := command_fault(pose, command, recording.interval, valid)):
        raise DiagnosisError(fault)
    if log.hold is None or not hold.any():
        caveats.append("No holds are marked: the noise is assumed to be white, so a slow drift would count as a gap.")
    caveats += _without_commands(recording)
    return dataclasses.replace(recording, caveats=tuple(caveats))


def _left_out(episodes: list[int], why: str) -> list[str]:
    return [f"Left out {why}: episode {', '.join(map(str, episodes))}."] if episodes else []


def _without_commands(recording: Recording) -> list[str]:
    if not recording.has_commands:
        return ["No commands were logged although the grippers move: effects of the arms cannot be estimated."]
    if recording.commanded.all():
        return []
    return [
        f"{(~recording.commanded).sum()} of {len(recording.commanded)} episodes were imported without commands: "
        "effects of the arms are estimated from the others."
    ]


def _continuous(episode: Episode, *, observed: bool, commanded: bool) -> Episode:
    """An episode in double precision, its angles continuous in time and along the cable."""
    points, pose = episode.keypoints.astype(float), episode.gripper_pose.astype(float)
    pose[..., 2] = np.unwrap(pose[..., 2], axis=0)
    pose[:, 1, 2] += _whole_turns(points, pose)
    return dataclasses.replace(
        episode,
        keypoints=points if observed else np.full_like(points, np.nan),
        gripper_pose=pose,
        gripper_command=np.nan_to_num(episode.gripper_command.astype(float)) if commanded else np.zeros_like(pose),
    )


def _whole_turns(points: Float[np.ndarray, "T N 2"], pose: Float[np.ndarray, "T 2 3"]) -> float:
    """Whole turns to add to the second gripper's angle, so that it continues the first one's along the cable [rad].

    An angle is known up to whole turns, a cable is not: between the same directions it may lie straight or with a loop
    in it. The keypoints decide, in the samples that show most of them.
    """
    seen = np.isfinite(points).all(axis=-1)
    best = seen & (seen.sum(axis=1) == seen.sum(axis=1).max())[:, None]
    turns = []
    for points_, pose_, seen_ in zip(points, pose, best, strict=True):
        if seen_.sum() < 3:
            continue
        chord = np.diff(points_[seen_], axis=0)
        along = np.unwrap(np.arctan2(chord[:, 1], chord[:, 0]))
        turns.append(np.round((pose_[0, 2] + along[-1] - along[0] - pose_[1, 2]) / (2 * np.pi)))
    return 2 * np.pi * float(np.median(turns)) if turns else 0.0


def _plausible(log: GapLog, recording: Recording) -> list[str]:
    """Refuses keypoints of another cable; reports what weakens the diagnosis."""
    points, caveats = recording.keypoints, []
    seen, valid = np.asarray(np.isfinite(points).all(axis=-1)), recording.valid
    missing = 1 - seen[valid].mean()
    if missing > 0.9:
        raise DiagnosisError(
            f"{missing:.0%} of the keypoints are missing (NaN), expected at most 90 %: nothing to diagnose. Was the "
            "camera on, and are the keypoints' columns or topics the right ones?"
        )
    if not seen[:, :, 1:-1].any():
        raise DiagnosisError("No keypoint between the grippers was observed: nothing to diagnose.")
    if missing > 0.1:
        caveats.append(f"{missing:.0%} of the keypoints are missing: small or local effects may go unseen.")
    for gripper, end in ((0, 0), (1, -1)):
        caveats += tool_offset(points[:, :, end], recording.gripper_pose[:, :, gripper], gripper)
    place = recording.gripper_pose[..., :2]
    caveats += early_keypoints(clock_offset(points[:, :, [0, -1]], place, recording.length, recording.interval))
    length = log.meta["cable"]["length_m"]
    span = np.linalg.norm(recording.gripper_pose[:, :, 1, :2] - recording.gripper_pose[:, :, 0, :2], axis=-1)
    if span[valid].max() > 1.001 * length:
        raise DiagnosisError(
            f"The grippers are up to {span[valid].max():.3f} m apart, more than the cable's length of {length} m: "
            "correct meta.cable.length_m."
        )
    if fault := cable_fault(log):
        raise DiagnosisError(fault)
    gravity = np.asarray(log.meta["gravity_m_per_s2"], float)
    if np.linalg.norm(gravity[:2]) > _STEEP * np.linalg.norm(gravity):
        raise DiagnosisError(
            f"Gravity is {gravity.tolist()} m/s^2, mostly in the plane of the keypoints: the cable hangs, but a planar "
            "log is of a cable on a table. Write the log with keypoints in space (D = 3)."
        )
    return caveats
