"""Classifies a log's samples into regimes, by the grippers' motion and the cable's shape."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from jaxtyping import Bool, Float

from cablejax.arrays import wrapped
from cablejax.types import ROTATION_WEIGHT, GapLog

# Grippers slower than this rest [m/s]: encoders do not tell slower ones from noise.
_REST_SPEED = 1e-3
# Grippers move fast from this on [lengths of the cable per second].
_FAST_SPEED = 0.02
_REVERSAL_EDGES = (0.0, 1.0, 3.0, 10.0)


@dataclasses.dataclass(frozen=True)
class Regimes:
    """Regimes of the samples.

    Attributes:
        masks: by "what: class", shape [E, T] each, those with samples; the classes of one "what" do not overlap.
        pairs: two regimes that are worth holding against each other, by the name of the first.
        hold: the grippers rest and the cable has settled, shape [E, T].
    """

    masks: dict[str, Bool[np.ndarray, "E T"]]
    pairs: dict[str, tuple[Bool[np.ndarray, "E T"], Bool[np.ndarray, "E T"]]]
    hold: Bool[np.ndarray, "E T"]


def regimes_of(log: GapLog, nominal: Float[np.ndarray, "E T N 2"], valid: Bool[np.ndarray, "E T"]) -> Regimes:
    """Regimes from the measured gripper poses and the nominal cable.

    Args:
        log: of a cable on a table, held by two grippers.
        nominal: simulated keypoints [m].
        valid: samples that are no padding.
    """
    length = float(log.meta["cable"]["length_m"])
    speed, since = np.zeros(valid.shape), np.full(valid.shape, np.nan)
    for e, samples in enumerate(log.episode_length):
        if samples < 3:
            continue
        velocity = _velocity(log.gripper_pose[e, :samples], log.time[e, :samples], length)
        speed[e, :samples] = np.linalg.norm(velocity, axis=-1).max(axis=-1)
        since[e, :samples] = _since_reversal(velocity, log.time[e, :samples])
    rest = valid & (speed < _REST_SPEED)
    hold = rest if log.hold is None else valid & log.hold
    fast = valid & (speed >= _FAST_SPEED * length)
    distance = np.linalg.norm(log.gripper_pose[:, :, 1, :2] - log.gripper_pose[:, :, 0, :2], axis=-1)
    curvature = largest_curvature(nominal, np.asarray(log.meta["keypoint_arclength_m"], float))
    rate = np.zeros(valid.shape)
    if valid.shape[1] > 1:
        rate[:, 1:] = np.diff(distance, axis=1) / np.maximum(np.diff(log.time, axis=1), 1e-9)
    closing, opening = valid & (rate < -_REST_SPEED), valid & (rate > _REST_SPEED)
    moving = valid & ~rest
    # before anything moved hardly any effect shows: such a rest is no evidence that a gap needs motion
    moved = np.maximum.accumulate(moving, axis=1)
    settled = hold & moved
    masks = {
        "start: at rest": hold & ~moved,
        "speed: hold": settled,
        "speed: slow": moving & ~fast & ~hold,
        "speed: fast": fast & ~hold,
        **_halves("curvature", curvature, valid, ("low", "high")),
        **_halves("gripper distance", distance / length, valid, ("short", "long")),
        "direction: grippers closing": closing,
        "direction: grippers opening": opening,
        "direction: grippers moving together": moving & ~closing & ~opening,
        "reversal: before the first": moving & np.isnan(since),
    }
    edges = (*_REVERSAL_EDGES, np.inf)
    for low, high in itertools.pairwise(edges):
        words = f"{low:g} to {high:g} s after" if np.isfinite(high) else f"more than {low:g} s after"
        with np.errstate(invalid="ignore"):
            masks[f"reversal: {words}"] = valid & (since >= low) & (since < high)
    late = np.isfinite(since)
    pairs = {
        "speed: hold": (settled, moving & ~hold),
        "speed: fast": (masks["speed: fast"], masks["speed: slow"]),
        "direction: grippers closing": (closing, opening),
        "reversal: after": (moving & late, moving & ~late),
        "curvature: high": (masks["curvature: high"], masks["curvature: low"]),
        "gripper distance: short": (masks["gripper distance: short"], masks["gripper distance: long"]),
    }
    return Regimes(masks={k: m for k, m in masks.items() if m.any()}, pairs=pairs, hold=hold)


def _velocity(
    pose: Float[np.ndarray, "T Q 3"], time: Float[np.ndarray, "T"], length: float
) -> Float[np.ndarray, "T Q 3"]:
    """Twists [m/s], rotation times `ROTATION_WEIGHT` on a cable of this length [m]."""
    pose = pose.astype(np.float64)
    pose[..., 2] = ROTATION_WEIGHT * length * np.unwrap(pose[..., 2], axis=0)
    return np.gradient(pose, time, axis=0)


def _since_reversal(velocity: Float[np.ndarray, "T Q 3"], time: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
    """Seconds since the joint motion of the grippers last turned against the direction it had before."""
    result = np.full(len(time), np.nan)
    flat = velocity.reshape(len(time), -1)
    direction, reversed_at = None, np.nan
    for t, v in enumerate(flat):
        size = np.linalg.norm(v)
        if size > 2 * _REST_SPEED:
            unit = v / size
            if direction is not None and unit @ direction < -0.5:
                reversed_at = time[t]
            direction = unit
        result[t] = time[t] - reversed_at
    return result


def _halves(name: str, values, valid, classes: tuple[str, str]) -> dict[str, np.ndarray]:
    """Samples below and above the median."""
    median = np.nanmedian(values[valid]) if np.isfinite(values[valid]).any() else np.nan
    with np.errstate(invalid="ignore"):
        low, high = valid & (values <= median), valid & (values > median)
    return {f"{name}: {c}": mask for c, mask in zip(classes, (low, high), strict=True)}


def largest_curvature(
    points: Float[np.ndarray, "E T N 2"], arclength: Float[np.ndarray, "N"]
) -> Float[np.ndarray, "E T"]:
    """Largest curvature of each shape [1/m], from the turns between chords of keypoints at these arc lengths [m]."""
    edges = np.diff(points, axis=2)
    heading = np.arctan2(edges[..., 1], edges[..., 0])
    turn = wrapped(np.diff(heading, axis=-1))
    curvature = np.abs(turn) / (0.5 * (arclength[2:] - arclength[:-2]))
    return np.max(curvature, axis=-1, initial=0.0)
