"""The intersection of several sets."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cablejax.bounded.quadratic import nearest_point
from cablejax.bounded.quadrics import Quadrics, joined
from cablejax.bounded.sets.base import ConvexSet


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
        """The nearest point, exact to rounding; differentiable in `y` and in the sets' arrays.

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
        """The worst of the members'."""
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
