"""Bounds on a motion to be recorded: read from a file, checked on the grippers and on the simulated cable."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from cablejax.arrays import wrapped
from cablejax.cable import Discretisation
from cablejax.limits import LIMITS, check, check_workspace, require, shown
from cablejax.simulate.equilibrium import arch_angles, chain_nodes, find_equilibrium
from cablejax.simulate.motions import MotionConfig, admissible
from cablejax.text_file import read_toml, unknown_key
from cablejax.types import ROTATION_WEIGHT

SNAP_THROUGH = "snap_through"
"""Name of the bound that a motion breaks on which the cable jumps to another shape, or is close to that."""
NEAREST, FARTHEST, TIGHTEST = 0.15, 0.995, 0.03
"""Distances of the grippers and bend radius where none are given, in lengths of the cable."""
AMPLIFICATION = 5.0
"""Movement of any point of the cable relative to what the grippers move, from which on the cable snaps through. Pulling
a cable to 99.5 % of its length reaches 3.6; motions that snap through reach 5 to 15."""
STABILITY = 0.45
"""Least stability of the frictionless cable on the way, see `Equilibrium.stability`, over the number of links: 0 where
it snaps through, 0.7 for an arch. Near 0 a small error of a clamp or a law decides where the cable goes, and when."""
_SPACING, _PARTS = 5, 40
# Of the amplification, of a motion that is planned: the real cable lies elsewhere.
_PLANNED = 0.8
# Grippers that moved within this time may still move a cable that friction held [samples].
_RECENT = 10
# So slow, in one sample, that it counts as rest, in lengths of the cable: whether it snaps does not depend on its size.
_REST = 1e-3
_ROUNDING = 1e-6


class BoundsError(ValueError):
    """Bounds that leave no motion."""


@dataclasses.dataclass(frozen=True)
class Bounds:
    """Bounds on a motion of the grippers and on the cable between them.

    Attributes:
        workspace: lowest and highest corner (x, y) of where grippers and cable may be [m]; None = anywhere.
        keep_out: discs (x, y, radius) that neither grippers nor cable may enter [m].
        speed: of each gripper at most [m/s].
        turn_rate: of each gripper at most [rad/s].
        min_distance: of the grippers from each other at least [m]; None = 0.15 lengths of the cable, or half
            the largest.
        max_distance: of the grippers from each other at most [m]; None = 0.995 lengths of the cable.
        bend_radius: of the cable at least [m]; None = 0.03 lengths of the cable.
        duration: of a motion at most [s].

    Raises:
        ValueError: a number is out of its limits, or the distances or corners are not in order.
    """

    workspace: tuple[tuple[float, float], tuple[float, float]] | None = None
    keep_out: tuple[tuple[float, float, float], ...] = ()
    speed: float = 0.05
    turn_rate: float = 0.05 / ROTATION_WEIGHT
    min_distance: float | None = None
    max_distance: float | None = None
    bend_radius: float | None = None
    duration: float = 30.0

    def __post_init__(self):
        check(self, speed="gripper_speed", turn_rate="turn_rate", duration="motion_duration")
        given = {"min_distance": "length", "max_distance": "length", "bend_radius": "bend_radius"}
        check(self, **{name: limit for name, limit in given.items() if getattr(self, name) is not None})
        low, high = self.min_distance, self.max_distance
        if low is not None and high is not None and low >= high:
            raise ValueError(
                f"Bounds.min_distance is {self.min_distance}, Bounds.max_distance {self.max_distance}: expected the "
                "first below the second [m]."
            )
        check_workspace(self)
        for corner in self.workspace or ():
            for place in corner:
                require(place, "place", "A coordinate of Bounds.workspace")
        for disc in self.keep_out:
            if len(disc) != 3:
                raise ValueError(f"Bounds.keep_out has the disc {shown(disc)}, expected (x, y, radius) [m].")
            for number, limit in zip(disc, ("place", "place", "length"), strict=True):
                require(number, limit, "A number of a disc of Bounds.keep_out")

    def distances(self, length: float) -> tuple[float, float]:
        """Smallest and largest distance of the grippers for a cable of this length [m]."""
        # no cable can be pulled farther
        high = min(FARTHEST * length if self.max_distance is None else self.max_distance, FARTHEST * length)
        return min(NEAREST * length, high / 2) if self.min_distance is None else self.min_distance, high

    def radius(self, length: float) -> float:
        """Smallest bend radius of a cable of this length [m]."""
        return TIGHTEST * length if self.bend_radius is None else self.bend_radius


KEYS: Mapping[str, tuple[str, str]] = {
    "workspace_m": ("workspace", "m"),
    "keep_out_m": ("keep_out", "m"),
    "speed_m_per_s": ("speed", "m/s"),
    "turn_rate_rad_per_s": ("turn_rate", "rad/s"),
    "min_distance_m": ("min_distance", "m"),
    "max_distance_m": ("max_distance", "m"),
    "bend_radius_m": ("bend_radius", "m"),
    "duration_s": ("duration", "s"),
}
"""Field of `Bounds` and unit of every key of its file."""


def read_bounds(path: str | os.PathLike[str]) -> Bounds:
    """The bounds in a TOML file with some of the keys `KEYS`; the others have their defaults.

    Raises:
        ValueError: the file cannot be read, is no TOML, or has a key that is unknown or a value that is not possible;
            names the key.
    """
    try:
        fields = read_toml(path)
    except (ValueError, OSError) as error:
        raise ValueError(f"{error} Expected a TOML file of bounds.") from None
    values: dict[str, Any] = {}
    for key, value in fields.items():
        if key not in KEYS:
            raise ValueError(f"{path} has {unknown_key(key, {known: unit for known, (_, unit) in KEYS.items()})}")
        width = {"workspace_m": 2, "keep_out_m": 3}.get(key)
        values[KEYS[key][0]] = value if width is None else _rows(value, width, f"{path}: {key}")
    try:
        return Bounds(**values)
    except ValueError as error:
        text = str(error)
        for key, (name, _) in KEYS.items():
            text = text.replace(f"Bounds.{name}", key)
        raise ValueError(f"{path}: {text}") from None


def _rows(value: Any, width: int, where: str) -> tuple[tuple[float, ...], ...]:
    """A list of rows of `width` numbers."""
    rows: list[Any] = value if isinstance(value, list) else [None]
    if not all(isinstance(r, list) and len(r) == width and all(v in LIMITS["place"] for v in r) for r in rows):
        example = "[[x, y], [x, y]], the lowest and the highest corner" if width == 2 else "[[x, y, radius], ...]"
        raise ValueError(f"{where} is {shown(value)}, expected {example}, in metres.")
    return tuple(tuple(map(float, row)) for row in rows)


def grippers_beyond(
    bounds: Bounds, config: Discretisation, poses: Float[np.ndarray, "T 2 3"], interval: float
) -> dict[str, float]:
    """By how much a motion of the grippers breaks each bound, relative to a size that matters; only those broken.

    It also breaks "reach", where the grippers' angles need more cable than there is, and "snap_through", where the
    cable at rest, without friction, jumps to another shape on the way, or is close to that.

    Args:
        bounds: to keep.
        config: the cable as it is believed to be.
        poses: of the grippers at every sample.
        interval: between samples [s].
    """
    length, moved = config.cable.length, np.diff(poses, axis=0) / interval
    line = poses[:, 1, :2] - poses[:, 0, :2]
    apart = np.linalg.norm(line, axis=-1)
    low, high = bounds.distances(length)
    found = {
        "speed": np.linalg.norm(moved[..., :2], axis=-1).max(initial=0.0) / bounds.speed - 1,
        "turn_rate": np.abs(moved[..., 2]).max(initial=0.0) / bounds.turn_rate - 1,
        "distance": max(low - apart.min(), apart.max() - high) / length,
        "duration": interval * (len(poses) - 1) / bounds.duration - 1,
        **_beyond_places(bounds, poses[:, :, :2].swapaxes(0, 1), 0.0, length),
    }
    broken = _those_broken(found)
    if not broken:
        angles = np.abs(wrapped(poses[..., 2] - np.arctan2(*line.T[::-1])[:, None]))
        limits = MotionConfig.for_length(length, straight_slack=1 - FARTHEST, min_distance=1e-6)
        taken = [admissible(config, limits, pose) for pose in poses[::_SPACING]]
        if not all(taken):
            broken["reach"] = 1 - float(np.mean(taken)) + max(float(angles.max()) - limits.max_angle, 0.0)
        elif (jump := _near_snapping(config, poses)) > 0:
            broken[SNAP_THROUGH] = jump
    return broken


def cable_beyond(
    bounds: Bounds,
    config: Discretisation,
    poses: Float[np.ndarray, "T 2 3"],
    keypoints: Float[np.ndarray, "X T N 2"],
    *,
    arclength: Float[np.ndarray, "N"] | None = None,
    margin: float = 0.0,
) -> dict[str, float]:
    """By how much the cable of simulated motions breaks each bound, as `grippers_beyond`.

    Args:
        bounds: to keep.
        config: the cable as it is believed to be.
        poses: of the grippers at every sample.
        keypoints: true ones [m], by as many simulations as are to keep the bounds; NaN where one broke down, which
            counts as a snap-through.
        arclength: of the keypoints [m]; None = they are evenly spaced.
        margin: kept from the workspace's edge and from discs [m]; with one, the bend radius is kept larger by a tenth,
            and the movement smaller by a fifth.
    """
    length = config.cable.length
    if not np.isfinite(keypoints).all():
        return {SNAP_THROUGH: 10.0}
    along = np.linspace(0.0, length, keypoints.shape[-2]) if arclength is None else arclength
    least, most = bounds.radius(length), AMPLIFICATION
    if margin > 0:
        least, most = least * 1.1, most * _PLANNED
    step = np.linalg.norm(np.diff(keypoints, axis=1), axis=-1).max(axis=-1)
    sizes = np.linalg.norm(np.diff(poses, axis=0) * [1.0, 1.0, ROTATION_WEIGHT * length], axis=-1).sum(axis=-1)
    recent = np.lib.stride_tricks.sliding_window_view(np.pad(sizes, (_RECENT, 0)), _RECENT + 1).max(axis=-1)
    jump = float((step / np.maximum(recent, _REST * length)).max(initial=0.0))
    return _those_broken(
        {
            **_beyond_places(bounds, refined(keypoints, along), margin + 0.5 * config.cable.diameter, length),
            "bend_radius": float(curvature(keypoints, along).max()) * least - 1,
            SNAP_THROUGH: min(jump / most - 1, 10.0),
        }
    )


def refined(points: Float[np.ndarray, "*B N 2"], arclength: Float[np.ndarray, "N"]) -> Float[np.ndarray, "*B M 2"]:
    """A line through points of a cable at these arc lengths, and every fortieth of it between: a cubic spline."""
    between = np.linspace(arclength[0], arclength[-1], _PARTS + 1)
    return CubicSpline(arclength, points, axis=-2)(np.union1d(arclength, between))


def curvature(points: Float[np.ndarray, "*B N 2"], arclength: Float[np.ndarray, "N"]) -> Float[np.ndarray, "*B N"]:
    """Size of a cable's curvature at its keypoints [1/m]: of the circle through each three, linear to the ends.

    Two keypoints show none; three show that of their circle.

    An elastic cable's curvature is linear in the distance from the line of the force that it carries.
    """
    if points.shape[-2] < 3:
        return np.zeros(points.shape[:-1])
    a, b = points[..., 1:-1, :] - points[..., :-2, :], points[..., 2:, :] - points[..., 1:-1, :]
    sides = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1) * np.linalg.norm(a + b, axis=-1)
    inner = 2 * (a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]) / np.maximum(sides, 1e-12)
    beside = inner[..., [1, -2]] if inner.shape[-1] > 1 else inner[..., [0, 0]]
    gaps = np.diff(arclength)
    first = inner[..., :1] + gaps[0] / gaps[1] * (inner[..., :1] - beside[..., :1])
    last = inner[..., -1:] + gaps[-1] / gaps[-2] * (inner[..., -1:] - beside[..., 1:])
    return np.abs(np.concatenate([first, inner, last], axis=-1))


def _beyond_places(
    bounds: Bounds, lines: Float[np.ndarray, "*B N 2"], margin: float, length: float
) -> dict[str, float]:
    """How far lines come out of the workspace, or into a disc, in lengths of the cable."""
    found = {}
    if bounds.workspace is not None:
        low, high = np.array(bounds.workspace)
        found["workspace"] = float(max((low - lines).max(), (lines - high).max()) + margin) / length
    begin, along = lines[..., :-1, :], np.diff(lines, axis=-2)
    squares = np.maximum((along**2).sum(axis=-1), 1e-18)
    for x, y, radius in bounds.keep_out:
        to = np.array([x, y]) - begin
        share = np.clip((to * along).sum(axis=-1) / squares, 0.0, 1.0)
        nearest = np.linalg.norm(to - share[..., None] * along, axis=-1).min()
        found["keep_out"] = max(found.get("keep_out", -np.inf), (radius + margin - float(nearest)) / length)
    return found


def _near_snapping(config: Discretisation, poses: Float[np.ndarray, "T 2 3"]) -> float:
    """How far the frictionless cable at rest moves beyond a planned `AMPLIFICATION`, or falls below `STABILITY`.

    Both are relative, and nothing above 10; 0 where neither happens.
    """
    most, least, before, length = 0.0, np.inf, None, config.cable.length
    angles = arch_angles(config, poses[0])
    for pose in poses[::_SPACING]:
        try:
            rest = find_equilibrium(config, pose, angles)
        except ValueError:
            return 10.0
        angles, least = rest.angles, min(least, rest.stability / config.n_links)
        nodes = chain_nodes(config, pose, angles)
        if before is not None:
            size = np.linalg.norm((pose - before[1]) * [1.0, 1.0, ROTATION_WEIGHT * length], axis=-1).sum()
            moved = np.linalg.norm(nodes - before[0], axis=-1).max()
            most = max(most, float(moved / max(size, 2 * _REST * length)))
        before = nodes, pose
    return min(max(most / (_PLANNED * AMPLIFICATION) - 1, 1 - least / STABILITY, 0.0), 10.0)


def _those_broken(found: Mapping[str, Any]) -> dict[str, float]:
    return {name: float(value) for name, value in found.items() if value > _ROUNDING}
