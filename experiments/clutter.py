"""Synthetic clouds of a known curve: points on it, noise, a hidden stretch, and outliers."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

BORDER = 0.1
"""Strays are spread over the curve's bounding box and this much around it [m]."""


@dataclasses.dataclass(frozen=True)
class Clutter:
    """Disturbances between a cable and its cloud.

    Attributes:
        points: in the cloud.
        noise: standard deviation of every coordinate [m].
        hidden: part of the cable that is hidden, in one stretch.
        outliers: part of the points that are anywhere.
    """

    points: int = 2000
    noise: float = 0.002
    hidden: float = 0.0
    outliers: float = 0.0

    def __post_init__(self):
        if self.points < 1 or not self.noise >= 0:
            raise ValueError(f"Clutter has {self.points} points and noise {self.noise}, expected >= 1 and >= 0 m.")
        if not (0 <= self.hidden < 1 and 0 <= self.outliers <= 1):
            raise ValueError(
                f"Clutter hides {self.hidden} and has outliers {self.outliers}, expected parts of 1, not all hidden."
            )


def scatter(
    curve: Float[np.ndarray, "P 2"], clutter: Clutter, random: np.random.Generator, *, where: float = 0.5
) -> Float[np.ndarray, "S 2"]:
    """A cloud of a curve.

    Args:
        curve: points uniform in arc length [m].
        clutter: what stands between.
        random: source of all randomness.
        where: place of the hidden stretch, from 0, at the beginning of the cable, to 1, at its end.
    """
    first = where * (1.0 - clutter.hidden)
    s = random.random(clutter.points) * (1.0 - clutter.hidden)
    s = np.where(s < first, s, s + clutter.hidden)
    grid = np.linspace(0.0, 1.0, len(curve))
    points = np.stack([np.interp(s, grid, curve[:, axis]) for axis in range(2)], axis=1)
    points += clutter.noise * random.standard_normal(points.shape)
    low, high = curve.min(axis=0) - BORDER, curve.max(axis=0) + BORDER
    stray = random.random(clutter.points) < clutter.outliers
    points[stray] = low + (high - low) * random.random((int(stray.sum()), 2))
    return points
