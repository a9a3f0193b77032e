"""Kinematics of the chain by prefix sums, in place of `mjx.kinematics`.

`mjx.kinematics` walks down a tree level by level. A cable is the deepest tree there is: at 33 links this is 85 % of the
compile time and most of the run time of a step. In a chain, orientations are prefix products and positions prefix sums,
which take a logarithmic number of vector operations.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cablejax.arrays import quaternion_product
from cablejax.cable import Discretisation
from cablejax.simulate.composite import link_lengths, node_offsets
from cablejax.simulate.mjx import mjx


def chain_kinematics(config: Discretisation, data: mjx.Data) -> mjx.Data:
    """Fills the same fields of `data` as `mjx.kinematics` does, for the chain of `composite.build_chain`.

    Differentiable in `data.qpos`.
    """
    lengths = jnp.asarray(link_lengths(config), data.qpos.dtype)
    offsets = jnp.asarray(node_offsets(config), data.qpos.dtype)
    frames = planar_frames if config.dimension == 2 else spatial_frames
    qpos, quaternion, rotation = frames(data.qpos)
    root = jnp.zeros(3, qpos.dtype).at[: config.dimension].set(qpos[: config.dimension])
    direction = rotation[:, :, 0]
    reach = jnp.cumsum(lengths[:-1, None] * direction[:-1], axis=0)
    origin = root + jnp.concatenate([jnp.zeros((1, 3), qpos.dtype), reach])

    def with_world(world, links):
        return jnp.concatenate([jnp.asarray(world, qpos.dtype)[None], links])

    if config.dimension == 2:
        # the root's two slides and its hinge, then one hinge a link; only the slides have another axis than z
        anchor = jnp.concatenate([origin[:1], origin[:1], origin])
        axis = jnp.concatenate(
            [jnp.eye(3, dtype=qpos.dtype), jnp.tile(jnp.eye(3, dtype=qpos.dtype)[2:], (len(origin) - 1, 1))]
        )
    else:
        anchor, axis = origin, jnp.tile(jnp.eye(3, dtype=qpos.dtype)[2:], (len(origin), 1))
    return data.replace(
        qpos=qpos,
        xanchor=anchor,
        xaxis=axis,
        xpos=with_world(jnp.zeros(3), origin),
        xquat=with_world(jnp.array([1.0, 0.0, 0.0, 0.0]), quaternion),
        xmat=with_world(jnp.eye(3), rotation),
        xipos=with_world(jnp.zeros(3), origin + offsets[:, None] * direction),
        ximat=with_world(jnp.eye(3), rotation),
    )


def planar_frames(qpos: Float[Array, "nq"]):
    """`qpos` unchanged, quaternions [n, 4] and rotation matrices [n, 3, 3] of the links of a planar chain."""
    theta = jnp.cumsum(qpos[2:])
    zero, one = jnp.zeros_like(theta), jnp.ones_like(theta)
    cosine, sine = jnp.cos(theta), jnp.sin(theta)
    quaternion = jnp.stack([jnp.cos(theta / 2), zero, zero, jnp.sin(theta / 2)], axis=1)
    rows = [[cosine, -sine, zero], [sine, cosine, zero], [zero, zero, one]]
    return qpos, quaternion, jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1)


def spatial_frames(qpos: Float[Array, "nq"]):
    """As `planar_frames` for a chain of ball joints; the quaternions in `qpos` are normalised."""
    local = qpos[3:].reshape(-1, 4)
    local = local / jnp.linalg.norm(local, axis=1, keepdims=True)
    quaternion = jax.lax.associative_scan(quaternion_product, local)
    w, x, y, z = quaternion.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    rotation = jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1)
    return jnp.concatenate([qpos[:3], local.reshape(-1)]), quaternion, rotation
