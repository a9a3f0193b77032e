"""Target shapes: the letters U, S and Z as shapes in which a cable rests, and targets from a user's file."""

from __future__ import annotations

import dataclasses
import functools
import pathlib
from typing import Literal

import numpy as np
from jaxtyping import Float

from cablejax.arrays import real
from cablejax.cable import Cable
from cablejax.limits import LIMITS
from cablejax.npz import read_npz
from cablejax.simulate.elastica import elastica
from cablejax.text_file import read_json, read_text

Shape = Literal["U", "S", "Z"]
"""The letters of Wang et al., RA-L 2022."""

START_DISTANCE = 0.99
"""Distance between the grippers of a straight cable, in lengths."""
START_LEAN = 0.01
"""Angle [rad] by which the ends of a straight cable lean, so that its slack lies on a known side."""
LENGTH_TOLERANCE = 0.03
"""How far the length of a target's polyline may be from the cable's length, relative to it."""

_OTHER = 0.8, 1.1
"""A target's length over the cable's, between which a controller can bring the cable near it."""
_COARSE = 13.0, 1.3
"""Arcs through few keypoints are shorter than a cable with inflections, and longer than one that bends less towards its
ends: by these over the fourth power of the number of spaces."""

STRETCH = 0.2
"""How much farther neighbouring keypoints may be apart than the cable between them is long, relative to it."""


def length_through(points: Float[np.ndarray, "N 2"]) -> float:
    """Length [m] of a cable through two or more points, from arcs: an edge that turns by a is the chord of one."""
    edges = np.diff(points, axis=0)
    if len(edges) < 2:
        return float(np.hypot(*edges.T).sum())
    turn = np.abs(np.gradient(np.unwrap(np.arctan2(edges[:, 1], edges[:, 0]))))
    return float((np.hypot(*edges.T) / np.sinc(turn / 2 / np.pi)).sum())


@dataclasses.dataclass(frozen=True)
class Target:
    """A shape to bring a cable to.

    Attributes:
        name: for tables and titles.
        keypoints: wanted positions [m], from gripper 0 to gripper 1, shape [N, 2].
        gripper_pose: (x, y, theta) [m, rad] of both grippers in that shape, shape [Q, 3].
    """

    name: str
    keypoints: Float[np.ndarray, "N 2"]
    gripper_pose: Float[np.ndarray, "Q 3"]

    @functools.cached_property
    def length(self) -> float:
        """Of the cable through the keypoints [m]."""
        return length_through(self.keypoints)

    def require_length(self, length: float, whose: str) -> None:
        """Raises ValueError unless a cable of this length [m] comes near the target; `whose` it is, in words."""
        (low, high), (shorter, longer) = _OTHER, _coarse(len(self.keypoints))
        if not low - shorter <= self.length / length <= high + longer:
            raise ValueError(
                f"Target {self.name!r} is {self.length:.3g} m long along its keypoints, but {whose} is for a cable of "
                f"{length:.3g} m: use a target of that length."
            )


def _coarse(n_keypoints: int) -> tuple[float, float]:
    """Parts of a cable's length by which `length_through` may be too short and too long."""
    shorter, longer = _COARSE
    return shorter / (n_keypoints - 1) ** 4, longer / (n_keypoints - 1) ** 4


@dataclasses.dataclass(frozen=True)
class _Letter:
    """Ends of a letter: angles [deg] of the end tangents against the chord, chord in lengths, its direction [deg]."""

    start: float
    end: float
    distance: float
    direction: float


_LETTERS: dict[str, _Letter] = {
    "U": _Letter(start=-90.0, end=90.0, distance=0.45, direction=0.0),
    "S": _Letter(start=-90.0, end=-90.0, distance=0.65, direction=60.0),
    "Z": _Letter(start=115.0, end=115.0, distance=0.52, direction=-60.0),
}


def make_target(shape: Shape, config: Cable = Cable()) -> Target:
    """The letter U, S or Z as the elastica between two grippers, its chord's middle at the origin.

    It is a stable equilibrium of a uniform cable without friction, whatever its stiffness.

    Raises:
        ValueError: another letter.
    """
    if shape not in _LETTERS:
        raise ValueError(
            f"There is no shape {shape!r}, expected one of {', '.join(_LETTERS)}; load_target reads files."
        )
    letter = _LETTERS[shape]
    direction = np.radians(letter.direction)
    half = 0.5 * letter.distance * config.length * np.array([np.cos(direction), np.sin(direction)])
    pose = np.array(
        [[*-half, direction + np.radians(letter.start)], [*half, direction + np.radians(letter.end)]]
    )  # fmt: skip
    return Target(shape, elastica(pose, config.length, config.keypoint_arclength), pose)


def straight_start(config: Cable = Cable()) -> Float[np.ndarray, "2 3"]:
    """Gripper poses (x, y, theta) of an almost straight cable along +x, centred at the origin, its slack towards -y."""
    half = 0.5 * START_DISTANCE * config.length
    return np.array([[-half, 0.0, -START_LEAN], [half, 0.0, START_LEAN]])


def target_from_keypoints(
    name: str,
    keypoints: Float[np.ndarray, "N 2"],
    config: Cable = Cable(),
    gripper_pose: Float[np.ndarray, "2 3"] | None = None,
) -> Target:
    """A target from points along the cable, checked against the cable it is meant for.

    Args:
        name: for tables and titles.
        keypoints: positions [m], uniform in arc length, gripper 0 first, shape [N, 2].
        config: the cable.
        gripper_pose: poses of the grippers [m, rad]; without them the ends' positions and the directions that continue
            the polyline's bend to its ends.

    Raises:
        ValueError: another number of points, points that are not finite, a cable of another length, or grippers that
            do not hold its ends.
    """
    points = real(keypoints, f"Target {name!r} has keypoints of")
    if points.ndim != 2 or points.shape[1:] != (2,):
        raise ValueError(f"Target {name!r} has keypoints of shape {points.shape}, expected ({config.n_keypoints}, 2).")
    if len(points) != config.n_keypoints:
        raise ValueError(
            f"Target {name!r} has {len(points)} keypoints, but the cable is seen at {config.n_keypoints}: resample it "
            "uniformly in arc length, both ends included."
        )
    if not np.isfinite(points).all():
        rows = np.flatnonzero(~np.isfinite(points).all(axis=1)).tolist()
        raise ValueError(f"Target {name!r} has keypoints that are not finite, at {rows}: fill them in or resample.")
    away = float(np.abs(points).max())
    if away / config.length not in LIMITS["target_distance"]:
        raise ValueError(
            f"Target {name!r} lies up to {away:.4g} m from the origin, where a cable of {config.length:.4g} m starts: "
            f"expected {LIMITS['target_distance']}. Move it nearer, or check its unit."
        )
    edges = np.diff(points, axis=0)
    angle = np.unwrap(np.arctan2(edges[:, 1], edges[:, 0]))
    length = length_through(points)
    shorter, longer = _coarse(len(points))
    if not -LENGTH_TOLERANCE - shorter <= length / config.length - 1 <= LENGTH_TOLERANCE + longer:
        raise ValueError(
            f"Target {name!r} is {length:.4g} m long, but the cable is {config.length:.4g} m long and does not "
            "stretch: scale the target, or use a model of a cable of that length."
        )
    longest = int(np.hypot(*edges.T).argmax())
    if np.hypot(*edges[longest]) > (1 + STRETCH) * config.length / (len(points) - 1):
        raise ValueError(
            f"Target {name!r} has keypoints {longest} and {longest + 1} {np.hypot(*edges[longest]):.4g} m apart, where "
            f"{config.length / (len(points) - 1):.4g} m of cable lie between neighbours: resample it uniformly in arc "
            "length."
        )
    if gripper_pose is None:
        # two points show no bend
        bend = np.diff(angle) if len(angle) > 1 else np.zeros(1)
        ends = angle[[0, -1]] + 0.5 * bend[[0, -1]] * [-1, 1]
        pose = np.concatenate([points[[0, -1]], ends[:, None]], axis=1)
    else:
        pose = real(gripper_pose, f"Target {name!r} has a gripper_pose of")
        if pose.shape != (2, 3) or not np.isfinite(pose).all():
            raise ValueError(f"Target {name!r} has a gripper_pose not finite or of shape {pose.shape}, not (2, 3).")
        gap = np.abs(pose[:, :2] - points[[0, -1]]).max()
        if gap > 0.01 * config.length:
            raise ValueError(
                f"Target {name!r}: the grippers are {gap:.4g} m away from the first and last keypoint that they hold."
            )
        off = np.arccos(np.cos(pose[:, 2] - angle[[0, -1]]))
        if not all(angle in LIMITS["target_angle"] for angle in pose[:, 2]) or off.max() > np.pi / 2:
            raise ValueError(
                f"Target {name!r} has gripper angles of {pose[0, 2]:.4g} and {pose[1, 2]:.4g}, but its ends lie in the "
                f"directions {angle[0]:.4g} and {angle[-1]:.4g} rad: expected radians, both along the cable from "
                "gripper 0 to gripper 1."
            )
    return Target(name, points, pose)


def load_target(path: str | pathlib.Path, config: Cable = Cable()) -> Target:
    """A target from a file: `.npz` or `.json` with "keypoints" (and "gripper_pose"), or `.csv` with rows `x,y`.

    Raises:
        ValueError: the file cannot be read as one of these, or its content does not fit the cable; see
            `target_from_keypoints`.
        FileNotFoundError: there is no such file.
    """
    path = pathlib.Path(path)
    read = _READERS.get(path.suffix.lower())
    if read is None:
        raise ValueError(
            f"{path} is neither U, S or Z nor a file of {', '.join(_READERS)}: save the target's "
            "keypoints in one of these."
        )
    try:
        fields = read(path)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path} could not be read as a target: {error}") from error
    return target_from_keypoints(path.stem, fields["keypoints"], config, fields.get("gripper_pose"))


def _read_json(path: pathlib.Path) -> dict[str, np.ndarray]:
    content = read_json(path)
    if not isinstance(content, dict) or "keypoints" not in content:
        raise ValueError('expected an object with the field "keypoints"')
    return {name: content[name] for name in ("keypoints", "gripper_pose") if name in content}


def _read_csv(path: pathlib.Path) -> dict[str, np.ndarray]:
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    if lines and lines[0].lstrip()[0] not in "+-.0123456789" and not lines[0].strip().lower().startswith("nan"):
        lines = lines[1:]  # a heading
    try:
        rows = [[float(cell) for cell in line.split(",")] for line in lines]
    except ValueError as error:
        raise ValueError(f"expected rows x,y in metres ({error})") from error
    return {"keypoints": np.array(rows)}


_READERS = {
    ".npz": lambda path: read_npz(path, ["keypoints"], ["gripper_pose"]),
    ".json": _read_json,
    ".csv": _read_csv,
}
