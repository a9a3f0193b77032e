"""The minimiser of a convex quadratic over a convex set, and its derivative."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from cablejax.bounded.interior_point import interior_point
from cablejax.bounded.objective import derivative_along
from cablejax.bounded.quadrics import Quadrics

if TYPE_CHECKING:
    from cablejax.bounded.sets import ConvexSet

# A point further from the set than this many times the set's own size is moved near it first: along its own direction
# to this many sizes, then to the nearest point found, so often at most.
_FAR, _NEAR, _CENTRES = 64.0, 1e3, 3


class QuadraticMinimum(NamedTuple):
    """The minimum of a quadratic over a set.

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
    problem = quadrics, hessian, linear, start
    solution = interior_point(*jax.lax.stop_gradient(problem))
    step, multipliers, converged, iterations = _solved(solution, *problem)
    # what is pulled back is an error of the method, and no part of how the minimiser moves
    back = _inside(*jax.lax.stop_gradient((quadrics, start, step))) - jax.lax.stop_gradient(start + step)
    return QuadraticMinimum(start + step + back, multipliers, converged, iterations)


@jax.jit
def nearest_point(quadrics: Quadrics, y: Float[Array, " P"]) -> Float[Array, " P"]:
    """The point nearest to `y` with all `quadrics` <= 0; differentiable in both."""
    centre, solution = _nearest(*jax.lax.stop_gradient((quadrics, y)))
    return centre + _solved(solution, quadrics, *_distance(y, centre), centre)[0]


def _nearest(quadrics: Quadrics, y):
    """The centre of the last quadratic that was minimised, and the `interior_point` of that.

    A `y` far away is moved near the set first: its nearest point is a difference of large numbers from where it was.
    """
    present, eps, tiny = jnp.isfinite(quadrics.level), jnp.finfo(y.dtype).eps, jnp.finfo(y.dtype).tiny
    size = jnp.where(present, jnp.abs(quadrics.level), 0.0).max(initial=0.0)

    def far(centre):
        z = quadrics.lift(centre)
        steepness = jnp.linalg.norm(quadrics.jacobian(z), axis=1) + tiny
        beyond = jnp.where(present, quadrics.of_lift(z) / steepness, 0.0).max(initial=0.0)
        return beyond > _FAR * size + 64 * eps * jnp.abs(z).max()

    def nearer(carry):
        centre, solution, count, _ = carry
        centre = centre + solution[0]
        return centre, interior_point(quadrics, *_distance(y, centre), centre), count + 1, far(centre)

    reach = _NEAR * (size + jnp.abs(quadrics.offset).max()) / (jnp.abs(quadrics.matrix @ y).max() + tiny)
    shorter = jnp.where(far(y) & (reach > 0), jnp.minimum(reach, 1.0), 1.0) * y
    none, unsolved = jnp.zeros((), jnp.int32), jnp.zeros((), bool)
    begin = shorter, (jnp.zeros_like(y), jnp.zeros_like(quadrics.level), unsolved, none), none, ~unsolved
    last = jax.lax.while_loop(lambda carry: carry[3] & (carry[2] <= _CENTRES), nearer, begin)
    return last[:2]


def _distance(y, centre):
    """Hessian and gradient, at a centre, of half the squared distance to `y`."""
    return jnp.eye(y.size, dtype=y.dtype), centre - y


def _inside(quadrics: Quadrics, start, step):
    """The end of a step; of one that leaves the set by more than rounding, the last point inside."""
    z, along = quadrics.lift(start), quadrics.matrix @ step
    scale = quadrics.sizes(z) + quadrics.sizes(z + along)
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


@eqx.filter_custom_jvp
def _solved(solution, quadrics: Quadrics, hessian, linear, centre):
    """The known solution of a problem, with its derivatives by the problem."""
    del quadrics, hessian, linear, centre
    return solution


@_solved.def_jvp
def _solved_jvp(primals, tangents):
    """By the implicit function theorem, on the bounds that hold the minimiser."""
    step, multipliers, converged, iterations = _solved(*primals)
    primals, tangents = primals[1:], tangents[1:]
    quadrics, hessian, linear, centre = primals
    size = step.size
    z = quadrics.lift(centre + step)
    # Of a bound either the force or the room is rounding, each relative to what it is the sum of: relative to the step,
    # which may be rounding itself, all room would count.
    room = -quadrics.of_lift(z) / quadrics.lengths(centre + step, linear)
    forces = multipliers * jnp.linalg.norm(quadrics.jacobian(z), axis=1)
    pulls = jnp.abs(hessian) @ (jnp.abs(centre) + jnp.abs(step)) + jnp.abs(linear)
    active = forces > room * jnp.maximum(pulls.max(), jnp.abs(forces).max())
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
