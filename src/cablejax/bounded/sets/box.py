"""Bounds on single elements."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from cablejax.bounded.quadrics import Quadrics
from cablejax.bounded.sets.base import ConvexSet


class Box(ConvexSet):
    """`lower <= y <= upper`, element by element.

    Attributes:
        lower: least values, -inf where there is none; broadcasts against `y`.
        upper: greatest values, inf where there is none; likewise.
    """

    lower: Float[Array, "..."]
    upper: Float[Array, "..."]
    closed_form: ClassVar[bool] = True

    def project(self, y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Clips every coordinate to its bounds; in closed form."""
        return jnp.clip(y, self.lower, self.upper)

    restore = project
    """The projection is in closed form, and so is this."""

    def quadrics(self, y: Float[Array, "..."]) -> Quadrics:
        """Two linear functions per coordinate."""
        size = y.size
        lower = jnp.broadcast_to(self.lower, y.shape).ravel().astype(y.dtype)
        upper = jnp.broadcast_to(self.upper, y.shape).ravel().astype(y.dtype)
        identity = np.eye(size)
        return Quadrics(
            matrix=jnp.asarray(np.concatenate([-identity, identity]), y.dtype),
            offset=jnp.zeros(2 * size, y.dtype),
            curvature=jnp.zeros(2 * size, y.dtype),
            slope=jnp.ones(2 * size, y.dtype),
            level=jnp.concatenate([lower, -upper]),
            groups=jnp.eye(2 * size, dtype=y.dtype),
        )

    def empty(self) -> Bool[Array, ""]:
        """Whether a lower bound lies above its upper bound."""
        return ~jnp.all(jnp.asarray(self.lower) <= jnp.asarray(self.upper))
