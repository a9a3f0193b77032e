"""Clouds of cables whose true shape is an exact elastica."""

import dataclasses

import numpy as np

from cablejax.perceive import RegistrationConfig, TrackerConfig
from cablejax.simulate.elastica import solve_elastica

REGISTRATION = RegistrationConfig()
CAPACITY = 800
TRACKER = TrackerConfig(registration=REGISTRATION, capacity=CAPACITY)

ARCH = np.array([[-0.3, 0.05, 1.2], [0.35, -0.02, -0.7]])
S_SHAPE = np.array([[-0.3, 0.0, 1.3], [0.3, 0.1, 1.2]])


@dataclasses.dataclass(frozen=True)
class Shape:
    """A cable: its points uniform in arc length, unit tangents, and what is looked for."""

    pose: np.ndarray
    points: np.ndarray
    angle: np.ndarray

    @property
    def keypoints(self) -> np.ndarray:
        return self.points[:: (len(self.points) - 1) // 12]


def shape(pose, *, length: float = 1.0, guess: Shape | None = None) -> Shape:
    """The elastica between two grippers."""
    solution = solve_elastica(np.asarray(pose), length, guess=None if guess is None else guess.points, n_samples=241)
    return Shape(np.asarray(pose), solution.position, solution.angle)


def cloud(
    cable: Shape,
    seed: int,
    *,
    n: int = CAPACITY,
    noise: float = 2e-3,
    hidden: tuple[float, float] = (0.0, 0.0),
    outliers: float = 0.0,
) -> np.ndarray:
    """Points on the cable but for a hidden stretch (from, to, in lengths), with noise; a part of them anywhere."""
    random = np.random.default_rng(seed)
    first, last = hidden
    s = random.random(n) * (1.0 - (last - first))
    s = np.where(s < first, s, s + (last - first))
    grid = np.linspace(0.0, 1.0, len(cable.points))
    points = np.stack([np.interp(s, grid, cable.points[:, axis]) for axis in range(2)], axis=1)
    points += noise * random.standard_normal(points.shape)
    low, high = cable.points.min(axis=0) - 0.1, cable.points.max(axis=0) + 0.1
    stray = random.random(n) < outliers
    points[stray] = low + (high - low) * random.random((int(stray.sum()), 2))
    return points


def start_angles(cable: Shape) -> np.ndarray:
    """Joint angles of the chain that is fitted, along the true shape."""
    matrices = REGISTRATION.matrices
    vertices = np.concatenate([[0.0], np.cumsum(matrices.lengths)])
    grid = np.linspace(0.0, 1.0, len(cable.points))
    corners = np.stack([np.interp(vertices, grid, cable.points[:, axis]) for axis in range(2)], axis=1)
    steps = np.diff(corners, axis=0)
    tangent = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    tangent += 2 * np.pi * np.round((cable.pose[0, 2] - tangent[0]) / (2 * np.pi))
    tangent[[0, -1]] = cable.pose[:, 2]
    return np.diff(tangent)


def moved(pose: np.ndarray, *, shift: float = 0.01, turn: float = 0.05) -> np.ndarray:
    """Grippers that have come closer and turned a little."""
    return pose + np.array([[shift, 0.5 * shift, turn], [-shift, 0.0, turn]])


def mean_error(keypoints, cable: Shape) -> float:
    """Mean distance of the keypoints to the true ones [m]."""
    return float(np.linalg.norm(np.asarray(keypoints) - cable.keypoints, axis=1).mean())
