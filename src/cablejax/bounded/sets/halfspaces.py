"""Bounds on affine functions."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cablejax.bounded.quadrics import Quadrics
from cablejax.bounded.sets.base import ConvexSet


class Halfspaces(ConvexSet):
    """`a_k y <= b_k` for every k, with `y` flattened.

    Attributes:
        normals: a, none of them 0, shape [K, P].
        bounds: b, inf where there is none, shape [K].
    """

    normals: Float[Array, "K P"]
    bounds: Float[Array, " K"]

    def quadrics(self, y: Float[Array, "..."]) -> Quadrics:
        """One linear function per plane, scaled to give the distance."""
        normals = self.normals.astype(y.dtype)
        length = jnp.linalg.norm(normals, axis=-1)
        n_planes = len(length)
        return Quadrics(
            matrix=normals / length[:, None],
            offset=jnp.zeros(n_planes, y.dtype),
            curvature=jnp.zeros(n_planes, y.dtype),
            slope=jnp.ones(n_planes, y.dtype),
            level=-self.bounds.astype(y.dtype) / length,
            groups=jnp.eye(n_planes, dtype=y.dtype),
        )

    def empty(self) -> Bool[Array, ""]:
        """Whether a normal is not finite, or a bound is -inf or NaN."""
        return ~(jnp.isfinite(self.normals).all() & jnp.all(self.bounds > -jnp.inf))
