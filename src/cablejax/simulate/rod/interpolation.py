"""Interpolation in time, between samples of the clamps' motion, and along the rod, between nodes and to joints."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def between_samples(leaf: Float[Array, "4 *shape"], w: Float[Array, ""]) -> Float[Array, "*shape"]:
    """Cubic through four samples at `w` between the middle two: a broken line of poses would shake the cable."""
    weight = jnp.stack(
        [-w * (1 - w) * (2 - w) / 6, (1 - w * w) * (2 - w) / 2, w * (1 + w) * (2 - w) / 2, -w * (1 - w * w) / 6]
    )
    return jnp.tensordot(weight, leaf, axes=1)


def along_joints(values: Float[Array | np.ndarray, "J"], count: int) -> Float[Array, "count"]:
    """Linear interpolation of evenly spaced values to the joints."""
    if values.shape[0] == 1:
        return jnp.broadcast_to(values, (count,))
    return jnp.interp(jnp.linspace(0.0, 1.0, count), jnp.linspace(0.0, 1.0, values.shape[0]), values)


def cubic_weights(s: Float[Array | np.ndarray, "N"], h: Float[Array | np.ndarray, ""], n: int) -> Float[Array, "N n"]:
    """Cubic interpolation from the nodes, at arc lengths (j - 1/2) h, to arc lengths `s` [m]."""
    begin = jnp.clip(jnp.floor(s / h + 0.5).astype(int) - 1, 0, n - 4)
    u = s / h + 0.5 - begin
    weight = jnp.stack(
        [
            -(u - 1) * (u - 2) * (u - 3) / 6,
            u * (u - 2) * (u - 3) / 2,
            -u * (u - 1) * (u - 3) / 2,
            u * (u - 1) * (u - 2) / 6,
        ],
        axis=1,
    )
    rows = jnp.arange(s.shape[0])[:, None]
    return jnp.zeros((s.shape[0], n)).at[rows, begin[:, None] + jnp.arange(4)].set(weight)
