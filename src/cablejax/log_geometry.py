"""Finds keypoints and gripper angles that no cable between these grippers can have."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from cablejax.cable_length import BENT, ring_chords
from cablejax.poses import rotated
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
BESIDE = 0.02
"""Largest median distance of an end's keypoint from the x axis of its gripper in space [m]."""
ASKEW = np.radians(60.0)
"""Median angle between a gripper's tangent and the cable next to it that no clamp has."""
_FEWEST = 5
_NEAR = 1 / 8
"""Distance between an end's two keypoints, in lengths of the cable, up to which they show its direction there."""
_DEGREES_OFF = 0.5
_DEGREES_BETTER = 3.0
_DEGREES_TURN = 10.0
# A cable that turns so far [rad], so much with its gripper, shows its angle's unit.
_TURNED, _WITH_IT = 0.35, 0.95
_RADIANS = 'expected radians. Multiply it by pi / 180 (in a layout: `angle_unit = "deg"`).'


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
        if fault := _angle_fault(*_tangents(log, gripper)):
            return f"Field 'gripper_pose' has the angle of gripper {gripper} {fault}"
    return None


def cable_fault(log: GapLog) -> str | None:
    """Finds a grasp that is not simulated, and keypoints that no cable of this length has; a message, or None.

    Args:
        log: valid; between two grippers, else nothing is checked.
    """
    dimension = log.keypoints.shape[-1]
    if log.gripper_pose.shape[2] != 2:
        return None
    if any(hold != "clamped" for hold in log.meta["grasp"]):
        return (
            f'Field \'meta.grasp\' is {log.meta["grasp"]}, expected ["clamped", "clamped"], the only grasp simulated. '
            "State this for grippers that yield too, which a diagnosis on a table finds (`gripper_compliance`)."
        )
    points, pose = log.keypoints[log.valid].astype(float), log.gripper_pose[log.valid].astype(float)
    grippers = pose[..., :dimension]
    length = float(log.meta["cable"]["length_m"])
    near = AT_GRIPPER * length
    for gripper, (end, name) in enumerate(((0, "0"), (-1, "N - 1"))):
        seen = np.isfinite(points[:, end]).all(axis=-1)
        if not seen.any():
            continue
        distances = np.median(np.linalg.norm(points[seen, None, end] - grippers[seen], axis=-1), axis=0)
        away, crossed = float(distances[gripper]), float(distances[1 - gripper])
        if away > near:
            advice = (
                f"it is at gripper {1 - gripper}. Exchange the grippers, or reverse the order of the keypoints."
                if crossed < near
                else "are the keypoints and the poses in one frame, in metres, and of the same cable?"
            )
            return f"Keypoint {name} is {away:.2f} m from gripper {gripper}, expected it at the gripper: {advice}"
    for episode, n in enumerate(log.episode_length):
        seen = np.isfinite(log.keypoints[episode, :n, [0, -1]]).all(axis=(0, 2))
        places = log.gripper_pose[episode, :n, :, :dimension]
        if seen.any() and ends_exchanged(log.keypoints[episode, :n], places, length)[seen].mean() > 0.5:
            return (
                f"In episode {episode}, unlike in others, keypoint 0 is at gripper 1 and keypoint N - 1 at gripper 0: "
                "reverse the order of its keypoints, or exchange its grippers."
            )
    # chords are shorter than the cable between them, the more so the fewer there are
    stated = np.diff(log.meta["keypoint_arclength_m"])
    chord = np.linalg.norm(np.diff(points, axis=1), axis=-1) / stated
    ratio = float(np.nanmedian(chord)) if np.isfinite(chord).any() else 1.0
    if not (ring_chords(stated) / stated).min() - BENT <= ratio <= 1 + BENT:
        return (
            f"The keypoints lie {ratio:.2f} times as far apart as meta.keypoint_arclength_m states: correct the "
            "length, the unit, or the arc lengths."
        )
    return None


def setup_fault(log: GapLog) -> str | None:
    """As `cable_fault`, and finds angles of grippers that fit the cable far better in another unit or direction.

    For measured poses: a simulated clamp may hold the cable as askew as its effect says.
    """
    if fault := cable_fault(log):
        return fault
    if log.gripper_pose.shape[2] != 2:
        return None
    if log.in_space:
        return _axis_fault(log)
    stated = np.diff(log.meta["keypoint_arclength_m"])
    for gripper in (0, 1):
        angle, direction = _tangents(log, gripper)
        if not len(angle) or stated[-gripper] > _NEAR * stated.sum() * (1 + 1e-6):
            continue
        if (times := _turns_less(angle, direction)) > _DEGREES_TURN:
            return (
                f"The cable next to gripper {gripper} turns {times:.0f} times as far as the gripper's angle, and with "
                "it: the angle is in units of 180 / pi rad, since it was converted from degrees although it was in "
                "radians."
            )
        off = _median_angle(angle - direction)
        others = {
            f"in degrees: {_RADIANS}": np.radians(angle) - direction,
            "in units of 180 / pi rad: it was converted from degrees although it was in radians.": np.degrees(angle)
            - direction,
            "with the other sign: either y or the angle is mirrored. Negate the angle.": -angle - direction,
            "a quarter turn further: expected the cable's tangent.": angle + np.pi / 2 - direction,
            "a quarter turn back: expected the cable's tangent.": angle - np.pi / 2 - direction,
        }
        best, better = min((_median_angle(change), advice) for advice, change in others.items())
        begin = f"The angle of gripper {gripper} is {np.degrees(off):.0f} degrees off the cable next"
        if off > _DEGREES_OFF and best < off / _DEGREES_BETTER:
            return f"{begin} to it (median), and {np.degrees(best):.0f} {better}"
        if off > ASKEW:
            return f"{begin} to it (median): expected the cable's tangent, from gripper 0 towards gripper 1, at both."
    return None


def _turns_less(angle: Float[np.ndarray, " S"], direction: Float[np.ndarray, " S"]) -> float:
    """How many times as far as the gripper the cable next to it turns; 0 where one does not follow the other."""
    turns = np.unwrap(direction)
    if np.ptp(turns) < _TURNED or not np.ptp(angle) > 0 or np.corrcoef(angle, turns)[0, 1] < _WITH_IT:
        return 0.0
    return float(np.std(turns) / np.std(angle))


def _axis_fault(log: GapLog) -> str | None:
    """Finds grippers in space whose x axis does not leave along the cable."""
    points, pose = log.keypoints[log.valid].astype(float), log.gripper_pose[log.valid].astype(float)
    for gripper, (end, inner, name) in enumerate(((0, 1, "0"), (-1, -2, "N - 1"))):
        axis = rotated(pose[:, gripper, 3:], np.array([1.0, 0.0, 0.0]))
        along = (1, -1)[gripper] * (points[:, inner] - points[:, end])
        with np.errstate(invalid="ignore"):
            cosine = (along * axis).sum(axis=-1) / np.linalg.norm(along, axis=-1)
        off = float(np.nanmedian(np.arccos(np.clip(cosine, -1, 1)))) if np.isfinite(cosine).any() else 0.0
        if off > INWARDS:
            return (
                f"The x axis of gripper {gripper} is {np.degrees(off):.0f} degrees off the cable next to it (median): "
                "expected it along the cable, from gripper 0 towards gripper 1, at both."
            )
        offset = points[:, end] - pose[:, gripper, :3]
        beside = np.linalg.norm(offset - (offset * axis).sum(axis=-1, keepdims=True) * axis, axis=-1)
        if np.isfinite(beside).any() and (away := float(np.nanmedian(beside))) > BESIDE:
            return (
                f"Keypoint {name} is {1e3 * away:.0f} mm beside the x axis of gripper {gripper} (median): expected the "
                "pose's origin at that keypoint and its x axis along the cable. Shift the pose to where the cable is "
                "held."
            )
    return None


def _median_angle(difference: Float[np.ndarray, " S"]) -> float:
    """Median magnitude of angles that are known up to whole turns [rad]."""
    return float(np.median(np.arccos(np.cos(difference))))


def _tangents(log: GapLog, gripper: int) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, " S"]]:
    """A gripper's angle, and the direction of the cable next to it [rad], in all samples that show it."""
    ends = log.keypoints[log.valid][:, :2] if gripper == 0 else log.keypoints[log.valid][:, -2:]
    along = np.diff(ends.astype(float), axis=1)[:, 0]
    angle, direction = log.gripper_pose[log.valid][:, gripper, 2].astype(float), np.arctan2(along[:, 1], along[:, 0])
    seen = np.isfinite(direction)
    return angle[seen], direction[seen]


def _angle_fault(angle: Float[np.ndarray, " S"], direction: Float[np.ndarray, " S"]) -> str | None:
    if not len(angle):
        return None
    off, in_degrees = _median_angle(angle - direction), _median_angle(np.radians(angle) - direction)
    turns_too_far = np.ptp(angle) > max(np.pi, _DEGREES_TURN * np.ptp(np.unwrap(direction)))
    if turns_too_far and off > max(_DEGREES_OFF, _DEGREES_BETTER * in_degrees):
        return (
            f"up to {np.abs(angle).max():.3g}, which fits the cable next to it in degrees (median difference "
            f"{in_degrees:.2g} rad) and not in radians ({off:.2g} rad): {_RADIANS}"
        )
    mirrored = _median_angle(angle + direction)
    if off > INWARDS and mirrored < _DEGREES_OFF:
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
