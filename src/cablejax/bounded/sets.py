"""Feasible sets: bounds on elements, lengths and affine functions, and their intersection."""

from __future__ import annotations

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from cablejax.bounded.quadratic import nearest_point
from cablejax.bounded.quadrics import Quadrics, ball_quadrics, joined, linear_quadrics


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
        """Whether a bound contradicts itself or another bound of its kind, or is NaN.

        Bounds of several kinds that contradict each other show as `outside(project(y), y)`.
        """

    def violation(self, y: Float[Array, "..."]) -> Float[Array, ""]:
        """By how much the worst bound is broken; 0 inside."""
        return jnp.maximum(self.constraints(y).max(), 0.0)

    def outside(self, y: Float[Array, "*shape"], start: Float[Array, "*shape"]) -> Bool[Array, ""]:
        """Whether `y`, the projection of `start`, breaks a bound by more than rounding of the bound's own size.

        It does where bounds of several kinds contradict each other: the set is empty.
        """
        quadrics = self.at(y).quadrics(y)
        return ~(self.violation(y) <= quadrics.rounding(y.ravel(), (start - y).ravel()))


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
        """The nearest point of the set, to rounding of the set's size; differentiable in `y` and in the set's arrays.

        In float32 it is a rough one for a `y` more than a million times that size away.
        """
        return nearest_point(self.quadrics(y), y.ravel()).reshape(y.shape)

    def restore(self, y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Moves a `y` that breaks bounds by rounding back inside; only where there is a closed form."""
        return y


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
        lower = jnp.broadcast_to(self.lower, y.shape).ravel().astype(y.dtype)
        upper = jnp.broadcast_to(self.upper, y.shape).ravel().astype(y.dtype)
        identity = np.eye(y.size)
        matrix = jnp.asarray(np.concatenate([-identity, identity]), y.dtype)
        return linear_quadrics(matrix, jnp.concatenate([lower, -upper]))

    def empty(self) -> Bool[Array, ""]:
        """Whether a lower bound lies above its upper bound."""
        return ~jnp.all(jnp.asarray(self.lower) <= jnp.asarray(self.upper))


class Balls(ConvexSet):
    """Each last-axis vector of `y` in a Euclidean ball around 0.

    Attributes:
        radius: of all balls, or of each; broadcasts against `y.shape[:-1]`.
    """

    radius: Float[Array, "..."]
    closed_form: ClassVar[bool] = True

    def project(self, y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Shortens every vector that is longer than its radius; in closed form."""
        return project_ball(y, jnp.asarray(self.radius, jnp.result_type(y, float))[..., None])

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


class Halfspaces(ConvexSet):
    """`a_k y <= b_k` for every k, with `y` flattened.

    Attributes:
        normals: a, shape [K, P]; one of 0 holds for all y, or for none where its bound is negative.
        bounds: b, inf where there is none, shape [K].
    """

    normals: Float[Array, "K P"]
    bounds: Float[Array, " K"]

    def quadrics(self, y: Float[Array, "..."]) -> Quadrics:
        """One linear function per plane, scaled to give the distance."""
        normals = self.normals.astype(y.dtype)
        squares = jnp.sum(normals**2, axis=-1)
        length = jnp.sqrt(jnp.where(squares > 0, squares, 1.0))
        return linear_quadrics(normals / length[:, None], -self.bounds.astype(y.dtype) / length)

    def empty(self) -> Bool[Array, ""]:
        """Whether a normal is not finite, or a bound is -inf or NaN."""
        return ~(jnp.isfinite(self.normals).all() & jnp.all(self.bounds > -jnp.inf))


class Intersection(ConvexSet):
    """The intersection of several convex sets.

    Attributes:
        members: the sets.
    """

    members: tuple[ConvexSet, ...]

    def __check_init__(self):
        if not self.members:
            raise ValueError("An Intersection needs at least one set.")

    def quadrics(self, y: Float[Array, "..."]) -> Quadrics:
        """The members' quadratics, one after the other."""
        return joined([member.quadrics(y) for member in self.members])

    def project(self, y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """The nearest point, as exact as `ConvexSet.project`; differentiable in `y` and in the sets' arrays.

        Where the nearest point of one member, in closed form, lies in all the others, it is that: the common case
        of few active bounds. Otherwise the interior-point method finds it.
        """
        return _nearest_in_all(self, y)

    def restore(self, y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Restores `y` to every member that has a closed form, one after the other."""
        for member in self.members:
            if member.closed_form:
                y = member.restore(y)
        return y

    def violation(self, y: Float[Array, "..."]) -> Float[Array, ""]:
        """The largest violation of any member."""
        return jnp.stack([member.violation(y) for member in self.members]).max()

    def empty(self) -> Bool[Array, ""]:
        """Whether a member is empty; members that contradict each other show as `violation(project(y)) > 0`."""
        return jnp.stack([member.empty() for member in self.members]).any()


@jax.jit
def _nearest_in_all(intersection: Intersection, y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """See `Intersection.project`; compiled once also where nothing around it is."""
    simple = [member.project(y) for member in intersection.members if member.closed_form]
    quadrics = intersection.quadrics(y)
    if not simple:
        return nearest_point(quadrics, y.ravel()).reshape(y.shape)
    candidates = jnp.stack(simple)
    rounding = 4 * jnp.finfo(y.dtype).eps * jnp.maximum(jnp.abs(candidates).max(), 1e-3)
    inside = jax.vmap(intersection.violation)(candidates) <= rounding
    return jax.lax.cond(
        inside.any(),
        lambda: candidates[jnp.argmax(inside)],
        lambda: nearest_point(quadrics, y.ravel()).reshape(y.shape),
    )
