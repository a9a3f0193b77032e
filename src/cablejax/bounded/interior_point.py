"""Mehrotra's primal-dual interior-point method (SIAM J. Optim. 2, 1992) for a convex quadratic under quadratic bounds.

One dense Cholesky factor per iteration; Newton's matrix holds the curvature of the bounds. From far away its terms
differ by more than rounding, and forces cease to balance. Where that happens, the bounds that hold are known, and
Newton's method on them as equations, by the larger system that the factor avoids, finds the minimum. The same step
finishes what converges relative to the largest of all forces, and not yet in each unknown.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from cablejax.bounded.quadrics import Quadrics

# Ten to fifteen is usual; from far away, with bounds that meet at a sharp angle, up to sixty.
_ITERATIONS = 100
# Newton's steps on the bounds that hold; two or three are usual.
_POLISHING = 8
# Share of the way to the nearest bound that a step may take.
_TO_BOUND = 0.995
# The first slack of a straight bound, relative to the size of the bounds, at most ten times less than this.
_ROOM = 1e3


class _Scaled(NamedTuple):
    """The problem with a unit diagonal of the Hessian and unit rows of L: all lengths and all forces are of one size.

    Attributes:
        quadrics: the bounds, centred where the quadratic is.
        present: bounds that are there at all, shape [K].
        hessian: shape [P, P].
        linear: shape [P].
        unit: scale of the unknowns, shape [P].
        row_scale: scale of the bounds, shape [K].
    """

    quadrics: Quadrics
    present: Bool[Array, " K"]
    hessian: Float[Array, "P P"]
    linear: Float[Array, " P"]
    unit: Float[Array, " P"]
    row_scale: Float[Array, " K"]


class _Iterate(NamedTuple):
    x: Float[Array, " P"]
    slack: Float[Array, " K"]
    multipliers: Float[Array, " K"]


class _Sizes(NamedTuple):
    """Scales of the residuals: a typical length of slacks and force of multipliers."""

    length: Float[Array, ""]
    force: Float[Array, ""]


class _Residuals(NamedTuple):
    """Residuals of the Karush-Kuhn-Tucker conditions at an iterate.

    Attributes:
        jacobian: of the bounds, shape [K, P].
        dual: forces that do not balance, shape [P].
        primal: bounds and slacks that do not add up, shape [K].
        gap: mean product of slacks and multipliers, shape [].
        error: the largest of the three, relative to `_Sizes`, shape [].
    """

    jacobian: Float[Array, "K P"]
    dual: Float[Array, " P"]
    primal: Float[Array, " K"]
    gap: Float[Array, ""]
    error: Float[Array, ""]


class _Progress(NamedTuple):
    now: _Iterate
    gap: Float[Array, ""]
    best: _Iterate
    error: Float[Array, ""]
    stale: Int[Array, ""]
    count: Int[Array, ""]
    going: Bool[Array, ""]


def interior_point(
    quadrics: Quadrics, hessian: Float[Array, "P P"], linear: Float[Array, " P"], centre: Float[Array, " P"]
) -> tuple[Float[Array, " P"], Float[Array, " K"], Bool[Array, ""], Int[Array, ""]]:
    """Minimises `g'd + d'H d / 2` over the d that keep all `quadrics` of `centre + d` at or below zero.

    Returns:
        The step d, the multipliers of the bounds, whether the conditions of a minimum hold to rounding, iterations.
    """
    dtype, eps = centre.dtype, jnp.finfo(centre.dtype).eps
    problem = _scaled(quadrics, hessian, linear, centre)
    first, sizes = _start(problem)

    def one(progress: _Progress) -> _Progress:
        found = _residuals(problem, sizes, progress.now)
        progress = _judged(progress, found.error)._replace(gap=found.gap / (sizes.length * sizes.force))
        return _after(progress, unfinished(progress), lambda: _newton_step(problem, progress.now, found))

    def unfinished(progress: _Progress):
        # Once the gap is below rounding, further steps only press the slacks to nothing.
        at_rounding = (progress.gap < eps) & (progress.stale > 1)
        going = jnp.isfinite(progress.gap) & (progress.count < _ITERATIONS)
        return (progress.error > 8 * eps) & ~at_rounding & going

    zero, error = jnp.zeros((), jnp.int32), jnp.asarray(jnp.inf, dtype)
    begin = _Progress(first, jnp.ones((), dtype), first, error, zero, zero, jnp.array(True))
    last = jax.lax.while_loop(lambda progress: progress.going, one, begin)
    best, error, more = _polished(problem, last)
    forces = jnp.where(problem.present, best.multipliers / problem.row_scale, 0.0)
    # where nothing pulls and no bound is broken, the first iterate is the minimum
    at_rest = sizes.force <= jnp.finfo(dtype).tiny
    return best.x / problem.unit, forces, (error <= eps**0.6) | at_rest, last.count + more


def _polished(problem: _Scaled, last: _Progress) -> tuple[_Iterate, Float[Array, ""], Int[Array, ""]]:
    """The best iterate, its `_worst` residual and how many steps were taken; none where the method has converged."""
    eps = jnp.finfo(problem.linear.dtype).eps

    def one(progress: _Progress) -> _Progress:
        progress = _judged(progress, _worst(problem, progress.now))
        return _after(progress, unfinished(progress), lambda: _step_on_bounds(problem, progress.now))

    def unfinished(progress: _Progress):
        going = jnp.isfinite(progress.error) & (progress.count < _POLISHING) & (progress.stale < 2)
        return (progress.error > eps**0.7) & going

    zero = jnp.zeros_like(last.count)
    begin = _Progress(last.best, last.gap, last.best, jnp.full_like(last.error, jnp.inf), zero, zero, jnp.array(True))
    done = jax.lax.while_loop(lambda progress: progress.going, one, begin)
    return done.best, done.error, done.count


def _judged(progress: _Progress, error: Float[Array, ""]) -> _Progress:
    """What the error of the newest iterate says."""
    better = error < progress.error
    return progress._replace(
        best=jax.tree.map(lambda a, b: jnp.where(better, a, b), progress.now, progress.best),
        error=jnp.where(better, error, progress.error),
        stale=jnp.where(error < 0.5 * progress.error, 0, progress.stale + 1),
    )


def _after(progress: _Progress, going: Bool[Array, ""], step: Callable[[], _Iterate]) -> _Progress:
    """One more step, where the loop goes on. A loop judges first and steps then: so both are compiled once."""
    now = jax.lax.cond(going, step, lambda: progress.now)
    return progress._replace(now=now, count=progress.count + going, going=going)


def _worst(problem: _Scaled, at: _Iterate) -> Float[Array, ""]:
    """The largest residual of the conditions of a minimum, each relative to what it is the difference of.

    Relative to the largest force or length of the whole problem, an unknown of little curvature could be anywhere, and
    so could one whose bound is near while the minimum without bounds is far.
    """
    one = jnp.ones((), at.x.dtype)
    found = _residuals(problem, _Sizes(one, one), at)
    forces, lengths, pulls = _terms(problem, at, found.jacobian)
    either = jnp.minimum(jnp.abs(at.slack) / lengths, jnp.abs(at.multipliers) / pulls)
    broken = jnp.where(problem.present, jnp.maximum(either, jnp.abs(found.primal) / lengths), 0.0)
    return jnp.maximum((jnp.abs(found.dual) / forces).max(), broken.max(initial=0.0))


def _terms(
    problem: _Scaled, at: _Iterate, jacobian: Float[Array, "K P"]
) -> tuple[Float[Array, " P"], Float[Array, " K"], Float[Array, " K"]]:
    """Sizes of the forces that add up at each unknown, of the terms of each bound, and of the forces that it meets."""
    quadrics, tiny = problem.quadrics, jnp.finfo(at.x.dtype).tiny
    steep = jnp.abs(jacobian)
    forces = jnp.abs(problem.hessian) @ jnp.abs(at.x) + jnp.abs(problem.linear) + at.multipliers @ steep + tiny
    lengths = quadrics.lengths(at.x, problem.linear)
    return forces, lengths, steep @ forces / (steep.sum(axis=1) ** 2 + tiny) + tiny


def _step_on_bounds(problem: _Scaled, now: _Iterate) -> _Iterate:
    """Newton's step on the conditions of a minimum, with the bounds that seem to hold as equations."""
    quadrics, (x, slack, multipliers), eps = problem.quadrics, now, jnp.finfo(now.x.dtype).eps
    _, lengths, pulls = _terms(problem, now, quadrics.jacobian(quadrics.lift(x)))
    active = problem.present & (multipliers / pulls >= slack / lengths)
    z = quadrics.lift(x)
    normals, forces = jnp.where(active[:, None], quadrics.jacobian(z), 0.0), jnp.where(active, multipliers, 0.0)
    # a little below zero where active, so that normals which depend on each other do no harm
    corner = jnp.diag(jnp.where(active, -8 * eps, 1.0))
    curvature = problem.hessian + quadrics.bend(forces) + 4 * eps * jnp.eye(x.size, dtype=x.dtype)
    matrix = jnp.block([[curvature, normals.T], [normals, corner]])
    unbalanced = problem.hessian @ x + problem.linear + forces @ normals
    broken = jnp.where(active, quadrics.of_lift(z), 0.0)
    step = jnp.linalg.solve(matrix, -jnp.concatenate([unbalanced, broken]))
    x, forces = x + step[: x.size], jnp.maximum(forces + step[x.size :], 0.0)
    room = jnp.maximum(-quadrics.of_lift(quadrics.lift(x)), 0.0)
    return _Iterate(x, jnp.where(active & (forces > 0), 0.0, room), forces)


def _scaled(quadrics: Quadrics, hessian, linear, centre) -> _Scaled:
    dtype, eps = centre.dtype, jnp.finfo(centre.dtype).eps
    present = jnp.isfinite(quadrics.level)
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
    return _Scaled(scaled, present, hessian / jnp.outer(unit, unit), linear / unit, unit, row_scale)


def _start(problem: _Scaled) -> tuple[_Iterate, _Sizes]:
    """The first iterate: no step yet, and slacks as large as there is room."""
    quadrics, present, dtype = problem.quadrics, problem.present, problem.linear.dtype
    start = quadrics.of_lift(quadrics.offset)
    # Newton's step to each bound is the distance outside; the value itself grows with the square of the distance.
    steepness = jnp.linalg.norm(quadrics.jacobian(quadrics.offset), axis=1) + jnp.finfo(dtype).tiny
    outside = jnp.max(jnp.where(present, jnp.maximum(start, 0.0) / steepness, 0.0))
    force = jnp.linalg.norm(problem.linear) + outside + jnp.finfo(dtype).tiny
    # The step is about as long as the force, as far as there is room; a curved bound leaves its radius.
    curved = quadrics.groups @ quadrics.curvature > 0
    size = jnp.where(present, quadrics.sizes(quadrics.offset), 0.0).max(initial=0.0)
    most = jnp.where(quadrics.has_size, jnp.minimum(force, _ROOM * size), force)
    room = jnp.where(curved, jnp.minimum(-2.0 * quadrics.level, force), most)
    slack = jnp.where(present, jnp.maximum(-start, 0.1 * room), 1.0)
    length = jnp.sum(jnp.where(present, jnp.minimum(slack, room), 0.0)) / _count(present, dtype)
    length = jnp.where(present.any(), length, force) + jnp.finfo(dtype).tiny
    multipliers = jnp.where(present, 0.1 * length * force / slack, 0.0)
    return _Iterate(jnp.zeros_like(problem.linear), slack, multipliers), _Sizes(length, force)


def _count(present: Bool[Array, " K"], dtype) -> Float[Array, ""]:
    return jnp.maximum(present.sum(), 1).astype(dtype)


def _residuals(problem: _Scaled, sizes: _Sizes, at: _Iterate) -> _Residuals:
    x, slack, multipliers = at
    quadrics, present = problem.quadrics, problem.present
    z = quadrics.lift(x)
    jacobian = quadrics.jacobian(z)
    dual = problem.hessian @ x + problem.linear + multipliers @ jacobian
    primal = jnp.where(present, quadrics.of_lift(z) + slack, 0.0)
    gap = jnp.sum(multipliers * slack) / _count(present, x.dtype)
    relative = jnp.maximum(jnp.abs(dual).max() / sizes.force, jnp.abs(primal).max() / sizes.length)
    error = jnp.maximum(relative, gap / (sizes.length * sizes.force))
    return _Residuals(jacobian, dual, primal, gap, error)


def _newton_step(problem: _Scaled, now: _Iterate, at: _Residuals) -> _Iterate:
    """Mehrotra's predictor and corrector, as far as the bounds let them."""
    x, slack, multipliers = now
    scaled, present, dtype = problem.quadrics, problem.present, now.x.dtype
    eps = jnp.finfo(dtype).eps
    jacobian, dual, primal, gap, _ = at
    weight = multipliers / slack
    matrix = problem.hessian + scaled.bend(multipliers) + (jacobian.T * weight) @ jacobian
    factor = jax.scipy.linalg.cho_factor(matrix + jnp.diag(4 * eps * (1.0 + jnp.diag(matrix))))

    def direction(dual, primal, complement) -> _Iterate:
        right = dual + (weight * primal - complement / slack) @ jacobian
        along = -jax.scipy.linalg.cho_solve(factor, right)
        # refined once: the factor is that of a matrix a little larger, and loses digits where weights differ much
        along = along - jax.scipy.linalg.cho_solve(factor, right + matrix @ along)
        opening = jnp.where(present, -primal - jacobian @ along, 0.0)
        pressing = jnp.where(present, -(complement + multipliers * opening) / slack, 0.0)
        return _Iterate(along, opening, pressing)

    def longest(opening, pressing):
        of_slack = jnp.where(opening < 0, -slack / jnp.where(opening < 0, opening, 1.0), jnp.inf)
        falling = present & (pressing < 0)
        of_multipliers = jnp.where(falling, -multipliers / jnp.where(falling, pressing, 1.0), jnp.inf)
        return jnp.minimum(of_slack.min(), of_multipliers.min())

    along, opening, pressing = direction(dual, primal, multipliers * slack)
    share = jnp.minimum(longest(opening, pressing), 1.0)
    ahead = jnp.sum((slack + share * opening) * (multipliers + share * pressing)) / _count(present, dtype)
    centring = (ahead / (gap + jnp.finfo(dtype).tiny)) ** 3
    second = scaled.groups @ (0.5 * scaled.curvature * (scaled.matrix @ along) ** 2)
    complement = jnp.where(present, multipliers * slack + opening * pressing - centring * gap, 0.0)
    twist = scaled.bend(pressing) @ along
    along, opening, pressing = direction(dual + share**2 * twist, primal + share**2 * second, complement)
    share = jnp.minimum(_TO_BOUND * longest(opening, pressing), 1.0)
    return _Iterate(x + share * along, slack + share * opening, multipliers + share * pressing)
