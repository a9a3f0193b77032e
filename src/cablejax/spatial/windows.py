"""A gap log in space as windows of equal length, ready for the simulator."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Bool, Float, Int

from cablejax.cable import GRAVITY
from cablejax.cable_length import TOLERANCE, require_fitting_length
from cablejax.diagnose.log_faults import steadied
from cablejax.diagnose.noise import noise_floor
from cablejax.gaplog import labels
from cablejax.log_setup import cable_fault
from cablejax.poses import rotated
from cablejax.recordings.gaps import FILLED, bridged
from cablejax.spatial.grips import clamps, frames_of, held_keypoints, rolls_observed
from cablejax.types import GapLog

WINDOW = 5.0
"""Length of a window [s]: so far ahead the simulator predicts from two observations."""
FITTED = slice(2, None, 4)
"""Samples of a window that fits look at: every fourth, after the two that the simulation begins from."""
SHORTEST = 1.0
"""Length of the shortest window [s]."""
# Part of a window that must be recorded for it to be a whole one.
_WHOLE = 0.8
# Clamps that scatter by less than this from one sample to the next [m] stay as they were measured.
_STEADY = np.full(3, 1e-4)
# Weight in fits of a window in which the grippers are further apart than the cable is long.
_TORN = 0.01


@dataclasses.dataclass(frozen=True)
class Windows:
    """Windows of one cable. F free markers of N lie between the held ones.

    Attributes:
        keypoints: observed, free ones only [m], NaN = not observed, shape [W, T, F, 3].
        position: of the two clamps [m], shape [W, T, 2, 3].
        frames: of the two grippers, rows are axes, shape [W, T, 2, 3, 3].
        valid: samples that are recorded, shape [W, T].
        interval: between samples [s].
        episode: that each window is part of, shape [W].
        begin: first sample of each in its episode, shape [W].
        group: recording that each is part of: what is split between fit and check, shape [W].
        trust: weight of each in fits, shape [W].
        split: "train", "eval" or "" of each window, shape [W].
        name: of each window's episode, for a reader.
        held: number of keypoints held at either end.
        arclength: of the free markers and the second clamp, from the first clamp [m], shape [F + 1].
        n_keypoints: N.
        first_clamp: arc length of the first clamp, from the first keypoint [m].
        gravity: as the log states it [m/s^2].
        rolls: whether the grippers' roll about the cable is that of the log; else it is not known, see `frames_along`.
        smoothed: what was taken from the measured paths of the clamps so that they are smooth, root mean square of a
            coordinate [m].
        left_out: where the log has windows without a second that begins with two samples of all keypoints, or in which
            fits see nothing later, in words.
        short: part of the log's samples that are in stretches shorter than a window may be.
    """

    keypoints: Float[np.ndarray, "W T F 3"]
    position: Float[np.ndarray, "W T 2 3"]
    frames: Float[np.ndarray, "W T 2 3 3"]
    valid: Bool[np.ndarray, "W T"]
    interval: float
    episode: Int[np.ndarray, "W"]
    begin: Int[np.ndarray, "W"]
    group: Int[np.ndarray, "W"]
    trust: Float[np.ndarray, "W"]
    split: tuple[str, ...]
    name: tuple[str, ...]
    held: tuple[int, int]
    arclength: Float[np.ndarray, "F1"]
    n_keypoints: int
    first_clamp: float = 0.0
    gravity: tuple[float, ...] = (0.0, 0.0, -GRAVITY)
    rolls: bool = False
    smoothed: float = 0.0
    left_out: tuple[str, ...] = ()
    short: float = 0.0

    def __len__(self) -> int:
        return len(self.keypoints)

    def whole(self, count: int, least: int = 2) -> Int[np.ndarray, "S"]:
        """Indices of at most `count` windows that are recorded in full and not torn, spread evenly.

        Where fewer than `least` are, of all that are not torn, else of any: of one window nothing can be held out.
        """
        intact = ~self.torn
        wanted = (self.valid.mean(axis=1) >= _WHOLE) & intact, intact
        whole = np.flatnonzero(next((each for each in wanted if each.sum() >= least), np.ones(len(self), bool)))
        return whole[np.unique(np.linspace(0, len(whole) - 1, count).astype(int))]

    @property
    def fitted(self) -> Windows:
        """Those that may be fitted: all that are not labelled "eval"."""
        return self.chosen([i for i, split in enumerate(self.split) if split != "eval"])

    @property
    def observed(self) -> Float[np.ndarray, "W T F 3"]:
        """The keypoints, NaN also where nothing is recorded."""
        return np.where(self.valid[:, :, None, None], self.keypoints, np.nan)

    @property
    def placed(self) -> range:
        """Indices among all keypoints of the free ones, and of that at the second clamp if it holds one."""
        return range(self.held[0], min(self.held[0] + len(self.arclength), self.n_keypoints))

    @property
    def torn(self) -> Bool[np.ndarray, "W"]:
        """Windows in which the grippers are further apart than the cable between them is long, beyond tolerance."""
        return (self.apart > (1 + TOLERANCE) * self.arclength[-1]).any(axis=1)

    @property
    def apart(self) -> Float[np.ndarray, "W T"]:
        """Distance of the two clamps [m], NaN where nothing is recorded."""
        distance = np.linalg.norm(self.position[:, :, 1] - self.position[:, :, 0], axis=-1)
        return np.where(self.valid, distance, np.nan)

    @property
    def noise(self) -> float:
        """Standard deviation of a coordinate [m], from fourth differences in time, which no motion of a cable has."""
        return float(np.sqrt((noise_floor(self.observed, None, order=4).std ** 2).mean()))

    @property
    def speed(self) -> float:
        """Root mean square speed of the free markers [m/s], without what the noise adds to differences."""
        step = np.diff(self.observed, axis=1) / self.interval
        return float(np.sqrt(max(np.nanmean((step**2).sum(axis=-1)) - 6.0 * (self.noise / self.interval) ** 2, 0.0)))

    def chosen(self, index) -> Windows:
        """Some of the windows."""
        index = np.asarray(index, int)
        return dataclasses.replace(
            self,
            **{
                f: getattr(self, f)[index]
                for f in ("keypoints", "position", "frames", "valid", "episode", "begin", "group", "trust")
            },
            **{f: tuple(getattr(self, f)[i] for i in index) for f in ("split", "name")},
        )


def windows_of(log: GapLog) -> Windows:
    """Cuts every episode into windows of `WINDOW`, or shorter where keypoints are not observed in the beginning of one.

    Clamps whose paths scatter from one sample to the next would shake the simulated cable, and are smoothed.

    Raises:
        ValueError: a log in the plane, of unequal sample intervals, of a cable shorter than its keypoints are apart or
            that is not between its grippers, or one that has no window of a second.
    """
    interval = _sample_interval(log)
    samples = min(round(WINDOW / interval), int(log.episode_length.max()))
    points = np.asarray(log.keypoints, float)
    pose = np.asarray(log.gripper_pose, float)
    valid = log.valid
    unseen = np.flatnonzero(~np.isfinite(points[valid]).any(axis=(0, 2)))
    if len(unseen):
        raise ValueError(
            f"Keypoint {', '.join(map(str, unseen))} is never observed: leave it out of keypoints and of "
            "meta.keypoint_arclength_m."
        )
    tangent = rotated(pose[..., 3:], np.array([1.0, 0.0, 0.0]))
    s = np.asarray(log.meta["keypoint_arclength_m"], float)
    held = held_keypoints(points, pose[..., :3], tangent, valid, s)
    clamp = clamps(points, pose[..., :3], tangent, s, held)
    clamp, taken = steadied(clamp, np.zeros_like(clamp), log.episode_length, least=_STEADY)
    frames = frames_of(log, tangent, valid)
    first = s[held[0] - 1] if held[0] else s[0]
    last = s[len(s) - held[1]] if held[1] else s[-1]
    free = slice(held[0], len(s) - held[1])
    if held[0] + held[1] >= len(s):
        raise ValueError(
            f"All {len(s)} keypoints move with the grippers, as if the cable were rigid: expected at least one that "
            "bending moves across both grippers' axes. Record a cable that hangs free between them."
        )
    recording = labels(log, "recording")
    groups = {r: i for i, r in enumerate(dict.fromkeys(recording))}
    files, splits = labels(log, "file", "take"), labels(log, "split", default="")
    least = math.ceil(SHORTEST / interval - 1e-9)
    begins = np.stack([bridged(one, interval) for one in points[:, :, free]])
    pieces, left_out = _pieces(points[:, :, free], begins, log.episode_length, samples, least)
    if not pieces:
        raise ValueError(_no_window(int(log.episode_length.max()), least, interval))

    def cut(array):
        rows = []
        for e, begin, size in pieces:
            row = array[e, begin : begin + size]
            rows.append(np.concatenate([row, np.repeat(row[-1:], samples - size, axis=0)]))
        return np.stack(rows)

    mask = np.stack([np.arange(samples) < size for _, _, size in pieces])
    keypoints = cut(points[:, :, free])
    keypoints[:, :2] = np.where(np.isfinite(keypoints[:, :2]), keypoints[:, :2], cut(begins)[:, :2])
    windows = Windows(
        keypoints=keypoints,
        position=cut(clamp),
        frames=cut(frames),
        valid=mask,
        interval=interval,
        episode=np.array([e for e, _, _ in pieces]),
        begin=np.array([begin for _, begin, _ in pieces]),
        group=np.array([groups[recording[e]] for e, _, _ in pieces]),
        trust=np.ones(len(pieces)),
        split=tuple(splits[e] for e, _, _ in pieces),
        name=tuple(files[e] for e, _, _ in pieces),
        held=held,
        arclength=np.append(s[free], last) - first,
        n_keypoints=len(s),
        first_clamp=float(first - s[0]),
        gravity=tuple(log.meta["gravity_m_per_s2"]),
        rolls=rolls_observed(log),
        smoothed=float(np.sqrt((taken**2).mean(axis=-1)).max()),
        short=_short(log.episode_length, samples, least),
        left_out=tuple(f"file {files[e]} from {begin * interval:.3g} s" for e, begin in left_out),
    )
    return dataclasses.replace(windows, trust=np.where(windows.torn, _TORN, 1.0))


def _pieces(
    points: Float[np.ndarray, "E T F 3"],
    begins: Float[np.ndarray, "E T F 3"],
    length: Int[np.ndarray, "E"],
    samples: int,
    least: int,
) -> tuple[list[tuple[int, int, int]], list[tuple[int, int]]]:
    """Windows (episode, first sample, samples), and those left out: no two whole samples, or fits see nothing later.

    Where nowhere in a window two samples are observed as a whole, it begins with two that are in `begins`.
    """
    pieces, left_out = [], []
    for e, count in enumerate(length):
        for begin in range(0, int(count), samples):
            end = min(begin + samples, int(count))
            if end - begin < least:
                continue
            # a window begins where its initial shape and velocity are known
            starts = (_first_pair(each[e, begin:end]) for each in (points, begins))
            start = begin + next((at for at in starts if at <= end - begin - least), end - begin)
            if end - start >= least and np.isfinite(points[e, start:end][FITTED]).any():
                pieces.append((e, start, end - start))
            else:
                left_out.append((e, begin))
    return pieces, left_out


def _no_window(longest: int, least: int, interval: float) -> str:
    """Why there is no window, from the samples of the longest episode, and what to do."""
    if longest < least:
        long = f"{(longest - 1) * interval:.3g} s long, expected at least {SHORTEST:g} s"
        return f"The longest episode is {long}. Record longer motions."
    return (
        f"No episode has two samples in a row that show all keypoints, or miss them for at most {FILLED:g} s, and then "
        f"{SHORTEST:g} s more. Record with more cameras, or leave out the keypoints that are seen least."
    )


def _short(length: Int[np.ndarray, "E"], samples: int, least: int) -> float:
    """Part of the samples in episodes, or ends of episodes, that are shorter than `least` samples."""
    rest = length % samples
    return float(rest[rest < least].sum() / length.sum())


def _first_pair(points: Float[np.ndarray, "T F 3"]) -> int:
    """The first of two samples that have all keypoints; the number of samples where there are none."""
    seen = np.asarray(np.isfinite(points).all(axis=(1, 2)))
    both = seen[:-1] & seen[1:]
    return int(both.argmax()) if both.any() else len(points)


def _sample_interval(log: GapLog) -> float:
    """The one sample interval [s] of a log that has passed all checks, see `windows_of`."""
    if not log.in_space or log.gripper_pose.shape[2] != 2:
        raise ValueError(
            f"The log has keypoints in {log.keypoints.shape[-1]} dimensions and {log.gripper_pose.shape[2]} grippers, "
            "expected a cable in space (3) between two grippers."
        )
    if log.meta["table"] is not None:
        raise ValueError("The log has a table; a cable in space is expected to hang free (`table` null).")
    intervals = log.intervals
    interval = float(np.median(intervals))
    if np.abs(intervals - interval).max() > 0.05 * interval:
        raise ValueError(
            f"Samples are {intervals.min():.4g} to {intervals.max():.4g} s apart, expected one interval: resample."
        )
    require_fitting_length(
        [np.asarray(p[:n], float) for p, n in zip(log.keypoints, log.episode_length, strict=True)],
        np.asarray(log.meta["keypoint_arclength_m"], float),
        "meta.keypoint_arclength_m",
    )
    if fault := cable_fault(log):
        raise ValueError(fault)
    return interval
