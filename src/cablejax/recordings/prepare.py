"""Prepares takes for a gap log: repairs and reports what has one explanation, and rejects other faults."""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage

from cablejax.cable_length import ring_chords
from cablejax.poses import poses_from_markers, twists
from cablejax.recordings.frames import (
    Frame,
    into_frame,
    onto_table,
    require_along_x,
    require_hanging,
    require_rigid,
)
from cablejax.recordings.gaps import cut_at_gaps
from cablejax.recordings.marker_order import restore_order
from cablejax.recordings.strays import without_doubles, without_false_keypoints, without_outliers, without_stretched
from cablejax.recordings.take import Take, spacing, typical_spacing
from cablejax.recordings.units import METRES, recognised_unit, require_metres

_USUAL_LENGTH = 0.3, 3.0
"""Lengths of a cable [m] by which an unstated unit is recognised."""
_JERK, _UNUSUAL = (("m/s^2", 50.0, 0.0), ("rad/s^2", 300.0, 0.3)), 10.0
"""Accelerations of a gripper that are reported, what they have to change a step by [m, rad], and how many times their
median in the take they are: noise has some."""
_TOLD = 5
_NAMED = 20

_OTHER_CABLE, _DIFFERS, _LEAST = 0.05, 0.02, 3
"""Takes are of two cables if the logarithms of their spacings differ by the first number (root mean square), and at
least the third number of them by the second: bending moves them by 0.01 to 0.03, a marker that slipped moves two. Few
keypoints, which are far apart, may differ by twice as much as bending the cable into a ring makes."""


@dataclasses.dataclass(frozen=True)
class Setup:
    """Facts about a recording that cannot be inferred from its numbers.

    Attributes:
        unit: of all lengths: "m", "cm", "mm" or "in"; None = metres, or another unit if the length of the cable leaves
            no doubt.
        frame: the coordinate frame; planar recordings have none.
        on_grippers: "pairs" if the first two and the last two keypoints are on the grippers; "ends" if only the first
            and the last are.
        hangs: the cable hangs free; otherwise it lies on a table.
    """

    unit: str | None = "m"
    frame: Frame = Frame()
    on_grippers: Literal["pairs", "ends"] = "pairs"
    hangs: bool = True

    def __post_init__(self):
        if self.unit not in (None, *METRES):
            raise ValueError(f"The unit of length is {self.unit!r}, expected one of {', '.join(METRES)}.")
        if self.on_grippers not in ("pairs", "ends"):
            raise ValueError(f"on_grippers is {self.on_grippers!r}, expected 'pairs' or 'ends'.")


def prepare(takes: tuple[Take, ...], setup: Setup) -> tuple[tuple[Take, ...], list[str]]:
    """Checks and repairs takes of one cable, and gives each the poses of both grippers.

    In this order: all of `repaired`; takes in which the cable stretches, which are left out; poses that jump away and
    back, and gaps in time; orientations against markers; jerks of the grippers, which are kept.

    Returns:
        The takes in metres, z up, right-handed, without gaps, each with gripper poses; and a sentence on each repair.

    Raises:
        ValueError: something is wrong that cannot be repaired without guessing; says what was found, what was
            expected and what to do.
    """
    takes, repairs = repaired(takes, setup)
    measured = takes[0].gripper_pose is not None
    takes = _noted(without_stretched(takes), repairs)
    last = takes[0].keypoints.shape[1] - 1
    pairs = ((0, 1), (last - 1, last))
    takes = _noted(cut_at_gaps(takes, None if measured else (*pairs[0], *pairs[1])), repairs)
    # with one keypoint on each gripper the assembled log is checked
    if measured and takes[0].keypoints.shape[2] == 3 and setup.on_grippers == "pairs":
        require_rigid(takes, pairs)
        require_along_x(takes, pairs)
    if not measured:
        takes = tuple(_with_poses(take, pairs) for take in takes)
    return takes, [*repairs, *_jerks(takes)]


def repaired(takes: tuple[Take, ...], setup: Setup) -> tuple[tuple[Take, ...], list[str]]:
    """Checks and repairs takes of one cable without leaving out any sample.

    In this order: the unit of length; markers at one place; the frame; heights above a table, which are left out;
    branches and the order of the markers; whether it is one cable; markers that are held or misread; which way is up.

    Returns:
        As many takes, of as many samples, in metres, z up, right-handed; and a sentence on each repair.

    Raises:
        ValueError: as `prepare`.
    """
    if not takes:
        raise ValueError("The recording has no take, expected at least one.")
    shapes = sorted({take.keypoints.shape[1:] for take in takes})
    if len(shapes) > 1 or shapes[0][0] < (5 if setup.on_grippers == "pairs" else 3):
        raise ValueError(
            f"The takes have keypoints of the shapes {', '.join(map(str, shapes))}, expected one shape with at least "
            "three keypoints, or five if the first two and the last two are on the grippers."
        )
    if takes[0].gripper_pose is None and setup.on_grippers == "ends":
        raise ValueError(
            "The grippers' poses are not given, and only one keypoint is on each: name the columns or topics of the "
            "poses, or two keypoints on each gripper."
        )
    repairs: list[str] = []
    takes = _noted(_in_metres(takes, setup), repairs)
    takes = _noted(without_doubles(takes), repairs)
    points = [take.keypoints for take in takes]
    if all(len(own) > 1 and np.array_equal(own[1:], own[:-1], equal_nan=True) for own in points):
        raise ValueError(
            "All samples have the same keypoints to the last digit, which no tracker measures: expected a recording of "
            "a cable that moves. Check which columns or topic are read, and that the tracker ran."
        )
    takes = tuple(into_frame(take, setup.frame) for take in _noted(without_outliers(takes), repairs))
    if not setup.hangs and takes[0].keypoints.shape[2] == 3:
        takes = _noted(onto_table(takes), repairs)
    takes = _noted(restore_order(takes), repairs)
    _require_one_cable(takes, setup)
    takes = _noted(without_false_keypoints(takes), repairs)
    if takes[0].keypoints.shape[2] == 3:
        require_hanging(takes, setup.frame)
    return takes, repairs


def _noted(result: tuple[tuple[Take, ...], list[str]], repairs: list[str]) -> tuple[Take, ...]:
    """The takes of a step, whose sentences are added to those on the repairs before."""
    repairs.extend(result[1])
    return result[0]


def _require_one_cable(takes: tuple[Take, ...], setup: Setup) -> None:
    """Refuses takes whose keypoints sit at clearly other distances; grips, which differ, are not looked at."""
    ends = 2 if setup.on_grippers == "pairs" else 1
    every = [spacing(take.keypoints)[:, ends:-ends] for take in takes]
    if len(takes) < 2 or every[0].shape[1] < _LEAST:
        return
    rows = np.full((len(takes), every[0].shape[1]), np.nan)
    for row, distances in zip(rows, every, strict=True):
        seen = np.isfinite(distances).any(axis=0)
        row[seen] = np.log(np.nanmedian(distances[:, seen], axis=0))

    usually = typical_spacing(takes)
    bent = -2 * np.log(ring_chords(usually) / usually)[ends:-ends]

    def apart(one: np.ndarray, other: np.ndarray) -> float:
        seen = np.isfinite(one - other)
        off, least = (one - other)[seen], np.maximum(bent[seen], _DIFFERS)
        differ = len(off) and (np.abs(off) > least).sum() >= _LEAST
        return float(np.sqrt((off**2).mean())) if differ else 0.0

    # condensed, as pdist makes it
    distances = [apart(rows[i], rows[j]) for i in range(len(rows)) for j in range(i + 1, len(rows))]
    cable = fcluster(linkage(distances, "single"), _OTHER_CABLE, "distance")
    names, counts = np.unique(cable, return_counts=True)
    if len(names) == 1:
        return
    usual = cable == names[counts.argmax()]
    others = [take.name for take, same in zip(takes, usual, strict=True) if not same]
    more = f" and {len(others) - _NAMED} more" if len(others) > _NAMED else ""
    here, there = (np.exp(np.nanmedian(rows[part], axis=0)) for part in (~usual, usual))
    k = int(np.nanargmax(np.abs(np.log(here / there))))
    raise ValueError(
        f"The takes show {len(names)} different cables: in take {', '.join(others[:_NAMED])}{more} the keypoints are "
        f"at other distances from each other than in the other {usual.sum()} (keypoints {k + ends} and {k + ends + 1}: "
        f"{1e3 * here[k]:.1f} mm instead of {1e3 * there[k]:.1f} mm). Import each cable separately."
    )


def _jerks(takes: tuple[Take, ...]) -> list[str]:
    """A sentence on the grippers' jerks, if there are any."""
    found: list[tuple[float, str]] = []
    for take in takes:
        assert take.gripper_pose is not None
        twist = twists(take.time, take.gripper_pose)[:-1]
        step = np.diff(take.time)[1:, None, None]
        change = np.diff(twist, axis=0) / step
        for (unit, least, jump), part in zip(_JERK, np.split(change, [take.keypoints.shape[2]], axis=-1), strict=True):
            size = np.linalg.norm(part, axis=-1)
            usual = np.median(size, axis=0) if len(size) else np.zeros(2)
            size[size * step[..., 0] ** 2 < jump] = 0.0
            for gripper, most in enumerate(size.max(axis=0, initial=0.0)):
                if most > max(least, _UNUSUAL * usual[gripper]):
                    when = take.time[int(np.argmax(size[:, gripper])) + 1]
                    words = f"gripper {gripper} of take {take.name} by {most:.0f} {unit} at {when:.3g} s"
                    found.append((most / least, words))
    if not found:
        return []
    strongest = [text for _, text in sorted(found, reverse=True)]
    more = f", and {len(found) - _TOLD} more" if len(found) > _TOLD else ""
    return [
        f"Sudden accelerations: {', '.join(strongest[:_TOLD])}{more}. They were kept; if the arm did not move in this "
        "way, leave that part out."
    ]


def _in_metres(takes: tuple[Take, ...], setup: Setup) -> tuple[tuple[Take, ...], list[str]]:
    length = float(typical_spacing(takes).sum())
    repairs: list[str] = []
    unit = setup.unit
    if unit is None:
        low, high = _USUAL_LENGTH
        candidates = recognised_unit(length, _USUAL_LENGTH)
        if "m" in candidates:
            unit = "m"
        elif len(candidates) == 1:
            unit = candidates[0]
            repairs.append(
                f"The cable measures {length:.4g} along its keypoints, which is plausible only in {unit}: all lengths "
                "were converted to metres."
            )
        else:
            raise ValueError(
                f"The cable measures {length:.4g} along its keypoints, expected {low:g} to {high:g} m. "
                + (f"It may be in {' or in '.join(candidates)}: state which. " if candidates else "")
                + "Name the unit of length, or check the order of the coordinates."
            )
    scale = METRES[unit]
    require_metres(length * scale, unit)
    if unit == "m":
        return takes, repairs

    def scaled(take: Take) -> Take:
        pose = take.gripper_pose
        if pose is not None:
            positions = take.keypoints.shape[2]
            pose = np.concatenate([pose[..., :positions] * scale, pose[..., positions:]], axis=-1)
        return dataclasses.replace(take, keypoints=take.keypoints * scale, gripper_pose=pose)

    return tuple(map(scaled, takes)), repairs


def _with_poses(take: Take, pairs: tuple[tuple[int, int], tuple[int, int]]) -> Take:
    points = take.keypoints
    poses = [
        poses_from_markers(points[:, first], points[:, second], points[:, end])
        for (first, second), end in zip(pairs, (0, -1), strict=True)
    ]
    return dataclasses.replace(take, gripper_pose=np.stack(poses, axis=1))
