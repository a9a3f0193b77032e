"""Bounds on the length of vectors."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from cablejax.bounded.quadrics import Quadrics, ball_quadrics
from cablejax.bounded.sets.base import ConvexSet


class Balls(ConvexSet):
    """Each last-axis vector of `y` in a Euclidean ball around 0.

    Attributes:
        radius: of all balls, or of each; broadcasts against `y.shape[:-1]`.
    """

    radius: Float[Array, "..."]
    closed_form: ClassVar[bool] = True

    def project(self, y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Shortens every vector that is longer than its radius; in closed form."""
        return project_ball(y, jnp.asarray(self.radius, y.dtype)[..., None])

    restore = project
    """The projection is in closed form, and so is this."""

    def quadrics(self, y: Float[Array, "..."]) -> Quadrics:
        """One quadratic per ball."""
        n_balls, width = int(np.prod(y.shape[:-1])), y.shape[-1]
        radius = jnp.broadcast_to(self.radius, y.shape[:-1]).ravel().astype(y.dtype)
        return ball_quadrics(
            jnp.eye(y.size, dtype=y.dtype).reshape(n_balls, width, y.size), jnp.zeros((n_balls, width), y.dtype), radius
        )

    def violation(self, y: Float[Array, "..."]) -> Float[Array, ""]:
        """By how much the worst vector is too long; 0 inside."""
        return jnp.maximum((jnp.linalg.norm(y, axis=-1) - self.radius).max(), 0.0)

    def empty(self) -> Bool[Array, ""]:
        """Whether a radius is negative or NaN."""
        return ~jnp.all(jnp.asarray(self.radius) >= 0)


def project_ball(vectors: Float[Array, "*batch D"], radius: Float[Array, "..."] | float) -> Float[Array, "*batch D"]:
    """Nearest point of the Euclidean ball of `radius` around 0 to each last-axis vector.

    Differentiable in both arguments, at the centre too.
    """
    square = jnp.sum(vectors**2, axis=-1, keepdims=True)
    outside = square > radius**2
    return jnp.where(outside, vectors * (radius / jnp.sqrt(jnp.where(outside, square, 1.0))), vectors)
