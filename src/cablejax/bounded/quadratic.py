"""The minimiser of a convex quadratic over a feasible set: splitting finds the active bounds, Newton the point."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

if TYPE_CHECKING:
    from cablejax.bounded.sets import AbstractSet


_RELAXATION = 1.6
_POLISH_STEPS = 3


class QuadraticMinimum(NamedTuple):
    """Where a quadratic over a set is smallest.

    Attributes:
        step: d, shape [P].
        multipliers: of the set's constraints, not negative, shape [K].
        polished: whether Newton's method on the active bounds confirmed it; otherwise it is the splitting's, shape [].
        iterations: of the splitting, shape [].
    """

    step: Float[Array, " P"]
    multipliers: Float[Array, " K"]
    polished: Bool[Array, ""]
    iterations: Int[Array, ""]


def minimise_quadratic(
    feasible: AbstractSet,
    y: Float[Array, "..."],
    gradient: Float[Array, " P"],
    hessian: Float[Array, "P P"],
    iterations: int = 60,
) -> QuadraticMinimum:
    """Minimises `g'd + d'H d / 2` over the d with `y + d` feasible.

    First the alternating direction method of multipliers (Boyd et al. 2011, section 5.2) with the constraint
    `lift(y + d) = z`, z in Z: each iteration is a product with a factored matrix and a clip, and its dual variables
    tell which bounds are active. Then Newton's method on the conditions of Karush, Kuhn and Tucker with these bounds as
    equations, which is exact where the bounds were told right (the polish of OSQP, Stellato et al. 2020, for curved
    bounds). If it was not, the splitting's point stands.

    Args:
        feasible: the set.
        y: where the quadratic is centred; need not be feasible.
        gradient: g.
        hessian: H, positive semi-definite; if singular, the minimum need not be unique.
        iterations: of the splitting, at most; it stops once it stands still.
    """
    flat = y.ravel()
    tolerance = 30.0 * jnp.finfo(flat.dtype).eps ** 0.9 * (1.0 + jnp.abs(flat).max())
    offset = feasible.lift(flat)
    lift = jax.jacfwd(feasible.lift)(jnp.zeros_like(flat))
    # Fewest iterations over problems with none to all bounds active; the Frobenius norm is near the largest eigenvalue.
    penalty = jnp.linalg.norm(hessian) / 20.0 + jnp.finfo(flat.dtype).tiny
    factor = jax.scipy.linalg.cho_factor(hessian + penalty * lift.T @ lift)

    def split(carry):
        z, dual, _, _, count = carry
        step = jax.scipy.linalg.cho_solve(factor, penalty * lift.T @ (z - dual - offset) - gradient)
        moved = offset + lift @ step
        relaxed = _RELAXATION * moved + (1.0 - _RELAXATION) * z
        new = feasible.clip(relaxed + dual)
        change = jnp.maximum(jnp.abs(new - z).max(), jnp.abs(moved - new).max())
        return new, dual + relaxed - new, step, change, count + 1

    start = feasible.clip(offset)
    carry = (start, jnp.zeros_like(start), jnp.zeros_like(flat), jnp.asarray(jnp.inf, flat.dtype), jnp.zeros((), int))
    z, dual, step, _, count = jax.lax.while_loop(
        lambda carry: (carry[3] > tolerance) & (carry[4] < iterations), split, carry
    )
    # A clip that moved its argument has a multiplier: the bounds that hold something back.
    active = feasible.gauge(z + dual) > 0.0
    exact, multipliers = _newton(feasible, flat, gradient, hessian, step, active, lift)
    slack = jnp.sqrt(jnp.finfo(flat.dtype).eps) * jnp.abs(gradient).max()
    rounding = tolerance * (1.0 + jnp.abs(exact).max())
    right = jnp.isfinite(exact).all() & (multipliers >= -slack).all() & (feasible.violation(flat + exact) <= rounding)
    return QuadraticMinimum(
        step=jnp.where(right, exact, step),
        multipliers=jnp.where(right, jnp.maximum(multipliers, 0.0), 0.0),
        polished=right,
        iterations=count,
    )


def stationarity(
    feasible: AbstractSet,
    point: Float[Array, " P"],
    multipliers: Float[Array, " K"],
    gradient: Float[Array, " P"],
    active: Bool[Array, " K"],
) -> Float[Array, " P+K"]:
    """`(g + N' lambda, c)` at a point: zero where it is stationary on its active bounds. Inactive multipliers are 0."""
    pull, normals = jax.vjp(feasible.constraints, point)
    del pull
    used = jnp.where(active, multipliers, 0.0)
    return jnp.concatenate([gradient + normals(used)[0], jnp.where(active, feasible.constraints(point), multipliers)])


def stationarity_matrix(
    feasible: AbstractSet,
    point: Float[Array, " P"],
    multipliers: Float[Array, " K"],
    hessian: Float[Array, "P P"],
    active: Bool[Array, " K"],
    lift: Float[Array, "M P"] | None = None,
) -> Float[Array, "P+K P+K"]:
    """The derivative of `stationarity` by (point, multipliers), kept regular where active normals depend.

    `lift` is the matrix of the set's affine map, if it is known already.
    """
    lift = jax.jacfwd(feasible.lift)(jnp.zeros_like(point)) if lift is None else lift
    used = jnp.where(active, multipliers, 0.0)
    place = feasible.lift(point)
    normals = jnp.where(active[:, None], jax.jacfwd(feasible.gauge)(place) @ lift, 0.0)
    bend = lift.T @ jax.jacfwd(lambda z: jax.vjp(feasible.gauge, z)[1](used)[0])(place) @ lift
    shift = jnp.finfo(point.dtype).eps * (1.0 + jnp.abs(hessian).max())
    lower = jnp.where(active, -shift, 1.0)
    return jnp.block([[hessian + bend, normals.T], [normals, jnp.diag(lower)]])


def _newton(feasible, flat, gradient, hessian, step, active, lift):
    """Newton's method for the minimiser with given active bounds, from the splitting's step."""
    size = flat.size

    def refine(_, carry):
        step, multipliers = carry
        error = stationarity(feasible, flat + step, multipliers, gradient + hessian @ step, active)
        matrix = stationarity_matrix(feasible, flat + step, multipliers, hessian, active, lift)
        change = jnp.linalg.solve(matrix, -error)
        return step + change[:size], multipliers + change[size:]

    return jax.lax.fori_loop(0, _POLISH_STEPS, refine, (step, jnp.zeros(active.shape, flat.dtype)))
