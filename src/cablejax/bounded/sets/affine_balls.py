"""Bounds on the length of affine functions: distances that grow along a plan, changes from step to step."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cablejax.bounded.quadrics import Quadrics, ball_quadrics
from cablejax.bounded.sets.base import ConvexSet


class AffineBalls(ConvexSet):
    """`|A_k y + b_k| <= r_k` for every k, with `y` flattened.

    Attributes:
        matrix: A, shape [K, D, P].
        offset: b, shape [K, D].
        radius: r, shape [K].
    """

    matrix: Float[Array, "K D P"]
    offset: Float[Array, "K D"]
    radius: Float[Array, " K"]

    def quadrics(self, y: Float[Array, "..."]) -> Quadrics:
        """One quadratic per ball."""
        return ball_quadrics(
            self.matrix.astype(y.dtype), self.offset.astype(y.dtype), jnp.asarray(self.radius, y.dtype)
        )

    def violation(self, y: Float[Array, "..."]) -> Float[Array, ""]:
        """By how much the worst length is exceeded; 0 inside."""
        length = jnp.linalg.norm(self.matrix @ y.ravel() + self.offset, axis=-1)
        return jnp.maximum((length - self.radius).max(), 0.0)

    def empty(self) -> Bool[Array, ""]:
        """Whether a radius is negative, or an array is not finite."""
        return ~(jnp.all(self.radius >= 0) & jnp.isfinite(self.matrix).all() & jnp.isfinite(self.offset).all())
