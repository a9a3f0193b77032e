"""Gripper motions that separate causes and do not overload a cable.

Each starts from where a log started. A pair of grippers is moved in coordinates of the line between them, so that their
distance keeps to its limits on the whole way.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Float
from scipy.special import j0

from cablejax.arrays import wrapped
from cablejax.cable import Discretisation
from cablejax.diagnose.motion_bounds import FARTHEST, NEAREST, Bounds
from cablejax.poses import planar_rows
from cablejax.simulate.motions import MotionConfig, admissible

INTERVAL = 0.1
"""Between two samples of a motion [s]."""
_SAMPLES = 300
_SLOW = 0.3
_HOLD = 3.0
_FAR, _NEAR, _OVERLOAD = 0.93, 0.6, 0.3
_SHIFT = 0.2
_SEGMENT_SAMPLES = 200
# Of the largest speed: what is added up over the samples of a leg is exact only to rounding.
_FULL = 1 - 1e-9


@dataclasses.dataclass(frozen=True)
class Way:
    """A motion of both grippers by where it goes, in coordinates of the line between them.

    Attributes:
        places: middle (x, y) of the line [m], its heading [rad], its length [m], and the angle of either gripper to it
            [rad]; the start comes first.
        shares: of the largest speed, at which each leg is made.
        holds: rest at each place [s].
    """

    places: Float[np.ndarray, "W 6"]
    shares: Float[np.ndarray, "L"]
    holds: Float[np.ndarray, "W"]

    def played(self, n_samples: int, bounds: Bounds = Bounds(), *, rest: float = 0.0) -> Float[np.ndarray, "T 2 3"]:
        """Poses (x, y, theta) every 0.1 s; each leg is as slow as its fastest gripper demands.

        Args:
            n_samples: of the motion. What is left of it after the last place is rest; what does not fit is cut off.
            bounds: with the largest speed and turn rate, which together count as one: half of both may be used at once.
            rest: at least so long the grippers stay where they are at the end [s].
        """
        times, vectors = self.timed(bounds)
        grid = np.minimum(INTERVAL * np.arange(n_samples), INTERVAL * (n_samples - 1) - rest)
        return _poses(np.stack([np.interp(grid, times, column) for column in np.array(vectors).T], axis=1))

    def timed(self, bounds: Bounds) -> tuple[list[float], list[np.ndarray]]:
        """When the grippers leave and reach each place [s], and where that is."""
        times, vectors = [0.0, self.holds[0]], [self.places[0]] * 2
        for target, share, hold in zip(self.places[1:], self.shares, self.holds[1:], strict=True):
            way = vectors[-1] + np.linspace(0.0, 1.0, _SEGMENT_SAMPLES)[:, None] * (target - vectors[-1])
            steps = np.diff(_poses(way), axis=0) / [bounds.speed, bounds.speed, bounds.turn_rate]
            size = np.linalg.norm(steps, axis=-1).max()
            arrival = times[-1] + size * (_SEGMENT_SAMPLES - 1) / (_FULL * share)
            times += [arrival, arrival + hold]
            vectors += [target, target]
        return times, vectors


def _vector(pose: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "6"]:
    """Both grippers as a place of a `Way`."""
    chord = pose[1, :2] - pose[0, :2]
    heading = float(np.arctan2(chord[1], chord[0]))
    return np.array([*pose[:, :2].mean(axis=0), heading, float(np.hypot(*chord)), *wrapped(pose[:, 2] - heading)])


def starting_pose(gripper_pose: Float[np.ndarray, "E T 2 3"]) -> Float[np.ndarray, "2 3"]:
    """The pose from which a next motion starts: the first pose of the episode with the grippers furthest apart."""
    first = np.asarray(gripper_pose, np.float64)[:, 0]
    return first[np.argmax(np.linalg.norm(first[:, 1, :2] - first[:, 0, :2], axis=-1))]


def there_and_back(
    first: Float[np.ndarray, "2 3"], goal: Float[np.ndarray, "2 3"], bounds: Bounds
) -> Float[np.ndarray, "T 2 3"]:
    """Gripper poses every 0.1 s: from one pose to another, with a rest there, and back.

    For half a minute, or as long as it takes at the speed that is allowed; cut off where motions may not last so long.

    Args:
        first: (x, y, theta) of both grippers [m, rad].
        goal: likewise.
        bounds: on the grippers' speed and the duration; the others are not looked at.
    """
    start, there = _vector(first), _vector(goal)
    there[2] = start[2] + wrapped(there[2] - start[2])
    way = Way(np.stack([start, there, start]), np.ones(2), np.array([1.0, _HOLD, 2 * _HOLD]))
    back = math.ceil(way.timed(bounds)[0][-2] / INTERVAL) + 1
    return way.played(min(max(_SAMPLES, back), int(bounds.duration / INTERVAL + 1e-6) + 1), bounds)


def safe_motions(
    config: Discretisation, first: Float[np.ndarray, "2 3"], n_samples: int = _SAMPLES, bounds: Bounds = Bounds()
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
        bounds: on the grippers' speed and distance; the others are not looked at.

    Raises:
        ValueError: `first` is not two planar poses.
    """
    motions = {name: way.played(n_samples, bounds) for name, way in safe_ways(config, first, bounds).items()}
    limits = MotionConfig.for_length(config.cable.length, straight_slack=1 - FARTHEST, min_distance=NEAREST)
    return {name: poses for name, poses in motions.items() if all(admissible(config, limits, p) for p in poses[::5])}


def safe_ways(config: Discretisation, first: Float[np.ndarray, "2 3"], bounds: Bounds = Bounds()) -> dict[str, Way]:
    """The ways of `safe_motions`, also of those that this cable would not bear.

    Args:
        config: the cable.
        first: gripper poses to start from; moved apart or together where they are beyond the limits.
        bounds: on the grippers' distance; the others are not looked at.

    Raises:
        ValueError: `first` is not two planar poses.
    """
    first = planar_rows(first, "first")
    length = config.cable.length
    start = _vector(first)
    low, high = (distance / length for distance in bounds.distances(length))
    start[3] = np.clip(start[3], low * length, high * length)
    side = -1.0 if start[4] < start[5] else 1.0

    def at(ratio: float, mirrored: bool = False, shift: float = 0.0) -> Float[np.ndarray, "6"]:
        """An arch on the side to which the cable leans, its grippers turned half as far as they would turn freely."""
        # pinned ends with the tangent `a cos(pi s / L)` between them are `J0(a) L` apart
        angles = np.linspace(2.4, 0.0, 481)
        lean = 0.5 * float(np.interp(ratio, j0(angles), angles)) * (-side if mirrored else side)
        across = np.array([-np.sin(start[2]), np.cos(start[2])])
        return np.array([*(start[:2] + shift * length * across), start[2], ratio * length, lean, -lean])

    moved, taut, mirrored = start.copy(), start.copy(), start.copy()
    moved[:2], taut[3:], mirrored[4:] = at(1.0, shift=_SHIFT)[:2], [(high - 1e-6) * length, 0.0, 0.0], -start[4:]
    plans: dict[str, list[tuple[np.ndarray, float, float]]] = {
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
    return {
        name: Way(
            places=np.stack([place for place, _, _ in plan]),
            shares=np.array([share for _, share, _ in plan[1:]]),
            holds=np.array([hold for _, _, hold in plan]),
        )
        for name, plan in plans.items()
    }


def _poses(vectors: Float[np.ndarray, "T 6"]) -> Float[np.ndarray, "T 2 3"]:
    x, y, heading, distance, first, second = vectors.T
    half = 0.5 * distance * np.stack([np.cos(heading), np.sin(heading)])
    left = np.stack([x - half[0], y - half[1], heading + first], axis=1)
    right = np.stack([x + half[0], y + half[1], heading + second], axis=1)
    return np.stack([left, right], axis=1)
