"""A few gripper motions that separate causes and that every cable of the format bears.

Each starts from where a log started. A pair of grippers is moved in coordinates of the line between them, so that their
distance keeps to its limits on the whole way.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.special import j0

from cablejax.cable import Discretisation
from cablejax.simulate.motions import MotionConfig, admissible
from cablejax.simulate.pose import wrapped

INTERVAL = 0.1
"""Between two samples of a motion [s]."""
LIMITS = MotionConfig(straight_slack=0.005, min_distance=0.15, max_step=0.05, rotation_weight=0.15)
"""Bounds on the grippers: distance 0.15 to 0.995 of the length, 0.05 m/s with 0.15 m/rad."""
_SLOW = 0.3
_HOLD = 3.0
_FAR, _NEAR, _OVERLOAD = 0.93, 0.6, 0.3
_SHIFT = 0.2
_SEGMENT_SAMPLES = 200


@dataclasses.dataclass(frozen=True)
class _Pair:
    """Both grippers by the line between them.

    Attributes:
        middle: of that line [m].
        heading: its direction, from gripper 0 to gripper 1 [rad].
        distance: its length [m].
        angles: of either gripper to that line [rad].
    """

    middle: Float[np.ndarray, "2"]
    heading: float
    distance: float
    angles: Float[np.ndarray, "2"]

    @classmethod
    def of(cls, pose: Float[np.ndarray, "2 3"]) -> _Pair:
        chord = pose[1, :2] - pose[0, :2]
        heading = float(np.arctan2(chord[1], chord[0]))
        angles = wrapped(pose[:, 2] - heading)
        return cls(pose[:, :2].mean(axis=0), heading, float(np.hypot(*chord)), angles)

    @property
    def vector(self) -> Float[np.ndarray, "6"]:
        return np.array([*self.middle, self.heading, self.distance, *self.angles])


def starting_pose(gripper_pose: Float[np.ndarray, "E T 2 3"]) -> Float[np.ndarray, "2 3"]:
    """The pose from which a next motion starts: the first pose of the episode with the grippers furthest apart."""
    first = np.asarray(gripper_pose, np.float64)[:, 0]
    return first[np.argmax(np.linalg.norm(first[:, 1, :2] - first[:, 0, :2], axis=-1))]


def safe_motions(
    config: Discretisation, first: Float[np.ndarray, "2 3"], n_samples: int = 300
) -> dict[str, Float[np.ndarray, "T 2 3"]]:
    """Motions by name, as gripper poses (x, y, theta) every 0.1 s; the last pose is held to the end.

    - `mirror`: the first pose mirrored in the line between the grippers, then closing in and back: a stiffness that
      varies along the cable and a curved rest shape answer with opposite signs.
    - `translation`: both grippers across the cable and back: friction and nothing else bends the cable.
    - `ramp_hold`: closing in fast, then slowly, with holds: viscous against Coulomb forces, lags.
    - `overload_return`: bent tightly and back: a remaining bend is plastic.
    - `taut`: pulled nearly straight: stretch, slip, and the length.
    - `shifted_repeat`: the same approach at two places of the table: effects of the table do not move with the cable.

    Motions that this cable would not bear from this first pose are left out.

    Args:
        config: the cable.
        first: gripper poses to start from; moved apart or together where they are beyond the limits.
        n_samples: of each motion. It is cut off there, which loses no more than a last hold from 300 samples on for a
            cable of 1 m.

    Raises:
        ValueError: `first` is not two planar poses.
    """
    first = np.asarray(first, np.float64)
    if first.shape != (2, 3) or not np.isfinite(first).all():
        raise ValueError(f"first has shape {first.shape}, expected two finite poses (x, y, theta).")
    length = config.cable.length
    given = _Pair.of(first)
    low, high = LIMITS.min_distance, 1.0 - LIMITS.straight_slack
    start = dataclasses.replace(given, distance=float(np.clip(given.distance, low * length, high * length)))
    side = -1.0 if given.angles[0] < given.angles[1] else 1.0

    def at(ratio: float, mirrored: bool = False, shift: float = 0.0) -> _Pair:
        """An arch on the side to which the cable leans, its grippers turned half as far as they would turn freely."""
        lean = 0.5 * _free_angle(ratio) * (-side if mirrored else side)
        across = np.array([-np.sin(start.heading), np.cos(start.heading)])
        return _Pair(start.middle + shift * length * across, start.heading, ratio * length, np.array([lean, -lean]))

    moved = dataclasses.replace(start, middle=at(1.0, shift=_SHIFT).middle)
    taut = dataclasses.replace(start, distance=(high - 1e-6) * length, angles=np.zeros(2))
    mirrored = dataclasses.replace(start, angles=-start.angles)
    plans: dict[str, list[tuple[_Pair, float, float]]] = {
        # (where to, share of the largest speed, hold there [s])
        "mirror": [
            (mirrored, 1.0, 1.0),
            (at(_FAR, mirrored=True), 1.0, 1.0),
            (at(_NEAR, mirrored=True), 0.6, _HOLD),
            (at(_FAR, mirrored=True), 0.6, _HOLD),
        ],
        "translation": [(start, 1.0, 1.0), (moved, 0.6, _HOLD), (start, 0.6, _HOLD)],
        "ramp_hold": [
            (start, 1.0, 1.0),
            (at(_NEAR), 1.0, _HOLD),
            (at(_FAR), 1.0, 1.0),
            (at(_NEAR), _SLOW, _HOLD),
        ],
        "overload_return": [(start, 1.0, 1.0), (at(_OVERLOAD), 1.0, 2.0), (start, 1.0, 2 * _HOLD)],
        "taut": [(start, 1.0, 1.0), (taut, 0.6, _HOLD), (start, 0.6, _HOLD)],
        "shifted_repeat": [
            (start, 1.0, 0.5),
            (at(_NEAR), 1.0, 1.0),
            (at(_FAR), 1.0, 0.0),
            (at(_FAR, shift=_SHIFT), 1.0, 0.5),
            (at(_NEAR, shift=_SHIFT), 1.0, _HOLD),
        ],
    }
    motions = {name: _played(plan, n_samples) for name, plan in plans.items()}
    return {name: poses for name, poses in motions.items() if all(admissible(config, LIMITS, p) for p in poses[::5])}


def _free_angle(ratio: float) -> float:
    """Angle [rad] at which a cable pinned at this distance, relative to its length, leaves its ends.

    With the tangent `a cos(pi s / L)` the ends are `J0(a) L` apart.
    """
    angles = np.linspace(2.4, 0.0, 481)
    return float(np.interp(ratio, j0(angles), angles))


def _played(plan: Sequence[tuple[_Pair, float, float]], n_samples: int) -> Float[np.ndarray, "T 2 3"]:
    """Poses along the plan; each stretch is as slow as its fastest gripper demands."""
    times, vectors = [0.0, plan[0][2]], [plan[0][0].vector] * 2
    for target, share, hold in plan[1:]:
        way = vectors[-1] + np.linspace(0.0, 1.0, _SEGMENT_SAMPLES)[:, None] * (target.vector - vectors[-1])
        steps = np.diff(_poses(way), axis=0)
        size = np.linalg.norm(steps * [1.0, 1.0, LIMITS.rotation_weight], axis=-1).max()
        arrival = times[-1] + size * (_SEGMENT_SAMPLES - 1) / (share * LIMITS.max_step)
        times += [arrival, arrival + hold]
        vectors += [target.vector, target.vector]
    grid = INTERVAL * np.arange(n_samples)
    return _poses(np.stack([np.interp(grid, times, column) for column in np.array(vectors).T], axis=1))


def _poses(vectors: Float[np.ndarray, "T 6"]) -> Float[np.ndarray, "T 2 3"]:
    x, y, heading, distance, first, second = vectors.T
    half = 0.5 * distance * np.stack([np.cos(heading), np.sin(heading)])
    left = np.stack([x - half[0], y - half[1], heading + first], axis=1)
    right = np.stack([x + half[0], y + half[1], heading + second], axis=1)
    return np.stack([left, right], axis=1)
