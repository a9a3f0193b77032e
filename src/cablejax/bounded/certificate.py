"""First-order optimality (KKT) check of a point, from the point and its gradient alone."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Scalar

from cablejax.bounded.sets import AbstractSet

# What counts as active by default: within this of the bound, or within so many units of rounding of the point.
_NEAR, _NEAR_ULP = 1e-6, 64


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Certificate:
    """The first-order conditions at a point y with gradient g over constraints c <= 0; at a minimum, all zero.

    Attributes:
        stationarity: largest element of `g + N' lambda`, N the constraints' derivatives, shape [].
        feasibility: by how much the worst bound is broken, shape [].
        complementarity: largest product of a multiplier and its constraint's slack, shape [].
        multipliers: lambda, not negative by construction; that of a nearly active bound is near zero where the bound is
            touched without holding anything back, shape [K].
    """

    stationarity: Float[Array, "*batch"]
    feasibility: Float[Array, "*batch"]
    complementarity: Float[Array, "*batch"]
    multipliers: Float[Array, "*batch K"]

    @property
    def residual(self) -> Float[Array, "*batch"]:
        """The worst of stationarity, feasibility and complementarity."""
        return jnp.maximum(jnp.maximum(self.stationarity, self.feasibility), self.complementarity)


def projected_gradient_size(feasible: AbstractSet, y: Float[Array, "*shape"], gradient: Float[Array, "..."]) -> Scalar:
    """Largest element of `P(y - g) - y`, which is zero at a minimum and nowhere else, for a gradient of any shape."""
    return jnp.abs(feasible.project(y - gradient.reshape(y.shape)) - y).max()


def certify(
    gradient: Float[Array, "*shape"], feasible: AbstractSet, y: Float[Array, "*shape"], near: float | None = None
) -> Certificate:
    """The first-order conditions of a minimum over `feasible` at `y`, where the function has this gradient.

    The multipliers are the non-negative ones with the least `|g + N' lambda|` over the bounds within `near` of being
    active. No solver is involved but that of this least squares problem.

    Args:
        gradient: of the function at `y`, in any shape.
        feasible: the set.
        y: the point.
        near: in the units of y; None = 1e-6, or what rounding leaves of a `y` far from 0 or in float32.
    """
    flat, slope = y.ravel(), gradient.ravel()
    values, pull = jax.vjp(lambda flat: feasible.constraints(flat.reshape(y.shape)), flat)
    normals = jax.vmap(lambda e: pull(e)[0])(jnp.eye(values.size, dtype=values.dtype))
    rounding = _NEAR_ULP * jnp.finfo(y.dtype).eps * jnp.maximum(jnp.abs(y).max(), 1.0)
    active = values > -(jnp.maximum(_NEAR, rounding) if near is None else near)
    multipliers = _nonnegative_least_squares(jnp.where(active[:, None], normals, 0.0), slope, active)
    slack = jnp.where(active, values, 0.0)
    return Certificate(
        stationarity=jnp.abs(slope + multipliers @ normals).max(),
        feasibility=feasible.violation(y),
        complementarity=jnp.abs(multipliers * slack).max(),
        multipliers=multipliers,
    )


def _nonnegative_least_squares(normals: Float[Array, "K P"], gradient: Float[Array, " P"], active):
    """The lambda >= 0 with the least `|g + N' lambda|`, zero where not active (Lawson and Hanson 1974, chapter 23)."""
    n_bounds = len(normals)
    gram = normals @ normals.T
    pull = -normals @ gradient
    scale = jnp.maximum(jnp.abs(pull).max(), jnp.finfo(gradient.dtype).tiny)
    tolerance = 100 * jnp.finfo(gradient.dtype).eps * scale
    ridge = 8 * jnp.finfo(gradient.dtype).eps * jnp.maximum(jnp.diag(gram).max(), 1e-30)

    def fit(used):
        both = jnp.outer(used, used)
        matrix = jnp.where(both, gram, 0.0) + jnp.diag(jnp.where(used, ridge, 1.0))
        return jnp.where(used, jnp.linalg.solve(matrix, jnp.where(used, pull, 0.0)), 0.0)

    def shorten(carry):
        used, now, wanted, count = carry
        falls = used & (wanted <= 0)
        share = jnp.where(falls, now / jnp.where(falls, now - wanted, 1.0), jnp.inf)
        now = now + jnp.clip(share.min(), 0.0, 1.0) * (wanted - now)
        used = used & ~(falls & (share <= share.min() * (1 + 1e-12))) & (now > 0)
        now = jnp.where(used, now, 0.0)
        return used, now, fit(used), count + 1

    def one(carry):
        used, now, count = carry
        push = jnp.where(active & ~used, pull - gram @ now, -jnp.inf)
        used = used | (jnp.arange(n_bounds) == jnp.argmax(push))
        # the new one starts at 0 and may only grow
        wanted = fit(used)
        used, now, wanted, _ = jax.lax.while_loop(
            lambda c: jnp.any(c[0] & (c[2] <= 0)) & (c[3] < n_bounds), shorten, (used, now, wanted, 0)
        )
        return used, jnp.where(used, wanted, 0.0), count + 1

    def unfinished(carry):
        used, now, count = carry
        push = jnp.where(active & ~used, pull - gram @ now, -jnp.inf)
        return (push.max() > tolerance) & (count < 3 * n_bounds)

    zero = jnp.zeros(n_bounds, gradient.dtype)
    return jax.lax.while_loop(unfinished, one, (jnp.zeros(n_bounds, bool), zero, 0))[1]
