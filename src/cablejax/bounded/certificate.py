"""Whether a point is a minimum, told by the point and the gradient alone."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cablejax.bounded.quadratic import minimise_quadratic
from cablejax.bounded.sets import AbstractSet

_ITERATIONS = 1000


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Certificate:
    """The first-order conditions at a point y with gradient g; all zero but the last two at a stationary point.

    Attributes:
        projected_gradient: largest element of `P(y - g) - y`, shape [].
        stationarity: largest element of `g + N' lambda`, N the constraints' normals, shape [].
        violation: of the worst bound, shape [].
        complementarity: largest product of a multiplier and its constraint's slack, shape [].
        multipliers: lambda, not negative, shape [K].
        active: bounds that hold the point back, shape [K].
    """

    projected_gradient: Float[Array, "*batch"]
    stationarity: Float[Array, "*batch"]
    violation: Float[Array, "*batch"]
    complementarity: Float[Array, "*batch"]
    multipliers: Float[Array, "*batch K"]
    active: Bool[Array, "*batch K"]

    @property
    def residual(self) -> Float[Array, "*batch"]:
        """The worst of the conditions that a minimum of a function meets with equality."""
        return jnp.maximum(jnp.maximum(self.projected_gradient, self.stationarity), self.complementarity)


def certify(feasible: AbstractSet, y: Float[Array, "..."], gradient: Float[Array, "..."]) -> Certificate:
    """The first-order conditions of a minimum over `feasible` at `y`, where the function has this gradient."""
    flat, slope = y.ravel(), gradient.ravel()
    found = minimise_quadratic(feasible, flat, slope, jnp.eye(flat.size, dtype=flat.dtype), _ITERATIONS)
    constraints, normals = jax.vjp(feasible.constraints, flat)
    multipliers = found.multipliers
    slack = jnp.where(multipliers > 0.0, constraints, 0.0)
    return Certificate(
        projected_gradient=jnp.abs(feasible.restore(flat + found.step) - flat).max(),
        stationarity=jnp.abs(slope + normals(multipliers)[0]).max(),
        violation=feasible.violation(flat),
        complementarity=jnp.abs(multipliers * slack).max(),
        multipliers=multipliers,
        active=multipliers > 0.0,
    )
