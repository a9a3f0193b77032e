"""How grippers in space hold the cable: the grasped keypoints, the clamps' positions and their frames."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from cablejax.diagnose.log_faults import steadied
from cablejax.poses import positions_at, rotated
from cablejax.simulate.rod.clamps import frames_along
from cablejax.types import GapLog

# A keypoint whose place in the gripper's frame stays within the first [m] may be held by it. It is, unless it moves
# across with the next one, by the second part or more of what bending does: so near to a gripper free ones hardly move.
_HELD, _BENT = 0.003, 0.5
# Axes of the grippers that scatter by less than this from one sample to the next stay as they were measured.
_STEADY = np.full(3, 5e-3)


def rolls_observed(log: GapLog) -> bool:
    """Whether the log says that its quaternions show how the grippers roll about the cable, which markers do not."""
    return log.meta.get("roll_observed") is True


def frames_of(
    log: GapLog, tangent: Float[np.ndarray, "E T 2 3"], valid: Bool[np.ndarray, "E T"]
) -> Float[np.ndarray, "E T 2 3 3"]:
    """Frames of both grippers, rows are axes, smoothed against scatter between samples."""
    tangent = _steady(tangent, log)
    if rolls_observed(log):
        side = _steady(rotated(log.gripper_pose[..., 3:].astype(float), np.array([0.0, 1.0, 0.0])), log)
        side = side - (side * tangent).sum(axis=-1, keepdims=True) * tangent
        side = side / np.maximum(np.linalg.norm(side, axis=-1, keepdims=True), 1e-12)
        return np.stack([tangent, side, np.cross(tangent, side)], axis=-2)
    frames = np.zeros((*tangent.shape[:3], 3, 3))
    for q in range(2):
        frames[valid, q] = frames_along(tangent[valid][:, q])
    return frames


def _steady(axis: Float[np.ndarray, "E T 2 3"], log: GapLog) -> Float[np.ndarray, "E T 2 3"]:
    smooth, turned = steadied(axis, np.zeros_like(axis), log.episode_length, least=_STEADY)
    return smooth / np.linalg.norm(smooth, axis=-1, keepdims=True) if turned.any() else axis


def held_keypoints(
    points: Float[np.ndarray, "E T N 3"],
    position: Float[np.ndarray, "E T 2 3"],
    tangent: Float[np.ndarray, "E T 2 3"],
    valid: Bool[np.ndarray, "E T"],
    s: Float[np.ndarray, "N"],
) -> tuple[int, int]:
    """Numbers of keypoints that move with either gripper; `s` are their arc lengths [m]."""
    count = []
    for q, order in enumerate((range(points.shape[2]), range(points.shape[2] - 1, -1, -1))):
        offset = (points - position[:, :, q, None])[valid][:, order]
        axis = tangent[:, :, q][valid][:, None]
        across = offset - np.sum(offset * axis, axis=-1, keepdims=True) * axis
        distance, n = np.abs(s[list(order)] - s[order[0]]), 0
        while n < len(s) - 1 and np.nanpercentile(np.linalg.norm(across[:, n], axis=-1), 95) <= _HELD:
            both = np.isfinite(across[:, n : n + 2]).all(axis=(1, 2))
            own, following = across[both, n], across[both, n + 1]
            share = np.sum(own * following) / max(np.sum(following**2), 1e-30)
            # as of a cable that leaves the gripper at the keypoint before
            if n and share > _BENT * ((distance[n] - distance[n - 1]) / (distance[n + 1] - distance[n - 1])) ** 2:
                break
            n += 1
        count.append(n)
    return count[0], count[1]


def clamps(
    points: Float[np.ndarray, "E T N 3"],
    position: Float[np.ndarray, "E T 2 3"],
    tangent: Float[np.ndarray, "E T 2 3"],
    s: Float[np.ndarray, "N"],
    held: tuple[int, int],
) -> Float[np.ndarray, "E T 2 3"]:
    """Points at which the cable leaves either gripper [m], shape [E, T, 2, 3]."""
    reach = np.array([s[held[0] - 1] - s[0] if held[0] else 0.0, s[-1] - s[len(s) - held[1]] if held[1] else 0.0])
    # the second gripper's tangent points along the cable too: towards its end
    clamp = position + np.array([1.0, -1.0])[:, None] * reach[:, None] * tangent
    # the innermost held keypoint is where the cable leaves the gripper: it is observed, so it is what moves the clamp
    for q, k in enumerate((held[0] - 1, len(s) - held[1])):
        if held[q]:
            seen = np.asarray(np.isfinite(points[:, :, k]).all(axis=-1))
            off = np.where(seen[..., None], points[:, :, k] - clamp[:, :, q], 0.0)
            unseen = clamp[:, :, q] + _filled(off, seen, tangent[:, :, q])
            clamp[:, :, q] = np.where(seen[..., None], points[:, :, k], unseen)
    return clamp


def _filled(
    off: Float[np.ndarray, "E T 3"], seen: Bool[np.ndarray, "E T"], tangent: Float[np.ndarray, "E T 3"]
) -> Float[np.ndarray, "E T 3"]:
    """What a held keypoint is off its gripper's pose by, also where it is not seen: a clamp must not jump.

    It is interpolated; in an episode that never shows it, it lies along the gripper's axis, as far as usual.
    """
    along = np.sum(off * tangent, axis=-1)[seen]
    filled = (np.median(along) if len(along) else 0.0) * tangent
    for e in np.flatnonzero(seen.any(axis=1)):
        there = np.flatnonzero(seen[e])
        filled[e] = positions_at(np.arange(len(seen[e])), there, off[e, there])
    return filled
