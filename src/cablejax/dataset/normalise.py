"""Means and standard deviations of what a model sees and predicts, computed shard by shard."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cablejax.dataset.store import Store, open_store


@dataclasses.dataclass(frozen=True)
class Moments:
    """Moments of samples with F features, in float64.

    Attributes:
        count: number of samples.
        mean: shape [F].
        squares: sum of squared deviations from the mean, shape [F].
    """

    count: int
    mean: np.ndarray
    squares: np.ndarray

    @classmethod
    def of(cls, samples: np.ndarray) -> Moments:
        """Moments of samples [..., F]."""
        flat = samples.reshape(-1, samples.shape[-1]).astype(np.float64)
        mean = flat.mean(axis=0)
        return cls(len(flat), mean, ((flat - mean) ** 2).sum(axis=0))

    def merge(self, other: Moments) -> Moments:
        """Moments of both sets of samples (Chan, Golub and LeVeque 1983)."""
        count, shift = self.count + other.count, other.mean - self.mean
        return Moments(
            count,
            self.mean + shift * other.count / count,
            self.squares + other.squares + shift**2 * self.count * other.count / count,
        )

    @property
    def std(self) -> np.ndarray:
        """Standard deviation of each feature, shape [F]."""
        return np.sqrt(self.squares / self.count)

    @property
    def rms(self) -> float:
        """Root mean square over all features: one scale for a vector, whatever its direction."""
        return float(np.sqrt(np.mean(self.squares / self.count + self.mean**2)))


@dataclasses.dataclass(frozen=True)
class Statistics:
    """Moments of a data set's quantities.

    Attributes:
        displacement: X(t + 1) - X(t) of every keypoint [m], F = 2.
        acceleration: X(t + 1) - 2 X(t) + X(t - 1) of every keypoint [m], F = 2.
        neighbour: vector from each keypoint to the next [m], F = 2.
        twist: commands [m/s, rad/s], F = 3.
    """

    displacement: Moments
    acceleration: Moments
    neighbour: Moments
    twist: Moments

    def to_json(self) -> dict[str, Any]:
        """As a JSON object."""
        return {
            field.name: {"count": m.count, "mean": m.mean.tolist(), "squares": m.squares.tolist()}
            for field in dataclasses.fields(self)
            for m in (getattr(self, field.name),)
        }

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Statistics:
        """The inverse of `to_json`.

        Raises:
            ValueError: a quantity is missing.
        """
        missing = [field.name for field in dataclasses.fields(cls) if field.name not in value]
        if missing:
            raise ValueError(f"The statistics lack {', '.join(missing)}: compute them again with `statistics`.")
        return cls(
            **{
                field.name: Moments(
                    value[field.name]["count"],
                    np.array(value[field.name]["mean"]),
                    np.array(value[field.name]["squares"]),
                )
                for field in dataclasses.fields(cls)
            }
        )


def statistics(source: str | os.PathLike[str] | Store, rows: Sequence[int] | np.ndarray | None = None) -> Statistics:
    """Statistics over the given trajectories (all by default), holding one shard in memory at a time.

    Raises:
        ValueError: a shard is missing or damaged, a row does not exist, or the trajectories have a single step.
    """
    store = source if isinstance(source, Store) else open_store(source)
    if store.config.n_steps < 2:
        raise ValueError(f"{store.path} has 1 step per trajectory; statistics of accelerations need at least 2.")
    rows = np.arange(store.config.n_trajectories) if rows is None else np.asarray(rows, dtype=int)
    total: dict[str, Moments] = {}
    for shard in np.unique(rows // store.config.shard_size):
        block = store.read(rows[rows // store.config.shard_size == shard])
        here = {
            "displacement": np.diff(block.keypoints, axis=1),
            "acceleration": np.diff(block.keypoints, n=2, axis=1),
            "neighbour": np.diff(block.keypoints, axis=2),
            "twist": block.gripper_twist,
        }
        for name, samples in here.items():
            moments = Moments.of(samples)
            total[name] = total[name].merge(moments) if name in total else moments
    if not total:
        raise ValueError("No rows given: statistics need at least one trajectory.")
    return Statistics(**total)
