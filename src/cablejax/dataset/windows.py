"""Training windows from trajectories: a history, the commands that follow, and the true future.

`read_trajectories` loads into memory, and `draw_windows` draws and augments inside jit. A draw depends on its key
alone, so a training whose keys are counted, not carried along, sees after a kill what it would have seen without.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cablejax.dataset.drawing import cable_params
from cablejax.dataset.opening import open_store
from cablejax.dataset.schema import Block, DatasetConfig
from cablejax.dataset.store import Store
from cablejax.effects.physics import mean_resistance
from cablejax.types import History, Trajectory, cable_descriptor


def read_trajectories(
    source: str | os.PathLike[str] | Store, rows: Sequence[int] | np.ndarray | None = None
) -> Trajectory:
    """Trajectories of a store as NumPy arrays with a leading axis [M]; each shard is checked against its digests.

    Raises:
        ValueError: a shard is missing or damaged, or a row does not exist.
    """
    store = source if isinstance(source, Store) else open_store(source)
    indices = range(store.config.n_trajectories) if rows is None else np.asarray(rows)
    return trajectory_of(store.config, store.read(rows), indices)


def trajectory_of(config: DatasetConfig, block: Block, indices: Iterable[int]) -> Trajectory:
    """Some trajectories of a data set, by number, with the network's inputs that describe each cable."""
    return Trajectory(
        keypoints=block.keypoints,  # pyright: ignore[reportArgumentType]
        gripper_pose=block.gripper_pose,  # pyright: ignore[reportArgumentType]
        gripper_twist=block.gripper_twist,  # pyright: ignore[reportArgumentType]
        cable=known_of_cables(config, block.parameters, indices),  # pyright: ignore[reportArgumentType]
    )


def known_of_cables(
    config: DatasetConfig, parameters: Float[np.ndarray, "M 3"], indices: Iterable[int]
) -> Float[np.ndarray, "M 2"]:
    """The network's inputs that describe each cable, of the rows of `parameters` of these trajectories."""
    # with the effects that were simulated: a stiffer cable is known to be one
    cables = [cable_params(config, row, int(i)) for i, row in zip(indices, parameters, strict=True)]
    stiffness, friction = np.array([mean_resistance(cable) for cable in cables]).T
    return np.asarray(cable_descriptor(stiffness, friction), np.float32)


def concatenate(parts: Sequence[Trajectory]) -> Trajectory:
    """Trajectories [M, ...] one after the other, as NumPy arrays."""
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Window:
    """A history and what followed it.

    Attributes:
        history: the H samples up to t.
        twist: commands held from t on, shape [K, 2, 3].
        future: keypoints [m] at t + 1, ..., t + K, shape [K, N, 2].
    """

    history: History
    twist: Float[Array, "*batch K 2 3"]
    future: Float[Array, "*batch K N 2"]


def window_at(trajectory: Trajectory, start: Array, *, history: int, steps: int) -> Window:
    """The window whose newest history sample is sample `start` of an unbatched trajectory.

    Before the trajectory's beginning the cable rested, so missing history repeats sample 0.
    """
    past = jnp.maximum(start - history + 1 + jnp.arange(history), 0)
    return Window(
        history=History(
            keypoints=trajectory.keypoints[past],
            gripper_pose=trajectory.gripper_pose[start],
            cable=trajectory.cable,
        ),
        twist=jax.lax.dynamic_slice_in_dim(trajectory.gripper_twist, start, steps),
        future=jax.lax.dynamic_slice_in_dim(trajectory.keypoints, start + 1, steps),
    )


def draw_windows(
    key: PRNGKeyArray, data: Trajectory, *, batch: int, history: int, steps: int, flips: bool = True
) -> Window:
    """`batch` windows, uniform over trajectories [M, T, ...] and starts; with `flips` mirrored, reversed at random."""
    data = jax.tree.map(jnp.asarray, data)
    m, t = data.gripper_twist.shape[:2]
    key_episode, key_start, key_mirror, key_reverse = jax.random.split(key, 4)
    episode = jax.random.randint(key_episode, (batch,), 0, m)
    start = jax.random.randint(key_start, (batch,), 0, t - steps + 1)
    flip = jax.random.bernoulli(key_mirror, shape=(batch,))
    swap = jax.random.bernoulli(key_reverse, shape=(batch,))

    def one(episode, start, flip, swap):
        trajectory = jax.tree.map(lambda x: x[episode], data)
        window = window_at(trajectory, start, history=history, steps=steps)
        if not flips:
            return window
        window = jax.tree.map(lambda a, b: jnp.where(flip, a, b), mirrored(window), window)
        return jax.tree.map(lambda a, b: jnp.where(swap, a, b), reversed_ends(window), window)

    return jax.vmap(one)(episode, start, flip, swap)


def mirrored(window: Window) -> Window:
    """The same motion seen in a mirror, y -> -y: as likely as the original for a uniform straight cable."""
    past, pose = window.history, jnp.array([1.0, -1.0, -1.0], window.future.dtype)
    past = dataclasses.replace(past, keypoints=past.keypoints * pose[:2], gripper_pose=past.gripper_pose * pose)
    return Window(history=past, twist=window.twist * pose, future=window.future * pose[:2])


def reversed_ends(window: Window) -> Window:
    """The same motion with the cable counted from its other end: the tangent, and so theta, turns by pi."""
    past = window.history
    turned = past.gripper_pose[..., ::-1, :] + jnp.array([0.0, 0.0, jnp.pi], past.gripper_pose.dtype)
    past = dataclasses.replace(past, keypoints=past.keypoints[..., ::-1, :], gripper_pose=turned)
    return Window(history=past, twist=window.twist[..., ::-1, :], future=window.future[..., ::-1, :])
