"""The minimiser of a convex quadratic over a convex set, by a primal-dual interior-point method."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from cablejax.bounded.quadrics import Quadrics
from cablejax.bounded.tangents import derivative_along

if TYPE_CHECKING:
    from cablejax.bounded.sets.base import ConvexSet

# Ten to fifteen is usual; from far away, with bounds that meet at a sharp angle, up to sixty.
_ITERATIONS = 100
# Share of the way to the nearest bound that a step may take.
_TO_BOUND = 0.995


class QuadraticMinimum(NamedTuple):
    """Where a quadratic over a set is smallest.

    Attributes:
        point: the minimiser, in the set as far as rounding allows, shape [P].
        multipliers: of the set's constraints, not negative, shape [K].
        converged: whether the conditions of a minimum hold to rounding, shape [].
        iterations: spent, shape [].
    """

    point: Float[Array, " P"]
    multipliers: Float[Array, " K"]
    converged: Bool[Array, ""]
    iterations: Int[Array, ""]


def minimise_quadratic(
    hessian: Float[Array, "P P"], linear: Float[Array, " P"], feasible: ConvexSet, start: Float[Array, "..."]
) -> QuadraticMinimum:
    """Minimises `g'd + d'H d / 2` over the d with `start + d` in the set.

    Mehrotra's predictor-corrector method (SIAM J. Optim. 2, 1992) on the conditions of Karush, Kuhn and Tucker, with
    the curvature of the bounds in Newton's matrix; dense, one Cholesky factor per iteration. Differentiable in all
    arguments, where the active bounds do not change.

    Args:
        hessian: H, positive definite, or nearly so.
        linear: g.
        feasible: the set.
        start: the point that the quadratic is centred at, in any shape; flat arrays come back. The minimiser is pulled
            back to it, as far as it takes, where the method did not end inside.
    """
    return _minimum(feasible.quadrics(start), hessian, linear, start.ravel())


@jax.jit
def _minimum(quadrics: Quadrics, hessian, linear, start) -> QuadraticMinimum:
    step, multipliers, converged, iterations = _solve(quadrics, hessian, linear, start)
    return QuadraticMinimum(_inside(quadrics, start, step), multipliers, converged, iterations)


@jax.jit
def nearest_point(quadrics: Quadrics, y: Float[Array, " P"]) -> Float[Array, " P"]:
    """The point nearest to `y` with all `quadrics` <= 0; differentiable in both."""
    step = _solve(quadrics, jnp.eye(y.size, dtype=y.dtype), jnp.zeros_like(y), y)[0]
    return y + step


def _inside(quadrics: Quadrics, start, step):
    """The end of a step; of one that leaves the set by more than rounding, the last point inside."""
    z, along = quadrics.lift(start), quadrics.matrix @ step
    scale = _rounding_scale(quadrics, z) + _rounding_scale(quadrics, z + along)
    # What is beyond a bound by rounding stays: at a bound, a step along it would otherwise not get anywhere.
    tolerance = 16 * jnp.finfo(step.dtype).eps * (scale + jnp.abs(along).max())
    now = jnp.minimum(quadrics.of_lift(z) - tolerance, 0.0)
    slope = quadrics.groups @ ((quadrics.curvature * z + quadrics.slope) * along)
    bend = quadrics.groups @ (quadrics.curvature * along**2)
    leaves = quadrics.of_lift(z + along) > tolerance
    # now + slope t + bend t^2 / 2 = 0: the root ahead, without cancellation
    root = jnp.sqrt(jnp.maximum(slope**2 - 2.0 * bend * jnp.where(leaves, now, 0.0), 0.0))
    denominator = jnp.where(leaves, slope + root, 1.0)
    reach = jnp.where(leaves, -2.0 * jnp.where(leaves, now, 0.0) / jnp.where(denominator > 0, denominator, 1.0), 1.0)
    return start + jnp.clip(reach.min(), 0.0, 1.0) * step


def _rounding_scale(quadrics: Quadrics, z):
    level = jnp.where(jnp.isfinite(quadrics.level), jnp.abs(quadrics.level), 0.0)
    return level + quadrics.groups @ (0.5 * quadrics.curvature * z**2 + jnp.abs(quadrics.slope * z))


@eqx.filter_custom_jvp
def _solve(quadrics: Quadrics, hessian, linear, centre):
    return _interior_point(quadrics, hessian, linear, centre)


@_solve.def_jvp
def _solve_jvp(primals, tangents):
    """By the implicit function theorem, on the bounds that hold the minimiser."""
    step, multipliers, converged, iterations = _solve(*primals)
    quadrics, hessian, _, centre = primals
    size = step.size
    z = quadrics.lift(centre + step)
    active = multipliers > -quadrics.of_lift(z) * jnp.abs(multipliers).max() / _typical_length(quadrics, step)
    binding = jnp.where(active, multipliers, 0.0)

    def conditions(quadrics, hessian, linear, centre):
        z = quadrics.lift(centre + step)
        pull = hessian @ step + linear + binding @ quadrics.jacobian(z)
        return jnp.concatenate([pull, jnp.where(active, quadrics.of_lift(z), 0.0)])

    change = derivative_along(conditions, primals, tangents)
    normals = jnp.where(active[:, None], quadrics.jacobian(z), 0.0)
    # a little below zero where active, so that normals which depend on each other do no harm
    shift = 8 * jnp.finfo(step.dtype).eps / (1.0 + jnp.abs(hessian).max())
    matrix = jnp.block(
        [[hessian + quadrics.bend(binding), normals.T], [normals, jnp.diag(jnp.where(active, -shift, 1.0))]]
    )
    moved = jnp.linalg.solve(matrix, -change)
    tangent = moved[:size], jnp.where(active, moved[size:], 0.0)
    return (step, multipliers, converged, iterations), (*tangent, None, None)


def _typical_length(quadrics: Quadrics, step):
    return jnp.abs(quadrics.matrix @ step).max() + jnp.finfo(step.dtype).tiny


class _Iterate(NamedTuple):
    x: Float[Array, " P"]
    slack: Float[Array, " K"]
    multipliers: Float[Array, " K"]


class _Progress(NamedTuple):
    now: _Iterate
    gap: Float[Array, ""]
    best: _Iterate
    error: Float[Array, ""]
    stale: Int[Array, ""]
    count: Int[Array, ""]


def _interior_point(quadrics: Quadrics, hessian, linear, centre):
    """The step, its multipliers, whether they converged, iterations."""
    dtype, eps = centre.dtype, jnp.finfo(centre.dtype).eps
    present = jnp.isfinite(quadrics.level)
    n_present = jnp.maximum(present.sum(), 1).astype(dtype)

    # Unit diagonal of the Hessian and unit rows of L: then all lengths and all forces are of one size.
    unit = jnp.sqrt(jnp.maximum(jnp.diag(hessian), eps * jnp.diag(hessian).max()) + jnp.finfo(dtype).tiny)
    rows = jnp.linalg.norm(quadrics.matrix / unit, axis=1)
    row_scale = jnp.max(quadrics.groups * rows, axis=1) + jnp.finfo(dtype).tiny
    per_row = quadrics.groups.T @ (1.0 / row_scale)
    scaled = Quadrics(
        matrix=quadrics.matrix / unit,
        offset=quadrics.lift(centre),
        curvature=quadrics.curvature * per_row,
        slope=quadrics.slope * per_row,
        level=jnp.where(present, quadrics.level, 0.0) / row_scale,
        groups=quadrics.groups * present[:, None],
    )
    hessian = hessian / jnp.outer(unit, unit)
    linear = linear / unit

    start = scaled.of_lift(scaled.offset)
    # Newton's step to each bound is the distance outside; the value itself grows with the square of the distance.
    steepness = jnp.linalg.norm(scaled.jacobian(scaled.offset), axis=1) + jnp.finfo(dtype).tiny
    outside = jnp.max(jnp.where(present, jnp.maximum(start, 0.0) / steepness, 0.0))
    force = jnp.linalg.norm(linear) + outside + jnp.finfo(dtype).tiny
    # The step is about as long as the force, as far as there is room; a curved bound leaves its radius.
    curved = scaled.groups @ scaled.curvature > 0
    room = jnp.where(curved, jnp.minimum(-2.0 * scaled.level, force), force)
    slack = jnp.where(present, jnp.maximum(-start, 0.1 * room), 1.0)
    length = jnp.sum(jnp.where(present, jnp.minimum(slack, room), 0.0)) / n_present
    length = jnp.where(present.any(), length, force) + jnp.finfo(dtype).tiny
    multipliers = jnp.where(present, 0.1 * length * force / slack, 0.0)

    def residuals(x, slack, multipliers):
        z = scaled.lift(x)
        jacobian = scaled.jacobian(z)
        dual = hessian @ x + linear + multipliers @ jacobian
        primal = jnp.where(present, scaled.of_lift(z) + slack, 0.0)
        gap = jnp.sum(multipliers * slack) / n_present
        error = jnp.maximum(
            jnp.maximum(jnp.abs(dual).max() / force, jnp.abs(primal).max() / length), gap / (length * force)
        )
        return jacobian, dual, primal, gap, error

    def one(progress: _Progress) -> _Progress:
        x, slack, multipliers = progress.now
        jacobian, dual, primal, gap, _ = residuals(x, slack, multipliers)
        weight = multipliers / slack
        matrix = hessian + scaled.bend(multipliers) + (jacobian.T * weight) @ jacobian
        factor = jax.scipy.linalg.cho_factor(matrix + jnp.diag(4 * eps * (1.0 + jnp.diag(matrix))))

        def direction(dual, primal, complement):
            right = dual + (weight * primal - complement / slack) @ jacobian
            along = -jax.scipy.linalg.cho_solve(factor, right)
            # refined once: the factor is that of a matrix a little larger, and loses digits where weights differ much
            along = along - jax.scipy.linalg.cho_solve(factor, right + matrix @ along)
            opening = jnp.where(present, -primal - jacobian @ along, 0.0)
            pressing = jnp.where(present, -(complement + multipliers * opening) / slack, 0.0)
            return along, opening, pressing

        def longest(opening, pressing):
            of_slack = jnp.where(opening < 0, -slack / jnp.where(opening < 0, opening, 1.0), jnp.inf)
            falling = present & (pressing < 0)
            of_multipliers = jnp.where(falling, -multipliers / jnp.where(falling, pressing, 1.0), jnp.inf)
            return jnp.minimum(of_slack.min(), of_multipliers.min())

        along, opening, pressing = direction(dual, primal, multipliers * slack)
        share = jnp.minimum(longest(opening, pressing), 1.0)
        ahead = jnp.sum((slack + share * opening) * (multipliers + share * pressing)) / n_present
        centring = (ahead / (gap + jnp.finfo(dtype).tiny)) ** 3
        second = scaled.groups @ (0.5 * scaled.curvature * (scaled.matrix @ along) ** 2)
        complement = jnp.where(present, multipliers * slack + opening * pressing - centring * gap, 0.0)
        twist = scaled.bend(pressing) @ along
        along, opening, pressing = direction(dual + share**2 * twist, primal + share**2 * second, complement)
        share = jnp.minimum(_TO_BOUND * longest(opening, pressing), 1.0)

        new = _Iterate(x + share * along, slack + share * opening, multipliers + share * pressing)
        *_, gap, error = residuals(*new)
        better = error < progress.error
        return _Progress(
            now=new,
            gap=gap / (length * force),
            best=jax.tree.map(lambda a, b: jnp.where(better, a, b), new, progress.best),
            error=jnp.where(better, error, progress.error),
            stale=jnp.where(error < 0.5 * progress.error, 0, progress.stale + 1),
            count=progress.count + 1,
        )

    def unfinished(progress: _Progress):
        # Once the gap is below rounding, further steps only press the slacks to nothing.
        at_rounding = (progress.gap < eps) & (progress.stale > 1)
        going = jnp.isfinite(progress.gap) & (progress.count < _ITERATIONS)
        return (progress.error > 8 * eps) & ~at_rounding & going

    first = _Iterate(jnp.zeros_like(centre), slack, multipliers)
    zero = jnp.zeros((), jnp.int32)
    error = jnp.asarray(jnp.inf, dtype)
    last = jax.lax.while_loop(unfinished, one, _Progress(first, jnp.ones((), dtype), first, error, zero, zero))
    step, forces = last.best.x / unit, jnp.where(present, last.best.multipliers / row_scale, 0.0)
    return step, forces, last.error <= eps**0.6, last.count
