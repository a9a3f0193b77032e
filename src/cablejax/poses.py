"""Gripper poses: from the two markers on each gripper, at other times, without misreadings, and their twists.

Two markers show a position and a tangent; the rotation about the tangent, the roll, is not observed. In space the
quaternion of the first sample is the smallest rotation that takes the x axis to the tangent, and from then on the frame
is carried along by parallel transport: from each sample to the next by the smallest rotation that takes one tangent to
the other. So it is continuous, and turns about the tangent only as much as the path of the tangent makes it. It says
nothing of how the cable was twisted by the gripper: a model has to fit the roll, or to leave the twist out.
"""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import ArrayLike, Float

from cablejax.arrays import positions_at, quaternion_product, real, wrapped

_X = np.array([1.0, 0.0, 0.0])

_JUMPS = ("m", 0.02, 50.0), ("rad", 0.3, 100.0)
"""Least step [m, rad] and acceleration [m/s^2, rad/s^2] of a reading that jumps: no arm moves like that."""
_UNUSUAL = 8.0
"""A jump is so many times the usual step besides: all poses may be noisy."""
_AWAY, _BACK = 5, 0.25
"""A misreading is back after so many samples at most, within this part of the jump."""


def planar_rows(value: Float[ArrayLike, "2 3"], name: str) -> Float[np.ndarray, "2 3"]:
    """Poses or twists of two grippers in the plane, in double precision, as a new array.

    Raises:
        ValueError: another shape, or not finite real numbers; calls them `name`.
    """
    array = real(value, f"{name} has")
    if array.shape != (2, 3):
        raise ValueError(f"{name} has shape {array.shape}, expected (2, 3): one planar row for each of two grippers.")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} is not finite: {array.tolist()}. Check what produced it.")
    return array


def poses_from_markers(
    first: Float[np.ndarray, "T D"], second: Float[np.ndarray, "T D"], at: Float[np.ndarray, "T D"]
) -> Float[np.ndarray, "T P"]:
    """Poses of one gripper (x, y, theta) or (x, y, z, qw, qx, qy, qz), shape [T, 3] or [T, 7].

    Args:
        first: marker at the smaller arc length [m].
        second: marker at the larger one [m]: the tangent points from the first to it.
        at: position of the gripper [m].

    Raises:
        ValueError: the two markers are in one place.
    """
    along = second - first
    length = np.linalg.norm(along, axis=-1, keepdims=True)
    if (length < 1e-6).any():
        sample = int(np.argmin(length))
        raise ValueError(
            f"The two markers of a gripper are in one place in sample {sample}, so they show no tangent: choose two "
            "markers some millimetres apart."
        )
    tangent = along / length
    if tangent.shape[1] == 2:
        angle = unwrapped(np.arctan2(tangent[:, 1], tangent[:, 0]))
        return np.concatenate([at, angle[:, None]], axis=1)
    return np.concatenate([at, transported_frames(tangent)], axis=1)


def transported_frames(tangent: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 4"]:
    """Unit quaternions (scalar first) of frames with the tangent as x axis, by parallel transport, [T, 4].

    Where a tangent is NaN its frame is, and the next one is transported from the last that is known.
    """
    frames = np.full((len(tangent), 4), np.nan)
    known = np.isfinite(tangent).all(axis=-1)
    ahead = tangent[known]
    turns = smallest_rotation(np.concatenate([[_X], ahead])[:-1], ahead)
    quaternion = np.empty(turns.shape)
    for t, turn in enumerate(turns):
        quaternion[t] = turn if t == 0 else quaternion_product(turn, quaternion[t - 1])
    frames[known] = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return frames


def smallest_rotation(start: Float[np.ndarray, "*B 3"], end: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 4"]:
    """Quaternion of the smallest rotation from one unit vector to another; half a turn about z if x goes to -x."""
    cosine = (start * end).sum(axis=-1, keepdims=True)
    quaternion = np.concatenate([1 + cosine, np.cross(start, end)], axis=-1)
    norm = np.linalg.norm(quaternion, axis=-1, keepdims=True)
    opposite = norm < 1e-7
    sideways = np.cross(start, np.where(abs(start[..., 1:2]) < 0.9, [0.0, 1.0, 0.0], _X))
    sideways = sideways / np.linalg.norm(sideways, axis=-1, keepdims=True)
    half_turn = np.concatenate([np.zeros_like(cosine), sideways], axis=-1)
    return np.where(opposite, half_turn, quaternion / np.where(opposite, 1.0, norm))


def rotated(quaternion: Float[np.ndarray, "*B 4"], vector: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 3"]:
    """The vector turned by a unit quaternion."""
    axis = quaternion[..., 1:]
    twice = 2 * np.cross(axis, vector)
    return vector + quaternion[..., :1] * twice + np.cross(axis, twice)


def unwrapped(angle: Float[np.ndarray, "T *Q"]) -> Float[np.ndarray, "T *Q"]:
    """Angles [rad] without whole turns from each that is known to the next one; NaN stays NaN."""
    columns = angle.astype(float).reshape(len(angle), -1)
    for column in columns.T:
        known = np.isfinite(column)
        column[known] = np.unwrap(column[known])
    return columns.reshape(angle.shape)


def with_one_sign(pose: Float[np.ndarray, "T *Q 7"]) -> Float[np.ndarray, "T *Q 7"]:
    """Poses in space, each quaternion with the sign that is nearer to the one before: both are one rotation."""
    pose = pose.astype(float)
    opposite = (pose[1:, ..., 3:] * pose[:-1, ..., 3:]).sum(axis=-1, keepdims=True) < 0
    pose[1:, ..., 3:] *= np.cumprod(np.where(opposite, -1.0, 1.0), axis=0)
    return pose


def poses_at(
    at: Float[np.ndarray, " G"], time: Float[np.ndarray, " T"], pose: Float[np.ndarray, "T *Q P"]
) -> Float[np.ndarray, "G *Q P"]:
    """Poses at other times, shape [G, *Q, P]: a straight line, and the shorter way between angles or quaternions.

    The first and the last pose are held; next to a pose that is NaN the result is NaN. Whole turns of an angle are
    those of the pose before.

    Args:
        at: those times [s].
        time: when the poses were, ascending [s].
        pose: (x, y, theta) or (x, y, z, qw, qx, qy, qz) [m, rad, 1].
    """
    if pose.shape[-1] == 3:
        turned = unwrapped(pose[..., 2])
        found = positions_at(at, time, np.concatenate([pose[..., :2], turned[..., None]], axis=-1))
        before = np.clip(np.searchsorted(time, at, side="right") - 1, 0, None)
        found[..., 2] += (pose[..., 2] - turned)[before]
        return found
    found = positions_at(at, time, with_one_sign(pose))
    found[..., 3:] /= np.linalg.norm(found[..., 3:], axis=-1, keepdims=True)
    return found


def without_misreadings(
    time: Float[np.ndarray, " T"], pose: Float[np.ndarray, "T Q P"]
) -> tuple[Float[np.ndarray, "T Q P"], dict[int, str]]:
    """Poses in which readings that jump away and back are interpolated from their neighbours.

    A tracker that takes one axis for another does that, or an angle that was read half a turn off. A simulated cable
    would be wrung by it, and what it does then says nothing of the real one.

    Args:
        time: of the samples, increasing [s].
        pose: (x, y, theta) or (x, y, z, qw, qx, qy, qz) [m, rad, 1], NaN = not known.

    Returns:
        The poses, and how often and how far the grippers that had such readings jumped, in words.
    """
    result, words = pose.copy(), {}
    for gripper, own in enumerate(pose.swapaxes(0, 1)):
        wrong, farthest = np.zeros(len(time), bool), []
        for (unit, least, acceleration), apart in zip(_JUMPS, (_distance, _turn), strict=True):
            step = apart(own[1:], own[:-1])
            usual = float(np.nanmedian(step)) if np.isfinite(step).any() else 0.0
            # there and back: the velocity changes by twice its size
            impossible = acceleration * np.diff(time) ** 2 / 2
            jumps = np.flatnonzero(step > np.maximum(max(least, _UNUSUAL * usual), impossible))
            after = 0
            for first, last in itertools.pairwise(jumps):
                back = apart(own[last + 1], own[first])
                if first >= after and last - first <= _AWAY and back < _BACK * min(step[first], step[last]):
                    wrong[first + 1 : last + 1], after = True, last + 1
                    farthest.append((step[first], f"{step[first]:.2g} {unit} at {time[first + 1]:.4g} s"))
        if farthest:
            result[wrong, gripper] = poses_at(time[wrong], time[~wrong], own[~wrong])
            words[gripper] = (
                f"jumps away and back in {int(wrong.sum())} of {len(time)} samples, for example by {max(farthest)[1]}: "
                "taken to be on a straight line."
            )
    return result, words


def _distance(pose: Float[np.ndarray, "*B P"], other: Float[np.ndarray, "*B P"]) -> Float[np.ndarray, "*B"]:
    """Between the places of two poses [m]."""
    axes = 2 if pose.shape[-1] == 3 else 3
    return np.linalg.norm((pose - other)[..., :axes], axis=-1)


def _turn(pose: Float[np.ndarray, "*B P"], other: Float[np.ndarray, "*B P"]) -> Float[np.ndarray, "*B"]:
    """Smallest angle from one pose to another [rad]."""
    if pose.shape[-1] == 3:
        return np.abs(wrapped((pose - other)[..., 2]))
    return 2 * np.arccos(np.clip(np.abs((pose * other)[..., 3:].sum(axis=-1)), 0.0, 1.0))


def twists(time: Float[np.ndarray, " T"], pose: Float[np.ndarray, "T Q P"]) -> Float[np.ndarray, "T Q V"]:
    """The twist that carries each pose to the next one, by finite differences; zero after the last sample.

    Linear [m/s] and angular [rad/s], both in the world's frame, shape [T, Q, 3 or 6].
    """
    interval = np.diff(time)[:, None, None]
    if pose.shape[-1] == 3:
        change = np.diff(pose, axis=0)
        change[..., 2] = wrapped(change[..., 2])
    else:
        start = pose[:-1, :, 3:] * np.array([1.0, -1.0, -1.0, -1.0])
        turn = quaternion_product(pose[1:, :, 3:], start)
        turn = turn * np.where(turn[..., :1] < 0, -1.0, 1.0)
        sine = np.linalg.norm(turn[..., 1:], axis=-1, keepdims=True)
        angle = 2 * np.arctan2(sine, turn[..., :1])
        vector = turn[..., 1:] * np.where(sine > 1e-12, angle / np.where(sine > 1e-12, sine, 1.0), 2.0)
        change = np.concatenate([np.diff(pose[..., :3], axis=0), vector], axis=-1)
    return np.concatenate([change / interval, np.zeros((1, *change.shape[1:]))])
