"""Cuts recordings where samples are missing, since the grippers' motion in between is unknown.

A cable can only be simulated through a gap if its ends' motion is known. So samples without a gripper's markers are
filled in if they are few, and end a take otherwise; so do a step in the times, samples that repeat the one before, and
a jump of the whole cable that no hand could cause.
"""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline

from cablejax.arrays import positions_at, stretches
from cablejax.cable_length import coordinate_noise
from cablejax.limits import counted
from cablejax.log_geometry import MOVED, gripper_motion
from cablejax.poses import poses_at, without_misreadings
from cablejax.recordings.take import Take, median_step, spacing

FILLED = 0.05
"""Longest gap [s] in the grippers' poses that is interpolated linearly."""

FILLED_ON_TABLE = 0.21
"""The same where a single sample is missing of a cable on a table, whose grippers move slowly [s]."""

SHORTEST_SAMPLES, SHORTEST = 10, 0.5
"""A take of fewer samples, or shorter [s], is left out after cutting."""

JUMP_ACCELERATION = 100.0
"""Acceleration [m/s^2] of the middle keypoint that is no motion: ten times that of gravity."""

JUMP_RATIO, JUMP_NOISE = 2.5, 6.0
"""Such a step must also be so many times its neighbours, which separates lost samples from a hard stop, and so many
times the noise of a coordinate."""

# Repeated samples: so many in a row are a hold of the last value, if no more than this part of all steps are repeats.
_HELD_SAMPLES, _HELD_PART = 3, 0.2
# Steps after a hold by which it is told from a rest.
_AFTER = 4
# In so many of its steps a slower tracker repeats as often as usual, give or take one.
_REGULAR = 0.9
# Findings that an error lists.
_TOLD = 6


def cut_at_gaps(takes: tuple[Take, ...], on_grippers: tuple[int, ...] | None) -> tuple[tuple[Take, ...], list[str]]:
    """Cuts takes where samples are missing.

    Args:
        takes: of one cable.
        on_grippers: keypoints on the grippers, which locate them; None where the poses were measured separately.

    Returns:
        The takes, each with the name of its recording as a label where it has none, and one sentence for each that was
        changed.

    Raises:
        ValueError: nothing long enough is left, or one gripper is never seen; says why.
    """
    _require_grippers(takes, on_grippers)
    parts: list[Take] = []
    reports: list[str] = []
    for take in takes:
        take = _without_misreadings(_without_repeats(take, reports), reports)
        take, filled = _filled(take, on_grippers)
        if filled:
            reports.append(
                f"Take {take.name}: {counted(filled, 'sample')} without one of the gripper poses: interpolated "
                f"linearly. None of these gaps is longer than {_fillable(take):.2g} s."
            )
        known = _known(take, on_grippers)
        breaks, reasons = _breaks(take)
        reports.extend(reasons)
        edges = np.zeros(len(take.time) + 1, bool)
        edges[[0, -1]] = True
        edges[breaks] = True
        edges[1:-1] |= known[1:] != known[:-1]
        begins = np.flatnonzero(edges).tolist()
        spans = [(a, b) for a, b in itertools.pairwise(begins) if known[a]]
        long_enough = ((a, b) for a, b in spans if b - a >= SHORTEST_SAMPLES)
        kept = [(a, b) for a, b in long_enough if take.time[b - 1] - take.time[a] >= SHORTEST]
        if not known.all():
            reports.append(
                f"Take {take.name}: in {counted(int((~known).sum()), 'sample')} one of the gripper poses is missing "
                f"for more than {_fillable(take):.2g} s: left out."
            )
        if lost := sum(b - a for a, b in spans) - sum(b - a for a, b in kept):
            reports.append(
                f"Take {take.name}: {counted(lost, 'sample')} in stretches shorter than {SHORTEST:g} s or "
                f"{SHORTEST_SAMPLES} samples: left out."
            )
        # what was cut is still one recording
        take = dataclasses.replace(take, labels={"recording": take.name, **take.labels})
        for index, (a, b) in enumerate(kept, 1):
            name = take.name if len(kept) == 1 else f"{take.name}/{index}"
            parts.append(dataclasses.replace(take.part(slice(a, b)), name=name))
    if not parts:
        steps = np.concatenate([np.diff(take.time) for take in takes])
        apart = f" Its samples are {np.median(steps):.3g} s apart: check the unit of time." if len(steps) else ""
        more = f" And {len(reports) - _TOLD} more." if len(reports) > _TOLD else ""
        raise ValueError(
            f"Between its gaps the recording has no stretch of at least {SHORTEST:g} s and {SHORTEST_SAMPLES} "
            f"samples in which both gripper poses are known.{apart} Found: {' '.join(reports[:_TOLD])}{more}"
        )
    return tuple(parts), reports


def _require_grippers(takes: tuple[Take, ...], on_grippers: tuple[int, ...] | None) -> None:
    for gripper in (0, 1):
        ends = (np.split(_ends(take, on_grippers), 2, axis=1)[gripper] for take in takes)
        if not any(np.isfinite(end).all(axis=(1, 2)).any() for end in ends):
            what = "has no pose in any sample"
            if on_grippers is not None:
                first, second = on_grippers[2 * gripper : 2 * gripper + 2]
                what = f"is located by keypoints {first} and {second}, which are never observed together"
            raise ValueError(
                f"Gripper {gripper} {what}. Both ends must be known: name the columns or topic of its pose, or two "
                "markers that are on it."
            )


def bridged(points: Float[np.ndarray, "T F 3"], interval: float) -> Float[np.ndarray, "T F 3"]:
    """The same with gaps of up to `FILLED` of each marker filled by a smooth curve through what is seen of it.

    Args:
        points: [m], NaN = not observed.
        interval: between samples [s].
    """
    filled = points.copy()
    for k in range(points.shape[1]):
        seen = np.flatnonzero(np.isfinite(points[:, k]).all(axis=-1))
        if len(seen) < 2:
            continue
        curve = CubicSpline(seen, points[seen, k])
        for last, following in itertools.pairwise(seen.tolist()):
            if 1 < following - last <= FILLED / interval + 1e-9:
                between = np.arange(last + 1, following)
                filled[between, k] = curve(between)
    return filled


def _fillable(take: Take) -> float:
    """Longest gap that is filled [s]."""
    steps = np.diff(take.time)
    usual = float(np.median(steps)) if len(steps) else 0.0
    one_missing = min(2.1 * usual, FILLED_ON_TABLE) if take.keypoints.shape[2] == 2 else 0.0
    return max(FILLED + 1e-9, one_missing)


def _ends(take: Take, on_grippers: tuple[int, ...] | None) -> np.ndarray:
    """What locates the grippers, both alike, one after the other: their poses, or the keypoints on them."""
    ends = take.gripper_pose if on_grippers is None else take.keypoints[:, on_grippers]
    assert ends is not None
    return ends


def _known(take: Take, on_grippers: tuple[int, ...] | None) -> Bool[np.ndarray, " T"]:
    return np.asarray(np.isfinite(_ends(take, on_grippers)).all(axis=(1, 2)))


def _without_repeats(take: Take, reports: list[str]) -> Take:
    """The take without the samples in which a tracker holds its last values.

    Rounded keypoints of a cable that rests repeat too: samples in which both grippers rest are kept, and without poses
    those after which the cable sets off instead of being somewhere else.
    """
    one, other, hidden = take.keypoints[1:], take.keypoints[:-1], np.isnan(take.keypoints)
    same = ((one == other) | (hidden[1:] & hidden[:-1])).all(axis=(1, 2)) & ~hidden[1:].all(axis=(1, 2))
    if not same.any():
        return take
    if slower := _slower(same):
        reports.append(
            f"Take {take.name}: {int(same.sum())} samples repeat the previous one to the last digit, at least one "
            f"after each new sample: the tracker is about {slower} times slower than the recording. Only new samples "
            "are kept."
        )
        return take.part(np.append(True, ~same))
    if same.mean() > _HELD_PART:
        return take
    repeated = np.zeros(len(take.time), bool)
    length = float(np.median(np.nansum(spacing(take.keypoints), axis=1)))
    least = JUMP_NOISE * coordinate_noise([take.keypoints])
    for a, b in stretches(same):
        if b - a >= _HELD_SAMPLES and _moves(take, a, b, MOVED * length, least):
            repeated[a + 1 : b + 1] = True
    if not repeated.any():
        return take
    reports.append(
        f"Take {take.name}: {int(repeated.sum())} samples repeat the previous one to the last digit although the "
        "recording otherwise moves: they are treated as not observed."
    )
    if take.gripper_pose is None:  # a cut where the grippers are not known either
        return dataclasses.replace(take, keypoints=np.where(repeated[:, None, None], np.nan, take.keypoints))
    return take.part(~repeated)


def _moves(take: Take, first: int, last: int, distance: float, least: float) -> bool:
    """Whether a gripper moves by more than a distance [m] between two samples; without poses, see `_catches_up`."""
    if take.gripper_pose is None:
        return _catches_up(take.keypoints[last:], least)
    return gripper_motion(take.gripper_pose[first : last + 1], take.keypoints.shape[2]) > distance


def _catches_up(points: Float[np.ndarray, "S N D"], least: float) -> bool:
    """Whether the first step is larger than this [m] and than those after it, or nothing tells that it is not.

    A cable that sets off from a rest has neither.
    """
    seen = np.asarray(np.isfinite(points).all(axis=2))
    step = median_step(points[seen.any(axis=1)][: _AFTER + 1])
    if len(step) < _AFTER:
        return True
    return not step[0] <= max(least, JUMP_RATIO * float(step[1:].max()))


def _slower(same: Bool[np.ndarray, " S"]) -> int:
    """Of how many samples one is new, if that is so throughout; 0 otherwise.

    Args:
        same: whether each sample but the first repeats the one before.
    """
    apart = np.diff(np.flatnonzero(np.append(True, ~same)))
    usual = int(np.median(apart)) if len(apart) else 1
    regular = len(apart) > _HELD_SAMPLES and (np.abs(apart - usual) <= 1).mean() > _REGULAR
    return usual if usual > 1 and regular else 0


def _without_misreadings(take: Take, reports: list[str]) -> Take:
    if take.gripper_pose is None:
        return take
    pose, jumps = without_misreadings(take.time, take.gripper_pose)
    reports += [f"Take {take.name}: the pose of gripper {q} {words}" for q, words in jumps.items()]
    return dataclasses.replace(take, gripper_pose=pose)


def _filled(take: Take, on_grippers: tuple[int, ...] | None) -> tuple[Take, int]:
    """Short gaps in what is known of the grippers, filled in; and how many samples that were."""
    known = _known(take, on_grippers)
    few, longest = np.zeros(len(known), bool), _fillable(take)
    for a, b in stretches(~known):
        if a > 0 and b < len(known) and take.time[b] - take.time[a - 1] <= longest:
            few[a:b] = True
    if not few.any():
        return take, 0
    ends = _ends(take, on_grippers)
    values = ends.copy()
    between = positions_at if on_grippers is not None else poses_at
    for part in range(values.shape[1]):
        # what was observed of the other gripper stays
        seen = np.isfinite(ends[:, part]).all(axis=-1)
        lost = few & ~seen
        values[lost, part] = between(take.time[lost], take.time[seen], ends[seen, part])
    if on_grippers is None:
        return dataclasses.replace(take, gripper_pose=values), int(few.sum())
    points = take.keypoints.copy()
    points[:, on_grippers] = values
    return dataclasses.replace(take, keypoints=points), int(few.sum())


def _breaks(take: Take) -> tuple[list[int], list[str]]:
    """First samples after a step in the times or a jump of the cable, and a sentence on each."""
    interval = np.diff(take.time)
    if len(interval) < 3:
        return [], []
    usual = float(np.median(interval))
    late = interval > 1.5 * usual
    breaks, reports = [], []
    for t in np.flatnonzero(late & (interval > _fillable(take))):
        breaks.append(int(t) + 1)
        reports.append(
            f"Take {take.name}: no samples for {interval[t]:.3g} s after sample {t}, where {usual:.3g} s is usual; the "
            "take was cut there."
        )
    # a stamp that is late makes the next interval short, and no jump
    least = JUMP_NOISE * coordinate_noise([take.keypoints])
    for t in _jumps(median_step(take.keypoints), np.maximum(interval, usual), least):
        breaks.append(t + 1)
        reports.append(
            f"Take {take.name}: the whole cable jumps between samples {t} and {t + 1}, so samples are missing without "
            "a gap in the times; the take was cut there."
        )
    return breaks, reports


def _jumps(step: Float[np.ndarray, " S"], interval: Float[np.ndarray, " S"], least: float) -> list[int]:
    # a step between samples that were not seen is unknown: next to two of them nothing tells a jump from motion
    speed = step / interval
    neighbour = np.fmax(np.append(speed[1:], np.nan), np.append(np.nan, speed[:-1]))
    acceleration = (speed - neighbour) / interval
    found = (acceleration > JUMP_ACCELERATION) & (speed > JUMP_RATIO * neighbour) & (step > least)
    return np.flatnonzero(found).tolist()
