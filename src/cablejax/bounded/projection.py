"""The nearest point of a feasible set, with its derivatives."""

from __future__ import annotations

from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cablejax.bounded.quadratic import minimise_quadratic, stationarity, stationarity_matrix

if TYPE_CHECKING:
    from cablejax.bounded.sets import AbstractSet

_ITERATIONS = 200


def project(feasible: AbstractSet, y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The point of the set nearest to `y`; a feasible `y` is left as it is.

    Differentiable, in forward and reverse mode, in `y` and in the set's arrays: on the bounds that hold the nearest
    point, the conditions of Karush, Kuhn and Tucker define it implicitly. Where a bound is touched but does not hold
    (its multiplier is 0), the derivative is that of the inside.
    """
    return _project(feasible, y.ravel()).reshape(y.shape)


@eqx.filter_custom_jvp
def _project(feasible: AbstractSet, flat: Float[Array, " P"]) -> Float[Array, " P"]:
    return _nearest(feasible, flat)[0]


@_project.def_jvp
def _project_jvp(primals, tangents):
    feasible, flat = primals
    point, multipliers = _nearest(feasible, flat)
    active = multipliers > 0.0

    # The tangents are those of arrays; what has none stays as it is.
    perturbed = jax.tree.map(lambda t: t is not None, tangents, is_leaf=lambda t: t is None)
    varying, fixed = eqx.partition(primals, perturbed)

    def conditions(varying):
        feasible, flat = eqx.combine(varying, fixed)
        return stationarity(feasible, point, multipliers, point - flat, active)

    _, change = jax.jvp(conditions, (varying,), (tangents,))
    identity = jnp.eye(flat.size, dtype=flat.dtype)
    matrix = stationarity_matrix(feasible, point, multipliers, identity, active)
    return point, jnp.linalg.solve(matrix, -change)[: flat.size]


def _nearest(feasible: AbstractSet, flat: Float[Array, " P"]) -> tuple[Float[Array, " P"], Float[Array, " K"]]:
    """The nearest point and the multipliers of its bounds."""

    def search():
        still = jnp.zeros_like(flat)
        found = minimise_quadratic(feasible, flat, still, jnp.eye(flat.size, dtype=flat.dtype), _ITERATIONS)
        return flat + found.step, found.multipliers

    def leave():
        return flat, jnp.zeros_like(feasible.constraints(flat))

    # NaN counts as inside: there is nothing to search.
    outside = feasible.violation(flat) > 0.0
    point, multipliers = jax.lax.cond(outside, search, leave)
    return feasible.restore(point), multipliers
