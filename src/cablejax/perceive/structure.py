"""Structure terms of the registration: coherent motion and local linear embedding.

Tang and Tomizuka, "Track deformable objects from point clouds with structure preserved registration", IJRR 2018, add
two terms to the mixture's likelihood. The displacement since the last frame shall be smooth, as the norm of a coherent
displacement field; and every point shall keep its place relative to its neighbours, as in local linear embedding.
Neighbours here are neighbours along the cable, so that two parts of it may cross without being tied to each other.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

NEIGHBOURS = 4
"""Neighbours that each point is expressed by: two on either side, or the nearest four at the ends. In the plane three
express any point; the fourth makes it a fit."""

STRIDE = 3
"""Links from one neighbour to the next: they are about as far apart as keypoints are. Direct neighbours would only feel
wiggles from link to link."""

RIDGE = 1e-5
"""Ridge of the local fits, relative to the trace of their Gram matrices."""


def embedding_stiffness(centre: Float[Array, "n 2"]) -> Float[Array, "n n"]:
    """`(I - W)' (I - W)`, with the weights W that best express each point by its neighbours and sum to one.

    The energy `x' E x` is zero wherever the neighbourhoods keep their shape, up to a local affine map and the ridge.
    Differentiable in `centre`.
    """
    n = centre.shape[0]
    # int32 whether or not JAX is in 64-bit mode
    index = np.array([_neighbours(k, n) for k in range(n)], dtype=np.int32)
    arms = centre[index] - centre[:, None]
    gram = arms @ jnp.swapaxes(arms, -1, -2)
    trace = jnp.trace(gram, axis1=-2, axis2=-1)[:, None, None]
    gram = gram + RIDGE * trace * jnp.eye(NEIGHBOURS, dtype=centre.dtype)
    weight = _solve(gram / trace)
    weight = weight / jnp.sum(weight, axis=-1, keepdims=True)
    difference = jnp.eye(n, dtype=centre.dtype).at[np.arange(n, dtype=np.int32)[:, None], index].add(-weight)
    return difference.T @ difference


def _solve(gram: Float[Array, "n K K"]) -> Float[Array, "n K"]:
    """Solves `gram w = 1` for all points at once."""
    return jnp.linalg.solve(gram, jnp.ones((*gram.shape[:-1], 1), gram.dtype))[..., 0]


def _neighbours(k: int, n: int) -> list[int]:
    reachable = [j for j in range(k % STRIDE, n, STRIDE) if j != k]
    return sorted(sorted(reachable, key=lambda j: abs(j - k))[:NEIGHBOURS])
