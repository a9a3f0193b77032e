"""From trajectories to what a one-step model is trained on: a history, the commands that follow, and what happened.

`read_trajectories` loads into memory, `split` sets rows aside, `draw_windows` picks (row, time) pairs from a key, and
`windows` gathers them inside jit.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from cablejax.dataset.store import Store, open_store
from cablejax.types import History, Trajectory

HISTORY = 6
"""Samples in a history, H = m + 1, in Wang et al., RA-L 2022."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class WindowBatch:
    """Training windows.

    Attributes:
        history: the samples t - m, ..., t, keypoints [B, H, N, 2] and gripper_pose [B, Q, 3].
        twist: commands from t on [m/s, rad/s], shape [B, K, Q, 3].
        keypoints: what followed, the samples t + 1, ..., t + K [m], shape [B, K, N, 2].
    """

    history: History
    twist: Float[Array, "*batch K Q 3"]
    keypoints: Float[Array, "*batch K N 2"]


def read_trajectories(
    source: str | os.PathLike[str] | Store, rows: Sequence[int] | np.ndarray | None = None
) -> Trajectory:
    """Trajectories of a store as NumPy arrays with a leading axis [M]; each shard is checked against its digests.

    Raises:
        ValueError: a shard is missing or damaged, or a row does not exist.
    """
    store = source if isinstance(source, Store) else open_store(source)
    block = store.read(rows)
    return Trajectory(
        keypoints=block.keypoints,  # pyright: ignore[reportArgumentType]
        gripper_pose=block.gripper_pose,  # pyright: ignore[reportArgumentType]
        gripper_twist=block.gripper_twist,  # pyright: ignore[reportArgumentType]
    )


def split(n_trajectories: int, held_out: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Rows to train on and rows held out: the last ones, at least one of each.

    Raises:
        ValueError: `held_out` is not a fraction in (0, 1), or there are fewer than two trajectories.
    """
    if not 0 < held_out < 1:
        raise ValueError(f"held_out is {held_out}, expected a fraction between 0 and 1.")
    if n_trajectories < 2:
        raise ValueError(f"{n_trajectories} trajectories cannot be split: generate at least 2.")
    first = n_trajectories - min(max(1, round(held_out * n_trajectories)), n_trajectories - 1)
    return np.arange(first), np.arange(first, n_trajectories)


def draw_windows(
    key: PRNGKeyArray, trajectory: Trajectory, batch: int, *, horizon: int = 1
) -> tuple[Int[Array, " B"], Int[Array, " B"]]:
    """Uniform (row, time) pairs whose next `horizon` samples exist.

    Raises:
        ValueError: the trajectories are shorter than the horizon.
    """
    rows, steps = trajectory.gripper_twist.shape[:2]
    if not 1 <= horizon <= steps:
        raise ValueError(f"The horizon is {horizon}, expected 1 to {steps}, the commands in a trajectory.")
    row_key, time_key = jax.random.split(key)
    return (
        jax.random.randint(row_key, (batch,), 0, rows),
        jax.random.randint(time_key, (batch,), 0, steps - horizon + 1),
    )


def windows(
    trajectory: Trajectory,
    row: Int[Array, " B"],
    time: Int[Array, " B"],
    *,
    horizon: int = 1,
    history: int = HISTORY,
) -> WindowBatch:
    """Gathers windows from trajectories [M, ...] in memory. Pure; to be jitted with the arrays on the device.

    Before the first sample the cable was at rest: those places of a history repeat sample 0.

    Args:
        trajectory: with leading axis [M].
        row: trajectory of each window.
        time: index t of each history's newest sample, at most T - horizon.
        horizon: commands and samples after t.
        history: samples up to and including t.
    """
    past = jnp.maximum(time[:, None] + jnp.arange(1 - history, 1), 0)
    ahead = time[:, None] + jnp.arange(horizon)
    keypoints = jnp.asarray(trajectory.keypoints)
    return WindowBatch(
        history=History(
            keypoints=keypoints[row[:, None], past], gripper_pose=jnp.asarray(trajectory.gripper_pose)[row, time]
        ),
        twist=jnp.asarray(trajectory.gripper_twist)[row[:, None], ahead],
        keypoints=keypoints[row[:, None], ahead + 1],
    )
