"""Finds set-ups of a recording that no diagnosis should explain: wrong units, signs, axes, ends, or gravity."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from cablejax.cable import GRAVITY
from cablejax.cable_length import BENT, ring_chords
from cablejax.log_geometry import (
    AT_GRIPPER,
    BETTER,
    INWARDS,
    OFF,
    RADIANS,
    TURN,
    ends_exchanged,
    median_angle,
    tangents,
)
from cablejax.poses import rotated
from cablejax.types import GapLog

BESIDE = 0.02
"""Largest median distance of an end's keypoint from the x axis of its gripper in space [m]."""
ASKEW = np.radians(60.0)
"""Median angle between a gripper's tangent and the cable next to it that no clamp has."""
LARGEST_TILT = np.radians(50)
"""Largest angle between the stated vertical and the direction in which the cable hangs."""
QUATERNIONS = {
    "the quaternions have their scalar last": lambda quaternion: np.roll(quaternion, 1, axis=-1),
    "the quaternions are inverted": lambda quaternion: quaternion * np.array([1.0, -1.0, -1.0, -1.0]),
}
"""Other conventions of a quaternion, and how one is read from it."""
_NEAR = 1 / 8
"""Distance between an end's two keypoints, in lengths of the cable, up to which they show its direction there."""
# A cable that turns so far [rad], so much with its gripper, shows its angle's unit.
_TURNED, _WITH_IT = 0.35, 0.95
# In a gripper that does not turn the cable's end turns so far [rad] only where it is not held: a grip yields by less.
_DEAD = 0.7
# A cable of so many lengths over which it bends under its own weight does not stand up in an arch.
_HANGS = 6.0


def cable_fault(log: GapLog) -> str | None:
    """Finds a set-up that is not simulated, or that another unit, sign or axis explains far better; a message, or None.

    A grasp other than a clamp; a rest curvature in space, which has no direction there; keypoints that are not at the
    grippers, or as far apart as no cable of this length; a gripper's angle that is dead, in another unit or of the
    other sign; quaternions whose x axis is not along the cable; gravity that points away from where the cable hangs.

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
    if log.in_space and (curved := log.meta["cable"].get("rest_curvature_per_m", 0.0)):
        return (
            f"Field 'meta.cable.rest_curvature_per_m' is {curved:g}, which says in no direction of space: state 0. The "
            "diagnosis finds the curvature by the effect intrinsic_curvature (--only)."
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
    return _axis_fault(log) or _hanging_fault(log) if log.in_space else _reading_fault(log)


def setup_fault(log: GapLog) -> str | None:
    """As `cable_fault`, and on a table finds grippers askew, which a simulated clamp may be as much as its effect says.

    For measured poses.
    """
    if fault := cable_fault(log):
        return fault
    for gripper, angle, direction in () if log.in_space else _ends_seen(log):
        off = median_angle(angle - direction)
        if off > ASKEW:
            return (
                f"{_so_far_off(gripper, off)}: expected the cable's tangent, from gripper 0 towards gripper 1, at both."
            )
    return None


def sags_from(keypoints: Float[np.ndarray, "S N 3"]) -> Float[np.ndarray, "3"] | None:
    """The direction from the middle of a cable to the middle of its ends, which is up where it hangs.

    Args:
        keypoints: [m], NaN = not observed.

    Returns:
        A unit vector; None of a cable that is stretched or swirled around, which does not say where up is.
    """
    above = keypoints[:, [0, -1]].mean(axis=1) - keypoints.mean(axis=1)
    above = above[np.isfinite(above).all(axis=1)]
    if not len(above):
        return None
    mean = above.mean(axis=0)
    size = float(np.linalg.norm(mean))
    return None if size < 0.3 * np.sqrt((above**2).sum(axis=1).mean()) or size == 0 else mean / size


def _ends_seen(log: GapLog) -> Iterator[tuple[int, Float[np.ndarray, " S"], Float[np.ndarray, " S"]]]:
    """Each gripper on a table whose next keypoint is near enough to show its tangent, as `tangents` has it."""
    stated = np.diff(log.meta["keypoint_arclength_m"])
    for gripper in (0, 1) if log.gripper_pose.shape[2] == 2 else ():
        angle, direction = tangents(log, gripper)
        if len(angle) and stated[-gripper] <= _NEAR * stated.sum() * (1 + 1e-6):
            yield gripper, angle, direction


def _so_far_off(gripper: int, off: float) -> str:
    return f"The angle of gripper {gripper} is {np.degrees(off):.0f} degrees off the cable next to it (median)"


def _reading_fault(log: GapLog) -> str | None:
    """Finds angles on a table that are dead, or that fit the cable far better in another unit or direction."""
    # one of two arms may well not turn
    dead = not np.ptp(log.gripper_pose[log.valid][..., 2], axis=0).any()
    for gripper, angle, direction in _ends_seen(log):
        if dead and (turned := _turned(log, gripper)) > _DEAD:
            return (
                f"The angle of gripper {gripper} is {angle[0]:.4g} rad in all samples, but the cable at it turns by "
                f"{np.degrees(turned):.0f} degrees: was the angle recorded? Expected the cable's tangent."
            )
        own, in_degrees = angle - direction, np.degrees(angle) - direction
        # a clamp that is askew, by as much as its effect says, follows the cable's direction better as it is
        follows = _scatter(own) + 1e-6
        if _scatter(in_degrees) <= follows and (times := _turns_less(angle, direction)) > TURN:
            return (
                f"The cable next to gripper {gripper} turns {times:.0f} times as far as the gripper's angle, and with "
                "it: the angle is in units of 180 / pi rad, since it was converted from degrees although it was in "
                "radians."
            )
        others = {
            f"in degrees: {RADIANS}": np.radians(angle) - direction,
            "in units of 180 / pi rad: it was converted from degrees although it was in radians.": in_degrees,
            "with the other sign: either y or the angle is mirrored. Negate the angle.": -angle - direction,
            "a quarter turn further: expected the cable's tangent.": own + np.pi / 2,
            "a quarter turn back: expected the cable's tangent.": own - np.pi / 2,
        }
        fitting = ((median_angle(one), words) for words, one in others.items() if _scatter(one) <= follows)
        better, advice = min(fitting, default=(np.inf, ""))
        off = median_angle(own)
        if off > OFF and better < off / BETTER:
            return f"{_so_far_off(gripper, off)}, and {np.degrees(better):.0f} {advice}"
    return None


def _turned(log: GapLog, gripper: int) -> float:
    """By how much the tangent at a gripper surely turns [rad], continued from the two chords next to it.

    Less what the chords turn against each other, by noise or where the cable bends within them.
    """
    ends = log.keypoints[log.valid].astype(float)
    ends = ends[:, :3] if gripper == 0 else ends[:, :-4:-1]
    if ends.shape[1] < 3:
        return 0.0
    stated = np.diff(log.meta["keypoint_arclength_m"])
    near, next_ = stated[:2] if gripper == 0 else stated[:-3:-1]
    along = np.diff(ends, axis=1)
    first, second = np.moveaxis(np.arctan2(along[..., 1], along[..., 0]), -1, 0)
    bend = np.arctan2(np.sin(second - first), np.cos(second - first))
    seen = np.isfinite(bend)
    if not seen.any():
        return 0.0
    tangent = np.unwrap((first - bend * near / (near + next_))[seen])
    turned, against = (float(np.subtract(*np.percentile(part, [95, 5]))) for part in (tangent, bend[seen]))
    return turned - against


def _turns_less(angle: Float[np.ndarray, " S"], direction: Float[np.ndarray, " S"]) -> float:
    """How many times as far as the gripper the cable next to it turns; 0 where one does not follow the other."""
    turns = np.unwrap(direction)
    if np.ptp(turns) < _TURNED or not np.ptp(angle) > 0 or np.corrcoef(angle, turns)[0, 1] < _WITH_IT:
        return 0.0
    return float(np.std(turns) / np.std(angle))


def _scatter(difference: Float[np.ndarray, " S"]) -> float:
    """Standard deviation of angles that are known up to whole turns [rad] (Mardia and Jupp 2000, chapter 2)."""
    return float(np.sqrt(-2 * np.log(np.clip(np.abs(np.exp(1j * difference).mean()), 1e-12, 1.0))))


def misread_quaternions(points: Float[np.ndarray, "S N 3"], quaternion: Float[np.ndarray, "S 2 4"]) -> str | None:
    """Finds quaternions whose x axes fit the cable far better read in another convention; a message, or None.

    The cable's bend up to the next keypoint hides all but a gross mistake.

    Args:
        points: keypoints [m], NaN = not observed.
        quaternion: of both grippers, scalar first.
    """
    stated = _off_axis(points, quaternion)
    for name, change in QUATERNIONS.items():
        better = _off_axis(points, change(quaternion))
        # an axis that points the other way along the cable is as far from it as the reversed one is near
        if (stated > ASKEW).all() and (better < np.minimum(stated / BETTER, np.pi - stated)).all():
            one, other = np.degrees(stated)
            return (
                f"The x axes of grippers 0 and 1 are {one:.0f} and {other:.0f} degrees off the cable next to them "
                f"(median), and {' and '.join(f'{off:.0f}' for off in np.degrees(better))} if {name}: expected "
                "qw, qx, qy, qz of a gripper whose x axis is along the cable. Correct the order of their numbers."
            )
    return None


def _off_axis(points: Float[np.ndarray, "S N 3"], quaternion: Float[np.ndarray, "S 2 4"]) -> Float[np.ndarray, "2"]:
    """Median angle between each gripper's x axis and the cable next to it [rad]; 0 where that is not observed."""
    off = np.zeros(2)
    for gripper, (begin, end) in enumerate(((0, 1), (-2, -1))):
        axis, along = rotated(quaternion[:, gripper], np.array([1.0, 0.0, 0.0])), points[:, end] - points[:, begin]
        with np.errstate(invalid="ignore"):
            cosine = (along * axis).sum(axis=-1) / np.linalg.norm(along, axis=-1)
        if np.isfinite(cosine).any():
            off[gripper] = np.nanmedian(np.arccos(np.clip(cosine, -1, 1)))
    return off


def _axis_fault(log: GapLog) -> str | None:
    """Finds grippers in space whose x axis does not leave along the cable."""
    points, pose = log.keypoints[log.valid].astype(float), log.gripper_pose[log.valid].astype(float)
    if fault := misread_quaternions(points, pose[..., 3:]):
        return fault
    for gripper, off in enumerate(_off_axis(points, pose[..., 3:])):
        end, name = ((0, "0"), (-1, "N - 1"))[gripper]
        if off > INWARDS:
            return (
                f"The x axis of gripper {gripper} is {np.degrees(off):.0f} degrees off the cable next to it (median): "
                "expected it along the cable, from gripper 0 towards gripper 1, at both."
            )
        axis = rotated(pose[:, gripper, 3:], np.array([1.0, 0.0, 0.0]))
        offset = points[:, end] - pose[:, gripper, :3]
        beside = np.linalg.norm(offset - (offset * axis).sum(axis=-1, keepdims=True) * axis, axis=-1)
        if np.isfinite(beside).any() and (away := float(np.nanmedian(beside))) > BESIDE:
            return (
                f"Keypoint {name} is {1e3 * away:.0f} mm beside the x axis of gripper {gripper} (median): expected the "
                "pose's origin at that keypoint and its x axis along the cable. Shift the pose to where the cable is "
                "held."
            )
    return None


def _hanging_fault(log: GapLog) -> str | None:
    """Finds gravity that points away from where a cable in space hangs; a stiff one may stand up in an arch."""
    cable, gravity = log.meta["cable"], np.asarray(log.meta["gravity_m_per_s2"], float)
    bends = (cable["bending_stiffness_n_m2"] / cable["linear_density_kg_per_m"] / GRAVITY) ** (1 / 3)
    up = sags_from(log.keypoints[log.valid].astype(float)) if cable["length_m"] > _HANGS * bends else None
    if up is None:
        return None
    tilt = float(np.arccos(np.clip(-up @ gravity / np.linalg.norm(gravity), -1, 1)))
    if tilt <= LARGEST_TILT:
        return None
    return (
        f"Field 'meta.gravity_m_per_s2' is {gravity.tolist()}, but the cable sags along "
        f"({', '.join(f'{-one:.2f}' for one in up)}), {np.degrees(tilt):.0f} degrees off it: correct gravity's sign "
        "and axis, or the order of the coordinates."
    )
