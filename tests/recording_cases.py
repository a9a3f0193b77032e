"""Recordings of a made-up cable with markers, and where real ones are."""

import os
import pathlib

import numpy as np
import pytest

from cablejax.recordings.take import Take

DATA = pathlib.Path(os.environ.get("CABLEJAX_DATA", "absent"))

needs_deform = pytest.mark.skipif(
    not (DATA / "deform" / "DLO1.npz").is_file(), reason="$CABLEJAX_DATA is unset or has no deform/DLO1.npz"
)
needs_wires = pytest.mark.skipif(
    not (DATA / "hanging_wires" / "wires.npz").is_file(),
    reason="$CABLEJAX_DATA is unset or has no hanging_wires/wires.npz",
)

DT = 0.01
SPACING = np.array([0.03, 0.11, 0.1, 0.09, 0.1, 0.12, 0.1, 0.04])
"""Distances of the nine markers [m]: a pair on each gripper, and five between; from both ends they read differently."""


def swinging(samples: int = 200, seed: int = 0, phase: float = 0.0) -> np.ndarray:
    """Markers of a cable that hangs in a half circle and swings, with 0.3 mm of noise, shape [T, 9, 3]."""
    arc = np.concatenate([[0.0], np.cumsum(SPACING)])
    radius = arc[-1] / np.pi
    angle = arc / radius
    time = DT * np.arange(samples) + phase
    flat = np.stack([-radius * np.cos(angle), np.zeros_like(arc), -radius * np.sin(angle)], axis=-1)
    tilt = 0.5 * np.sin(3.0 * time)[:, None]
    points = np.stack(
        [
            np.broadcast_to(flat[:, 0], (samples, len(arc))),
            -np.sin(tilt) * flat[:, 2],
            np.cos(tilt) * flat[:, 2] + 1.0,
        ],
        axis=-1,
    )
    moved = np.stack([0.3 * np.sin(2 * time), 0.2 * np.cos(2 * time), 0.1 * np.sin(4 * time)], axis=-1)
    return points + moved[:, None] + np.random.default_rng(seed).normal(scale=3e-4, size=points.shape)


def arch(marks: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Keypoints of a cable that bends from each angle at gripper 0 to its opposite at gripper 1, shape [T, N, 2]."""
    fine = np.linspace(0.0, marks[-1], 2001)
    turn = angles[:, None] * np.cos(np.pi * fine / marks[-1])
    step = 0.5 * (fine[1] - fine[0])
    sums = (np.cumsum(part[:, 1:] + part[:, :-1], axis=1) * step for part in (np.cos(turn), np.sin(turn)))
    return np.stack([[np.interp(marks, fine, np.append(0.0, row)) for row in rows] for rows in sums], axis=-1)


def arch_take(marks: np.ndarray, angles: np.ndarray, name: str = "a", noise: float = 0.0) -> Take:
    """The same as a take with measured grippers; 10 Hz."""
    points = arch(marks, angles)
    tangent = np.stack([angles, -angles], axis=1)[..., None]
    pose = np.concatenate([points[:, [0, -1]], tangent], axis=2)
    seen = points + noise * np.random.default_rng(0).standard_normal(points.shape)
    return Take(name, 0.1 * np.arange(len(points)), seen, pose)


def take(points: np.ndarray, name: str = "a", pose: np.ndarray | None = None) -> Take:
    return Take(name, DT * np.arange(len(points)), points, pose)
