"""Bounds as smooth convex quadratics, in the one form that the interior-point method takes."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import jax.scipy.linalg
import numpy as np
from jaxtyping import Array, Bool, Float

# Of the size of the largest bound, in units of rounding: what the nearest point may break a small one by.
_SUMS = 16


class Quadrics(eqx.Module):
    """Functions of a point x, `c(x) = G (q z^2 / 2 + p z) + e` with `z = L x + l`, products of vectors by element.

    A ball `|A x + b| <= r` has q = 1 / r, e = -r / 2; an interval's end has q = 0, p = 1. All derivatives follow from
    products with the constant matrix L, so that a quadratic program over such bounds is dense linear algebra.

    Attributes:
        matrix: L, shape [M, P].
        offset: l, shape [M].
        curvature: q, not negative, shape [M].
        slope: p, shape [M].
        level: e, -inf for a bound that is not there, shape [K].
        groups: G, which rows of L belong to which function: of 0 and 1, shape [K, M].
    """

    matrix: Float[Array, "M P"]
    offset: Float[Array, " M"]
    curvature: Float[Array, " M"]
    slope: Float[Array, " M"]
    level: Float[Array, " K"]
    groups: Float[Array, "K M"]

    def lift(self, x: Float[Array, " P"]) -> Float[Array, " M"]:
        """Z at a point."""
        return self.matrix @ x + self.offset

    def of_lift(self, z: Float[Array, " M"]) -> Float[Array, " K"]:
        """C where the lifted point is z."""
        return self.groups @ (0.5 * self.curvature * z**2 + self.slope * z) + self.level

    def sizes(self, z: Float[Array, " M"]) -> Float[Array, " K"]:
        """Sizes of the terms of which c is the sum where the lifted point is z; 0 for the level of an absent bound."""
        terms = self.groups @ (0.5 * self.curvature * z**2 + jnp.abs(self.slope * z))
        return jnp.abs(self._levels) + terms

    @property
    def _levels(self) -> Float[Array, " K"]:
        return jnp.where(jnp.isfinite(self.level), self.level, 0.0)

    @property
    def has_size(self) -> Bool[Array, ""]:
        """Whether the set has a scale: false for a cone about 0, which looks alike from near and far."""
        return jnp.abs(self._levels).max(initial=0.0) > 0

    def lengths(self, x: Float[Array, " P"], linear: Float[Array, " P"]) -> Float[Array, " K"]:
        """Scales to judge at x whether c is small; `linear` is the gradient at 0 of a quadratic minimised there."""
        sizes = self.sizes(jnp.abs(self.matrix) @ jnp.abs(x) + jnp.abs(self.offset))
        # at a bound of 0 all terms may vanish: then rounding of the set's size counts, in a cone that of the step
        whole = jnp.where(jnp.isfinite(self.level), sizes, 0.0).max(initial=0.0)
        whole = jnp.where(self.has_size, whole, jnp.maximum(whole, jnp.linalg.norm(linear)))
        return sizes + jnp.finfo(x.dtype).eps ** 0.4 * whole + jnp.finfo(x.dtype).tiny

    def rounding(self, x: Float[Array, " P"], way: Float[Array, " P"]) -> Float[Array, ""]:
        """By how much rounding may break the worst bound at x, the nearest point to `x + way`."""
        eps, bound = jnp.finfo(x.dtype).eps, jnp.argmax(self.values(x))
        # a large bound that is kept says nothing about a small one that is broken, but for the rounding of the sums
        whole = (jnp.abs(self.matrix) @ jnp.abs(x) + jnp.abs(self.offset)).max() + jnp.abs(self._levels).max()
        whole = jnp.where(self.has_size, whole, jnp.maximum(whole, jnp.linalg.norm(way)))
        return eps**0.5 * (self.sizes(self.lift(x))[bound] + jnp.abs(x).max()) + _SUMS * eps * whole

    def values(self, x: Float[Array, " P"]) -> Float[Array, " K"]:
        """C at a point."""
        return self.of_lift(self.lift(x))

    def jacobian(self, z: Float[Array, " M"]) -> Float[Array, "K P"]:
        """dc/dx where the lifted point is z."""
        return self.groups @ ((self.curvature * z + self.slope)[:, None] * self.matrix)

    def bend(self, multipliers: Float[Array, " K"]) -> Float[Array, "P P"]:
        """`sum_k lambda_k d2 c_k / dx2`."""
        return self.matrix.T @ ((self.curvature * (multipliers @ self.groups))[:, None] * self.matrix)


def linear_quadrics(matrix: Float[Array, "K P"], level: Float[Array, " K"]) -> Quadrics:
    """`A x + e`."""
    size, dtype = len(level), matrix.dtype
    zeros, ones = jnp.zeros(size, dtype), jnp.ones(size, dtype)
    return Quadrics(matrix, offset=zeros, curvature=zeros, slope=ones, level=level, groups=jnp.eye(size, dtype=dtype))


def ball_quadrics(matrix: Float[Array, "K D P"], offset: Float[Array, "K D"], radius: Float[Array, " K"]) -> Quadrics:
    """`(|A_k x + b_k|^2 - r_k^2) / (2 r_k)`; a radius below rounding counts as that."""
    n_balls, width, size = matrix.shape
    dtype = matrix.dtype
    radius = jnp.maximum(radius, jnp.finfo(dtype).eps)
    return Quadrics(
        matrix=matrix.reshape(-1, size),
        offset=offset.ravel(),
        curvature=jnp.repeat(1.0 / radius, width),
        slope=jnp.zeros(n_balls * width, dtype),
        level=-0.5 * radius,
        groups=jnp.asarray(np.kron(np.eye(n_balls), np.ones(width)), dtype),
    )


def joined(parts: Sequence[Quadrics]) -> Quadrics:
    """The functions of several `Quadrics`, one after the other."""
    return Quadrics(
        matrix=jnp.concatenate([part.matrix for part in parts]),
        offset=jnp.concatenate([part.offset for part in parts]),
        curvature=jnp.concatenate([part.curvature for part in parts]),
        slope=jnp.concatenate([part.slope for part in parts]),
        level=jnp.concatenate([part.level for part in parts]),
        groups=jax.scipy.linalg.block_diag(*[part.groups for part in parts]),
    )
