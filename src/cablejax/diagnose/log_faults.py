"""Faults of a recording that look like effects: false readings, offsets of a tool, commands of another meaning."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.signal import savgol_coeffs, savgol_filter

from cablejax.arrays import quarter_turn
from cablejax.false_keypoints import FAULTS
from cablejax.limits import counted
from cablejax.poses import without_misreadings
from cablejax.types import ROTATION_WEIGHT, GapLog

# An end keypoint that is off its gripper by this [m], at the same place of the gripper's frame, is reported.
_TOOL, _FIXED = 2e-3, 0.5
# Poses that scatter by less than this from one sample to the next [m, rad] are replayed as they were measured.
_STEADY = np.array([1e-4, 1e-4, 1e-3])
# Samples over which they may be smoothed by a parabola.
_WINDOWS = (5, 7, 11, 15, 21, 31, 45, 65, 91)
_PARABOLA = 2
# Scatter by fifth differences over that by third ones, at least.
_WHITE = 0.5
# Commands that leave the poses by this [m], and by this part of it in another meaning, have that one.
_UNFIT, _FITS = 0.02, 0.2
# By how much poses may come later than the keypoints for it to be looked for [s].
_LATEST = 1.0


def as_measured(log: GapLog) -> tuple[GapLog, list[str]]:
    """A log without what was not measured, and sentences on it.

    Poses of the grippers that jump away and back are interpolated; keypoints that a tracker holds or misreads count as
    not observed, see `false_keypoints`.
    """
    pose, points, sentences = log.gripper_pose.copy(), log.keypoints.copy(), []
    for e, n in enumerate(log.episode_length):
        pose[e, :n], jumps = without_misreadings(log.time[e, :n], pose[e, :n])
        sentences += [f"In episode {e} the pose of gripper {q} {words}" for q, words in jumps.items()]
    usual = _usual_spacing(log)
    for words, find in FAULTS.items():
        found = np.zeros(points.shape[:3], bool)
        for e, n in enumerate(log.episode_length):
            found[e, :n] = find(log.time[e, :n], points[e, :n], usual)
        if found.any():
            points[found] = np.nan
            which, (episode, sample, _) = np.flatnonzero(found.any(axis=(0, 1))), np.argwhere(found)[0]
            each = "Keypoint" if len(which) == 1 else "Each of keypoints"
            sentences.append(
                f"{each} {', '.join(map(str, which))} {words} in {counted(int(found.sum()), 'sample')}, the "
                f"first at {log.time[episode, sample]:.4g} s of episode {episode}: treated as not observed."
            )
    return dataclasses.replace(log, gripper_pose=pose, keypoints=points) if sentences else log, sentences


def _usual_spacing(log: GapLog) -> Float[np.ndarray, " M"]:
    """How far each keypoint usually is from the next one [m], at least as stated: in a bent cable they are nearer."""
    spacing = np.diff(np.asarray(log.meta["keypoint_arclength_m"], float))
    distance = np.linalg.norm(np.diff(log.keypoints[log.valid].astype(float), axis=1), axis=-1)
    for k in np.flatnonzero(np.isfinite(distance).any(axis=0)):
        spacing[k] = max(spacing[k], float(np.nanmedian(distance[:, k])))
    return spacing


def tool_offset(end: Float[np.ndarray, "E T 2"], pose: Float[np.ndarray, "E T 3"], gripper: int) -> list[str]:
    """A sentence if an end of the cable is off its gripper by a constant vector in the gripper's frame.

    Args:
        end: keypoint at the gripper [m], NaN = not observed.
        pose: of the gripper [m, rad].
        gripper: its number, for the sentence.
    """
    own = _turned(end - pose[..., :2], -pose[..., 2])
    own = own[np.isfinite(own).all(axis=-1)]
    if not len(own):
        return []
    along, across = np.median(own, axis=0)
    size = float(np.hypot(along, across))
    if size < _TOOL or np.median(np.linalg.norm(own - [along, across], axis=-1)) > _FIXED * size:
        return []
    return [
        f"The keypoint at gripper {gripper} is {1e3 * abs(along):.1f} mm {'ahead of' if along > 0 else 'behind'} its "
        f"pose and {1e3 * abs(across):.1f} mm beside it in the gripper's frame, in all samples. An offset of the tool "
        "is not an effect of the library but can look like one: correct the pose. An offset of the marker is a "
        "keypoint bias."
    ]


def clock_offset(
    ends: Float[np.ndarray, "E T 2 D"],
    place: Float[np.ndarray, "E T 2 D"],
    length: Int[np.ndarray, "E"],
    interval: Float[np.ndarray, "E"],
) -> tuple[float, str] | None:
    """Delay of the grippers' poses relative to the keypoints on them [s], and how well they fit near that delay.

    None where they fit as they are, or at no other time.

    Args:
        ends: keypoints at the grippers [m], NaN = not observed.
        place: of the grippers [m].
        length: valid samples of each episode.
        interval: between samples [s].
    """

    def apart(seconds: float) -> float:
        squares = []
        for q in (0, 1):
            rows = []
            for end, own, n, step in zip(ends[:, :, q], place[:, :, q], length, interval, strict=True):
                ahead = round(seconds / step)
                before, after = max(-ahead, 0), max(ahead, 0)
                count = max(n - abs(ahead), 0)
                rows.append(end[before : before + count] - own[after : after + count])
            off = np.concatenate(rows)
            off = off[np.isfinite(off).all(axis=1)]
            if len(off):
                squares.append((off - np.median(off, axis=0)) ** 2)
        return float(np.sqrt(np.mean(np.concatenate(squares)))) if squares else np.inf

    now = apart(0.0)
    if not _TOOL < now < np.inf:
        return None
    step = float(np.max(interval))
    most = int(_LATEST / step)
    shifts = step * np.arange(-most, most + 1)
    sizes = [apart(shift) for shift in shifts]
    best = int(np.argmin(sizes))
    if sizes[best] > _FITS * now:
        return None
    seconds = float(shifts[best])
    if 0 < best < len(shifts) - 1:
        # between samples: at the lowest point of the parabola through three squares
        below, least, above = np.square(sizes[best - 1 : best + 2])
        if np.isfinite(below + above) and below + above > 2 * least:
            seconds += 0.5 * step * (below - above) / (below - 2 * least + above)
    return seconds, f"{1e3 * sizes[best]:.2g} mm off instead of {1e3 * now:.2g} mm (root mean square)"


def early_keypoints(offset: tuple[float, str] | None) -> list[str]:
    """A sentence if the cable's ends are ahead of their grippers: the poses lag, or have another clock.

    The other way round it is `camera_lag`, an effect of the library on a table.

    Args:
        offset: see `clock_offset`.
    """
    if offset is None or offset[0] <= 0:
        return []
    seconds, fit = offset
    return [
        f"The keypoints at the grippers fit their poses {seconds:.2g} s later: {fit}. The poses are stamped late, or "
        "keypoints and poses have different clocks. This is not an effect of the library but can look like one: shift "
        "the poses."
    ]


def integrated(
    first: Float[np.ndarray, "E 2 3"], command: Float[np.ndarray, "E T 2 3"], interval: Float[np.ndarray, "E"]
) -> Float[np.ndarray, "E T 2 3"]:
    """Poses of arms that follow their commands exactly, from the first ones on."""
    steps = command * np.asarray(interval)[:, None, None, None]
    return first[:, None] + np.concatenate([np.zeros_like(steps[:, :1]), np.cumsum(steps, axis=1)[:, :-1]], axis=1)


def scatter_of(
    off: Float[np.ndarray, "E T 2 3"], valid: Bool[np.ndarray, "E T"], order: int = 3
) -> Float[np.ndarray, "2 3"]:
    """Noise of poses, from differences of their deviations, which are smooth except for jumps.

    Args:
        off: in any unit of each coordinate.
        valid: samples that are no padding.
        order: of the differences.
    """
    differences = np.diff(off, order, axis=1)[valid[:, order:]]
    # of white noise they are so many times as large
    larger = math.sqrt(math.comb(2 * order, order))
    return np.median(np.abs(differences), axis=0) / (0.6745 * larger) if differences.size else np.zeros(off.shape[2:])


def steadied(
    pose: Float[np.ndarray, "E T 2 3"],
    expected: Float[np.ndarray, "E T 2 3"],
    length: Int[np.ndarray, "E"],
    *,
    least: Float[np.ndarray, "3"] = _STEADY,
) -> tuple[Float[np.ndarray, "E T 2 3"], Float[np.ndarray, "2 3"]]:
    """Smooths measured poses that scatter from one sample to the next, which would shake the simulated cable.

    What they are off the expected ones by is smoothed by local parabolas (Savitzky and Golay), over so many samples as
    generalised cross-validation chooses for each coordinate. Poses of encoders stay as they are.

    Args:
        pose: theta continuous, the last one held over the padding [m, m, rad].
        expected: motion without scatter that they follow more or less, zero where there is none.
        length: valid samples of each episode.
        least: scatter from which on a coordinate is smoothed; [m, m, rad] by default.

    Returns:
        The poses, and the root mean square of what was taken from each coordinate [m, m, rad]; zero for encoders.
    """
    off, steady = pose - expected, np.zeros((2, 3))
    valid = np.arange(pose.shape[1])[None] < np.asarray(length)[:, None]
    scatter = scatter_of(off, valid)
    # of noise both orders say the same; of motion in few samples, higher differences are smaller
    noisy = (scatter > least) & (scatter_of(off, valid, 5) > _WHITE * scatter)
    if not noisy.any():
        return pose, steady
    smooth = pose.copy()
    for gripper, axis in np.argwhere(noisy):
        paths = _least_unseen_error([row[:n] for row, n in zip(off[..., gripper, axis], length, strict=True)])
        for episode, path in enumerate(paths):
            n = len(path)
            smooth[episode, :n, gripper, axis] = expected[episode, :n, gripper, axis] + path
            smooth[episode, n:, gripper, axis] = smooth[episode, n - 1, gripper, axis]
    taken = np.sqrt(np.mean((pose - smooth)[valid] ** 2, axis=0))
    return (smooth, taken) if (taken > least).any() else (pose, steady)


def _least_unseen_error(series: list[Float[np.ndarray, "T"]]) -> list[Float[np.ndarray, "T"]]:
    """Local parabolas through each of the series, over the number of samples that predicts left-out ones best."""
    best, least = series, np.inf
    for window in _WINDOWS:
        widths = [min(window, (len(values) - 1) | 1) for values in series]
        paths = [
            np.asarray(savgol_filter(values, width, _PARABOLA)) if width > _PARABOLA + 1 else values
            for values, width in zip(series, widths, strict=True)
        ]
        # a left-out sample is missed by so many times what it is missed by itself
        factor = 1.0 / (1.0 - savgol_coeffs(window, _PARABOLA)[window // 2])
        off = np.concatenate([values - path for values, path in zip(series, paths, strict=True)])
        error = factor * float(np.sqrt(np.mean(off**2)))
        if error < least:
            best, least = paths, error
    return best


def command_fault(
    pose: Float[np.ndarray, "E T 2 3"],
    command: Float[np.ndarray, "E T 2 3"],
    interval: Float[np.ndarray, "E"],
    valid: Bool[np.ndarray, "E T"],
) -> str | None:
    """The unit or meaning under which commands fit the poses, in words; None for twists in the world's frame."""
    degrees, millimetres = np.array([1, 1, np.pi / 180]), np.array([1e-3, 1e-3, 1])
    weight = np.array([1.0, 1.0, ROTATION_WEIGHT])

    def off(twist: np.ndarray) -> float:
        return float(np.sqrt(np.mean((weight * (pose - integrated(pose[:, 0], twist, interval)))[valid] ** 2)))

    differences = np.diff(command, axis=1, append=command[:, -1:])
    others = {
        "poses, not velocities: divide their differences by the time between samples": differences
        / interval[:, None, None, None],
        "omega in degrees per second: multiply it by pi / 180": command * degrees,
        "vx and vy in mm/s: divide them by 1000": command * millimetres,
        "vx and vy in mm/s and omega in degrees per second: convert them": command * millimetres * degrees,
        "the motion of a sample: divide it by the time between samples": command / interval[:, None, None, None],
        "velocities in the gripper's frame: turn them by its angle": np.concatenate(
            [_turned(command[..., :2], pose[..., 2]), command[..., 2:]], axis=-1
        ),
        "those of the other gripper: exchange them": command[:, :, ::-1],
    }
    as_is = off(command)
    best = min(others, key=lambda name: off(others[name]))
    if as_is < _UNFIT or off(others[best]) > _FITS * as_is:
        return None
    return (
        f"Field 'gripper_command' integrates to poses {as_is:.2g} m away from 'gripper_pose' (root mean square), "
        "expected twists "
        f"(vx, vy, omega) in the world's frame, in m/s and rad/s. They would fit the poses as {best}."
    )


def _turned(vectors: Float[np.ndarray, "*B 2"], angle: Float[np.ndarray, "*B"]) -> Float[np.ndarray, "*B 2"]:
    return np.cos(angle)[..., None] * vectors + np.sin(angle)[..., None] * quarter_turn(vectors)
