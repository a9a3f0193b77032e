"""Grippers of a cable in space: their frames, and the nodes of the rod that move with them."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cablejax.poses import rotated, smallest_rotation
from cablejax.simulate.rod.material import unit
from cablejax.simulate.rod.physics import RodPhysics

_NO_DIRECTION = 0.05
"""Length of the mean of unit vectors below which they have none in common."""


def frames_along(tangent: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 3 3"]:
    """Gripper frames whose roll is not observed: the smallest rotation from the mean direction of all tangents.

    Rows are the axes in the world. The grippers of a recording keep their roll about as they were mounted; what they do
    turn about their own axis is not seen.
    """
    every = tangent.reshape(-1, 3)
    mean = every.mean(axis=0)
    if np.linalg.norm(mean) < _NO_DIRECTION:  # set-ups that were turned by half a turn
        mean = every[0]
    mean = mean / np.linalg.norm(mean)
    side = np.cross(mean, np.eye(3)[np.argmin(np.abs(mean))])
    second = rotated(smallest_rotation(np.broadcast_to(mean, tangent.shape), tangent), side / np.linalg.norm(side))
    return np.stack([tangent, second, np.cross(tangent, second)], axis=-2)


def held_nodes(
    physics: RodPhysics,
    position: Float[Array, "T 2 3"],
    frames: Float[Array, "T 2 3 3"],
    h: Float[Array | np.ndarray, ""],
) -> tuple[Float[Array, "T 4 3"], Float[Array, "T 2 3"]]:
    """The four held nodes [m], and the directors of the two held edges: unit vectors across them.

    Args:
        physics: how the cable sits in the grippers.
        position: of the grippers [m].
        frames: of the grippers, rows are axes in the world.
        h: length of an edge [m].
    """
    slope = physics.clamp_rotation
    along = unit(frames[:, :, 0] + slope[:, 1:] * frames[:, :, 1] - slope[:, :1] * frames[:, :, 2])
    half = 0.5 * h * along
    held = jnp.stack(
        [
            position[:, 0] - half[:, 0],
            position[:, 0] + half[:, 0],
            position[:, 1] - half[:, 1],
            position[:, 1] + half[:, 1],
        ],
        axis=1,
    )
    side = frames[:, :, 1]
    return held, unit(side - along * jnp.sum(side * along, axis=2, keepdims=True))
