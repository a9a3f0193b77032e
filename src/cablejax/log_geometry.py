"""Finds keypoints and gripper angles that no cable between these grippers can have."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from cablejax.types import GapLog

REACH = 5.0
"""Largest distance of a keypoint from the nearer gripper, in lengths of the cable. A metre is added for the offset
between the frames of camera and arms."""
INWARDS = np.radians(120.0)
"""Median angle between a gripper's tangent and the cable next to it, at which the tangent points the wrong way."""
MOVED = 0.02
"""Motion of a gripper, in lengths of the cable, in which keypoints that are held by it move too."""
AT_GRIPPER = 0.1
"""Largest median distance of an end's keypoint from its gripper, in lengths of the cable."""
_FEWEST = 5
OFF, BETTER = 0.5, 3.0
"""An angle so far off the cable [rad], and so many times nearer to it in another reading, was misread."""
TURN = 10.0
"""A gripper and the cable next to it, one of which turns so many times as far as the other, are in different units."""
RADIANS = 'expected radians. Multiply it by pi / 180 (in a layout: `angle_unit = "deg"`).'
"""What to do with an angle in degrees."""


def out_of_reach(
    keypoints: Float[np.ndarray, "*T N D"], grippers: Float[np.ndarray, "*T Q D"], length: float
) -> Bool[np.ndarray, "*T N"]:
    """Which keypoints are farther from both grippers than `REACH`.

    Args:
        keypoints: [m], NaN = not observed.
        grippers: positions [m], NaN = not known.
        length: of the cable [m].
    """
    return _distance(keypoints, grippers) > REACH * length + 1.0


def ends_exchanged(
    keypoints: Float[np.ndarray, "*T N D"], grippers: Float[np.ndarray, "*T Q D"], length: float
) -> Bool[np.ndarray, "*T"]:
    """Whether each end of the cable is seen at the other end's gripper: the tracker, or the arms, changed their order.

    Args:
        keypoints: [m], NaN = not observed.
        grippers: positions [m], NaN = not known.
        length: of the cable [m].
    """
    ends = np.asarray(keypoints)[..., [0, -1], :]
    own, other = (np.linalg.norm(ends - at, axis=-1).max(axis=-1) for at in (grippers, grippers[..., ::-1, :]))
    return (own > AT_GRIPPER * length) & (other < AT_GRIPPER * length)


def _distance(
    keypoints: Float[np.ndarray, "*T N D"], grippers: Float[np.ndarray, "*T Q D"]
) -> Float[np.ndarray, "*T N"]:
    """Of each keypoint from the nearer gripper [m]; 0 where either was not observed."""
    offset = np.asarray(keypoints, float)[..., :, None, :] - np.asarray(grippers, float)[..., None, :, :]
    return np.nan_to_num(np.linalg.norm(offset, axis=-1).min(axis=-1), nan=0.0)


def gripper_motion(pose: Float[np.ndarray, "T Q P"], dimension: int) -> float:
    """How far a gripper moves [m], the one that moves farthest: the diagonal of its places; 0 where none is known."""
    place = pose[..., :dimension]
    known = place[np.isfinite(place).all(axis=(1, 2))]
    return float(np.linalg.norm(np.ptp(known, axis=0), axis=-1).max()) if len(known) else 0.0


def geometry_fault(log: GapLog) -> str | None:
    """Finds impossible keypoints or gripper angles in a log; a message with advice, or None.

    Args:
        log: follows the format otherwise. Angles are checked in the plane, between two grippers, with at least five
            keypoints.
    """
    length, dimension = float(log.meta["cable"]["length_m"]), log.keypoints.shape[-1]
    for episode, samples in enumerate(log.episode_length):
        points, pose = log.keypoints[episode, :samples], log.gripper_pose[episode, :samples]
        moved = gripper_motion(pose, dimension)
        if moved > MOVED * length and np.isfinite(points).any() and np.array_equal(points[1:], points[:-1], True):
            return (
                f"Field 'keypoints' is the same to the last digit in all {samples} samples of episode {episode}, but a "
                f"gripper moves by {moved:.3g} m: expected measured keypoints, and NaN where one was not observed."
            )
        grippers = pose[..., :dimension]
        if out_of_reach(points, grippers, length).any():
            distance = _distance(points, grippers)
            sample, index = np.unravel_index(int(distance.argmax()), distance.shape)
            return (
                f"Field 'keypoints' has keypoint {index} of episode {episode} {distance.max():.3g} m away from both "
                f"grippers at {log.time[episode, sample]:.3g} s, but the cable is {length:g} m long: expected metres, "
                "and NaN where a keypoint was not observed."
            )
    if dimension != 2 or log.gripper_pose.shape[2] != 2 or log.keypoints.shape[2] < _FEWEST:
        return None
    for gripper in (0, 1):
        if fault := _angle_fault(*tangents(log, gripper)):
            return f"Field 'gripper_pose' has the angle of gripper {gripper} {fault}"
    return None


def median_angle(difference: Float[np.ndarray, " S"]) -> float:
    """Median magnitude of angles that are known up to whole turns [rad]."""
    return float(np.median(np.arccos(np.cos(difference))))


def tangents(log: GapLog, gripper: int) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, " S"]]:
    """A gripper's angle, and the direction of the cable next to it [rad], in all samples that show it."""
    ends = log.keypoints[log.valid][:, :2] if gripper == 0 else log.keypoints[log.valid][:, -2:]
    along = np.diff(ends.astype(float), axis=1)[:, 0]
    angle, direction = log.gripper_pose[log.valid][:, gripper, 2].astype(float), np.arctan2(along[:, 1], along[:, 0])
    seen = np.isfinite(direction)
    return angle[seen], direction[seen]


def _angle_fault(angle: Float[np.ndarray, " S"], direction: Float[np.ndarray, " S"]) -> str | None:
    if not len(angle):
        return None
    off, in_degrees = median_angle(angle - direction), median_angle(np.radians(angle) - direction)
    turns_too_far = np.ptp(angle) > max(np.pi, TURN * np.ptp(np.unwrap(direction)))
    if turns_too_far and off > max(OFF, BETTER * in_degrees):
        return (
            f"up to {np.abs(angle).max():.3g}, which fits the cable next to it in degrees (median difference "
            f"{in_degrees:.2g} rad) and not in radians ({off:.2g} rad): {RADIANS}"
        )
    mirrored = median_angle(angle + direction)
    if off > INWARDS and mirrored < OFF:
        return (
            f"{np.degrees(off):.0f} degrees off the cable next to it (median), and {np.degrees(mirrored):.0f} with the "
            "other sign: either y or the angle is mirrored. Negate the angle if it counts clockwise."
        )
    if off > INWARDS:
        return (
            f"{np.degrees(off):.0f} degrees off the cable next to it (median): expected the cable's tangent, from "
            "gripper 0 towards gripper 1, at both grippers. Add pi if it points the other way."
        )
    return None
