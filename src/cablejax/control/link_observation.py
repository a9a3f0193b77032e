"""What a link makes of a robot's observations: which are usable, and what in them cannot be."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from cablejax.control.link_state import LinkConfig, LinkState, Status
from cablejax.control.run import shape_error_cm
from cablejax.control.targets import Target
from cablejax.limits import LIMITS, require
from cablejax.log_geometry import MOVED, ends_exchanged, out_of_reach
from cablejax.simulate.table_plant import Observation
from cablejax.types import ROTATION_WEIGHT

_KIND = 16
"""Letters by which reasons of one kind agree."""
_RESTS = 50
"""Observations at rest that are kept."""


def take(
    target: Target, config: LinkConfig, state: LinkState, observation: Observation
) -> tuple[LinkState, Observation]:
    """The state with an observation, and the observation as it is logged.

    Raises:
        ValueError, TypeError, OverflowError: it cannot be used at all; the message says why.
    """
    stamp = float(observation.time)
    require(stamp, "stamp", "The time stamp", "Is it in seconds?")
    keypoints, pose = np.array(observation.keypoints, float), np.array(observation.gripper_pose, float)
    shape = target.keypoints.shape
    if keypoints.shape != shape or pose.shape != (2, 3):
        raise ValueError(
            f"An observation has keypoints of shape {keypoints.shape} and poses of shape {pose.shape}, expected "
            f"{shape} as the target and (2, 3)."
        )
    offset = state.now - stamp
    if math.isfinite(state.offset) and state.offset - offset > config.watchdog:
        raise ValueError(f"The time stamp {stamp:.9g} s is {state.offset - offset:.3g} s ahead of the robot's clock.")
    last = state.newest
    largest = LIMITS["coordinate"].high
    if not (np.abs(pose) <= largest).all():
        pose[:] = np.nan
    elif last is not None:  # readings of an angle may be wrapped
        pose[:, 2] += 2 * np.pi * np.round((last.gripper_pose[:, 2] - pose[:, 2]) / (2 * np.pi))
    # an absent pose can only be judged by the last one
    near = pose if np.isfinite(pose).all() or last is None else last.gripper_pose
    keypoints[~(np.abs(keypoints) <= largest)] = np.nan
    if last is not None and ends_exchanged(pose[:, :2], last.gripper_pose[:, :2], target.length):
        raise ValueError(
            "Each gripper is at the other one's last position: their order has changed. Start the run again."
        )
    if ends_exchanged(keypoints, near[:, :2], target.length):
        raise ValueError(
            "The first keypoint is at gripper 1 and the last at gripper 0: exchange the grippers, or reverse the "
            "order of the keypoints."
        )
    keypoints[out_of_reach(keypoints, near[:, :2], target.length)] = np.nan
    cleaned = dataclasses.replace(observation, keypoints=keypoints, gripper_pose=pose, time=stamp)
    unchanged = state.unchanged
    if unchanged is None or not np.array_equal(keypoints, unchanged.keypoints, equal_nan=True):
        unchanged = cleaned
    elif not np.isfinite(unchanged.gripper_pose).all():  # where the grippers were when it stopped is not known
        unchanged = dataclasses.replace(unchanged, gripper_pose=pose)
    elif _moved(pose, unchanged.gripper_pose, target.length):
        # a tracker that has stopped repeats its last frame
        cleaned = dataclasses.replace(cleaned, keypoints=np.full_like(keypoints, np.nan))
    state = dataclasses.replace(state, offset=min(state.offset, offset), unchanged=unchanged)
    share = np.isfinite(cleaned.keypoints).all(axis=1).mean()
    newer = last is None or stamp > last.time
    if last is not None and state.status == Status.PAUSED and last.time - stamp > config.watchdog:
        behind = (
            f"The newest time stamp is {last.time - stamp:.3g} s before an earlier one: was the clock set back? "
            "Then start the run again."
        )
        state = _for_reason(state, behind)
    elif newer and state.status == Status.PAUSED and (old := offset - state.offset) > config.watchdog:
        state = _for_reason(state, f"Observations are {old:.3g} s old: do they arrive late, or was a clock set?")
    if newer and share >= config.min_seen and np.isfinite(pose).all():
        at_rest = state.at_rest
        if state.status == Status.RESTING and state.commands == 0:
            at_rest = (*at_rest, float(shape_error_cm(keypoints, target.keypoints)))[-_RESTS:]
        state = dataclasses.replace(state, newest=cleaned, at_rest=at_rest)
    elif state.newest is None:
        state = dataclasses.replace(state, reason=_unusable(target.length, config.min_seen, pose, share))
    return state, cleaned


def _moved(pose: np.ndarray, before: np.ndarray, length: float) -> bool:
    """Whether a gripper has moved or turned so far that the keypoints have to change."""
    moved = (pose - before) * np.array([1.0, 1.0, ROTATION_WEIGHT * length])
    return bool(np.linalg.norm(moved, axis=1).max() > MOVED * length)


def _unusable(length: float, min_seen: float, pose: np.ndarray, share: float) -> str:
    """Why there is nothing to begin with in an observation."""
    apart = float(np.linalg.norm(pose[1, :2] - pose[0, :2]))
    if not np.isfinite(pose).all():
        return "The grippers' poses are not known yet."
    if apart > 2 * length:
        return (
            f"The grippers are {apart:.3g} m apart, but the cable is {length:.3g} m long: are poses "
            "and keypoints in metres?"
        )
    return (
        f"{100 * share:.0f} % of the keypoints are known and within reach of the grippers, expected "
        f"{100 * min_seen:.0f} %: are they in metres, in the grippers' frame?"
    )


def _for_reason(state: LinkState, reason: str) -> LinkState:
    """The state with this reason; one of the same kind, whose number alone changes, stays as it was first."""
    return state if state.reason[:_KIND] == reason[:_KIND] else dataclasses.replace(state, reason=reason)


def held_ends(seen: Observation) -> np.ndarray:
    """The keypoints; an end that a gripper hides is where the gripper is."""
    keypoints = seen.keypoints.copy()
    seen_ends = np.isfinite(keypoints[[0, -1]]).all(axis=1, keepdims=True)
    keypoints[[0, -1]] = np.where(seen_ends, keypoints[[0, -1]], seen.gripper_pose[:, :2])
    return keypoints
