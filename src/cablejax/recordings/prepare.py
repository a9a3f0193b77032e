"""Prepares takes for a gap log: repairs and reports what has one explanation, and rejects other faults."""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np

from cablejax.recordings.frames import Frame, into_frame, require_hanging, require_rigid
from cablejax.recordings.gaps import cut_at_gaps
from cablejax.recordings.marker_order import restore_order
from cablejax.recordings.poses import poses_from_markers
from cablejax.recordings.take import Take, typical_spacing
from cablejax.recordings.units import METRES, metres_per, recognised_unit, require_metres

_OUTLIER = 1.5
"""Distance of a keypoint from the median of its sample, in lengths of the cable, from which on it cannot be on it."""


@dataclasses.dataclass(frozen=True)
class Setup:
    """Facts about a recording that its numbers do not show.

    Attributes:
        unit: of all lengths: "m", "cm", "mm" or "in"; None = metres, or another unit if the length of the cable leaves
            no doubt.
        frame: the coordinate frame; planar recordings have none.
        on_grippers: "pairs" if the first two and the last two keypoints are on the grippers; "ends" if only the first
            and the last are.
        hangs: the cable hangs free and is not on a table.
        plausible_length: plausible lengths of the cable [m], to recognise an unstated unit.
    """

    unit: str | None = "m"
    frame: Frame = Frame()
    on_grippers: Literal["pairs", "ends"] = "pairs"
    hangs: bool = True
    plausible_length: tuple[float, float] = (0.3, 3.0)

    def __post_init__(self):
        if self.unit is not None:
            metres_per(self.unit)
        if self.on_grippers not in ("pairs", "ends"):
            raise ValueError(f"on_grippers is {self.on_grippers!r}, expected 'pairs' or 'ends'.")


def prepare(takes: tuple[Take, ...], setup: Setup) -> tuple[tuple[Take, ...], list[str]]:
    """Checks and repairs takes of one cable, and gives each the poses of both grippers.

    In this order: the unit of length; the frame; the order of the markers; gaps in time; orientations against markers.

    Returns:
        The takes in metres, z up, right-handed, without gaps, each with gripper poses; and a sentence on each repair.

    Raises:
        ValueError: something is wrong that cannot be repaired without guessing; says what came, what was expected and
            what to do.
    """
    if not takes:
        raise ValueError("The recording has no take, expected at least one.")
    shapes = sorted({take.keypoints.shape[1:] for take in takes})
    if len(shapes) > 1 or shapes[0][0] < (5 if setup.on_grippers == "pairs" else 3):
        raise ValueError(
            f"The takes have keypoints of the shapes {', '.join(map(str, shapes))}, expected one shape with at least "
            "three keypoints, or five if the first two and the last two are on the grippers."
        )
    measured = takes[0].gripper_pose is not None
    if not measured and setup.on_grippers == "ends":
        raise ValueError(
            "The grippers' poses are not given, and only one keypoint is on each: name the columns or topics of the "
            "poses, or two keypoints on each gripper."
        )
    takes, repairs = _in_metres(takes, setup)
    if all(len(take.time) > 1 and _frozen(take.keypoints) for take in takes):
        raise ValueError(
            "All samples have the same keypoints to the last digit, which no tracker measures: expected a recording of "
            "a cable that moves. Check the columns, and that the tracker ran."
        )
    takes, outliers = _without_outliers(takes)
    takes = tuple(into_frame(take, setup.frame) for take in takes)
    takes, exchanged = restore_order(takes)
    if setup.hangs and takes[0].keypoints.shape[2] == 3:
        require_hanging(takes, setup.frame)
    last = takes[0].keypoints.shape[1] - 1
    pairs = ((0, 1), (last - 1, last))
    takes, cut = cut_at_gaps(takes, None if measured else (*pairs[0], *pairs[1]))
    if measured and setup.on_grippers == "pairs" and takes[0].keypoints.shape[2] == 3:
        require_rigid(takes, pairs)
    if not measured:
        takes = tuple(_with_poses(take, pairs) for take in takes)
    return takes, [*repairs, *outliers, *exchanged, *cut]


def _frozen(keypoints: np.ndarray) -> bool:
    return bool(np.array_equal(keypoints[1:], keypoints[:-1], equal_nan=True))


def _without_outliers(takes: tuple[Take, ...]) -> tuple[tuple[Take, ...], list[str]]:
    """Marks keypoints as not observed that lie farther from the rest of their sample than the cable is long."""
    length, kept, count, farthest = float(typical_spacing(takes).sum()), [], 0, 0.0
    for take in takes:
        middle = np.full((len(take.time), 1, take.keypoints.shape[2]), np.nan)
        shown = np.asarray(np.isfinite(take.keypoints).all(axis=2)).any(axis=1)
        middle[shown, 0] = np.nanmedian(take.keypoints[shown], axis=1)
        distance = np.nan_to_num(np.linalg.norm(take.keypoints - middle, axis=2), nan=0.0)
        far = distance > _OUTLIER * length
        count, farthest = count + int(far.sum()), max(farthest, float(distance.max(initial=0.0)))
        kept.append(dataclasses.replace(take, keypoints=np.where(far[..., None], np.nan, take.keypoints)))
    if not count:
        return takes, []
    return tuple(kept), [
        f"{count} keypoint{'s' if count > 1 else ''} lay up to {farthest:.3g} m from the rest of the cable, which is "
        f"{length:.3g} m long: taken as not observed."
    ]


def _in_metres(takes: tuple[Take, ...], setup: Setup) -> tuple[tuple[Take, ...], list[str]]:
    length = float(typical_spacing(takes).sum())
    repairs: list[str] = []
    unit = setup.unit
    if unit is None:
        low, high = setup.plausible_length
        candidates = recognised_unit(length, setup.plausible_length)
        if "m" in candidates:
            unit = "m"
        elif len(candidates) == 1:
            unit = candidates[0]
            repairs.append(
                f"The cable measures {length:.4g} along its keypoints, which can only be {unit}: all lengths were "
                "converted to metres."
            )
        else:
            raise ValueError(
                f"The cable measures {length:.4g} along its keypoints, expected {low:g} to {high:g} m. "
                + (f"It may be in {' or in '.join(candidates)}: say which. " if candidates else "")
                + "Name the unit of length, or check the order of the coordinates."
            )
    require_metres(length * METRES[unit], unit)
    if unit == "m":
        return takes, repairs
    scale = METRES[unit]

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
