"""Feasible sets: what a bounded solver must know of where it may go, and the simple sets.

A set is described twice. To find nearest points it is an affine image of something simple, `{y : lift(y) in Z}`, where
`Z` is a product of sets with a projection in closed form. To decide what is active and how it bends, `Z` is also
`{z : gauge(z) <= 0}` for a smooth vector function. From both, `quadratic.minimise_quadratic` finds the minimiser of any
convex quadratic over the set, exactly, and `projection.project` its nearest points with their derivatives.
"""

from __future__ import annotations

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cablejax.bounded.projection import project


class AbstractSet(eqx.Module):
    """A closed set of arrays; convex, unless its own documentation says otherwise.

    All methods take `y` in any shape with the right number of elements.
    """

    @abc.abstractmethod
    def lift(self, y: Float[Array, "..."]) -> Float[Array, " M"]:
        """Affine in `y`; of full column rank."""

    @abc.abstractmethod
    def clip(self, z: Float[Array, " M"]) -> Float[Array, " M"]:
        """The point of Z nearest to `z`."""

    @abc.abstractmethod
    def gauge(self, z: Float[Array, " M"]) -> Float[Array, " K"]:
        """Not positive exactly on Z; near a bound, the distance beyond it. Smooth; -inf where there is no bound."""

    def constraints(self, y: Float[Array, "..."]) -> Float[Array, " K"]:
        """`gauge(lift(y))`: the set as inequalities `constraints(y) <= 0`."""
        return self.gauge(self.lift(y))

    def violation(self, y: Float[Array, "..."]) -> Float[Array, ""]:
        """By how much the worst bound is broken; 0 inside."""
        return jnp.maximum(self.constraints(y).max(), 0.0)

    def project(self, y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """The nearest point of the set. Differentiable in `y` and in the set where the active bounds do not change."""
        return project(self, y)

    def restore(self, y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """`y` made feasible for certain, where it breaks bounds by rounding."""
        return y


class Box(AbstractSet):
    """`lower <= y <= upper`, element by element.

    Attributes:
        lower: least values, -inf where there is none; any shape that broadcasts against `y`.
        upper: greatest values, likewise.
    """

    lower: Float[Array, "..."]
    upper: Float[Array, "..."]

    def lift(self, y):
        return y.ravel()

    def clip(self, z):
        return jnp.clip(z, jnp.ravel(self.lower), jnp.ravel(self.upper))

    def gauge(self, z):
        return jnp.concatenate([jnp.ravel(self.lower) - z, z - jnp.ravel(self.upper)])

    def project(self, y):
        return self.clip(y.ravel()).reshape(y.shape)

    def restore(self, y):
        return self.project(y)


class Balls(AbstractSet):
    """Vectors of D elements one after the other, each in a Euclidean ball around 0.

    Attributes:
        radius: of every ball, or of each, shape [] or [V].
        size: D.
    """

    radius: Float[Array, "*V"]
    size: int = eqx.field(static=True)

    def lift(self, y):
        return y.ravel()

    def clip(self, z):
        return project_ball(z.reshape(-1, self.size), jnp.asarray(self.radius)[..., None]).ravel()

    def gauge(self, z):
        return ball_gauge(z.reshape(-1, self.size), self.radius)

    def project(self, y):
        return self.clip(y.ravel()).reshape(y.shape)

    def restore(self, y):
        return self.project(y)


class Intersection(AbstractSet):
    """What several sets have in common.

    Attributes:
        parts: the sets; what they have in common must not be empty.
    """

    parts: tuple[AbstractSet, ...]

    def lift(self, y):
        return jnp.concatenate([part.lift(y) for part in self.parts])

    def clip(self, z):
        return jnp.concatenate([part.clip(piece) for part, piece in self._pieces(z)])

    def gauge(self, z):
        return jnp.concatenate([part.gauge(piece) for part, piece in self._pieces(z)])

    def _pieces(self, z):
        # the simple sets lift to as many elements as y has
        return zip(self.parts, jnp.split(z, len(self.parts)), strict=True)


def project_ball(vectors: Float[Array, "*batch D"], radius: Float[Array, "..."] | float) -> Float[Array, "*batch D"]:
    """Nearest point of the Euclidean ball of `radius` around 0 to each last-axis vector.

    Differentiable in both arguments, at the centre too.
    """
    square = jnp.sum(vectors**2, axis=-1, keepdims=True)
    outside = square > radius**2
    return jnp.where(outside, vectors * (radius / jnp.sqrt(jnp.where(outside, square, 1.0))), vectors)


def ball_gauge(vectors: Float[Array, "*batch D"], radius: Float[Array, "..."] | float) -> Float[Array, "*batch"]:
    """`(|v|^2 - r^2) / 2 r`, smooth everywhere and `|v| - r` near the bound."""
    return (jnp.sum(vectors**2, axis=-1) - radius**2) / (2.0 * jnp.maximum(radius, 1e-9))
