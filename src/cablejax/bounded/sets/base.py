"""Base classes of feasible sets: bounds, projection, and quadratic form."""

from __future__ import annotations

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cablejax.bounded.quadratic import nearest_point
from cablejax.bounded.quadrics import Quadrics


class AbstractSet(eqx.Module):
    """A closed set of arrays, convex or not.

    A solver only ever moves within `at(y)`, a convex part of the set around where it is. For a convex set that is the
    set itself; another must give, for a feasible y, a convex subset that contains y and has the same active bounds
    there. Then a point that is stationary for its own `at(y)` is so for the whole set.
    """

    @abc.abstractmethod
    def at(self, y: Float[Array, "..."]) -> ConvexSet:
        """A convex part of the set that contains the feasible `y`."""

    @abc.abstractmethod
    def project(self, y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """The nearest point of the set, or of a convex part of it near `y`; a point of the set stays as it is."""

    @abc.abstractmethod
    def constraints(self, y: Float[Array, "..."]) -> Float[Array, " K"]:
        """Smooth functions that are all <= 0 exactly on the set; near a bound about the distance beyond it."""

    @abc.abstractmethod
    def empty(self) -> Bool[Array, ""]:
        """Whether some bound contradicts itself or another bound of its kind, or is not a number.

        Bounds of several kinds that contradict each other show as `violation(project(y)) > 0`.
        """

    def violation(self, y: Float[Array, "..."]) -> Float[Array, ""]:
        """By how much the worst bound is broken; 0 inside."""
        return jnp.maximum(self.constraints(y).max(), 0.0)


class ConvexSet(AbstractSet):
    """A convex set, given by affine maps of `y` into intervals and Euclidean balls.

    Attributes:
        closed_form: whether `project` and `restore` cost no more than a few operations per element.
    """

    closed_form: ClassVar[bool] = False

    @abc.abstractmethod
    def quadrics(self, y: Float[Array, "..."]) -> Quadrics:
        """The bounds as smooth convex quadratics of the flattened point; of `y` only shape and type are used."""

    def at(self, y: Float[Array, "..."]) -> ConvexSet:
        """The set itself."""
        del y
        return self

    def constraints(self, y: Float[Array, "..."]) -> Float[Array, " K"]:
        """The values of `quadrics`; -inf where there is no bound."""
        return self.quadrics(y).values(y.ravel())

    def project(self, y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """The nearest point of the set, exact to rounding; differentiable in `y` and in the set's arrays."""
        return nearest_point(self.quadrics(y), y.ravel()).reshape(y.shape)

    def restore(self, y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """A `y` that breaks bounds by rounding, without that; only where there is a closed form for it."""
        return y
