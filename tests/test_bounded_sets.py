"""Projections onto feasible sets: against Dykstra's algorithm and scipy, by their properties, and their derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cablejax.bounded import AffineBalls, Balls, Box, Halfspaces, Intersection, minimise_quadratic

profile = settings(max_examples=25, deadline=None, derandomize=True)
SHAPE = (4, 3)
SIZE = 12
points = arrays(np.float64, SHAPE, elements=st.floats(-2.0, 2.0, allow_subnormal=False))
_project = jax.jit(lambda feasible, y: feasible.project(y))


@functools.cache
def random_maps():
    rng = np.random.default_rng(1)
    return rng.normal(size=(3, 2, SIZE)), 0.2 * rng.normal(size=(3, 2)), rng.normal(size=(4, SIZE))


def box():
    return Box(jnp.full(SHAPE, -0.3), jnp.full(SHAPE, 0.4))


def affine():
    matrix, offset, _ = random_maps()
    return AffineBalls(jnp.asarray(matrix), jnp.asarray(offset), jnp.asarray([0.5, 0.7, 0.9]))


def planes():
    return Halfspaces(jnp.asarray(random_maps()[2]), jnp.asarray([0.1, 0.5, jnp.inf, 0.0]))


SETS = {
    "box": box,
    "balls": lambda: Balls(jnp.asarray([0.2, 0.5, 1.0, 0.5])),
    "affine balls": affine,
    "half-spaces": planes,
    "all": lambda: Intersection((box(), Balls(jnp.asarray(0.5)), affine(), planes())),
}


@pytest.mark.parametrize("name", SETS)
@profile
@given(first=points, second=points)
def test_is_feasible_idempotent_nonexpansive_and_nearest(name, first, second):
    with jax.enable_x64(True):
        feasible = SETS[name]()
        a, b = _project(feasible, jnp.asarray(first)), _project(feasible, jnp.asarray(second))
        assert float(feasible.violation(a)) <= 1e-10
        np.testing.assert_allclose(_project(feasible, a), a, atol=1e-10)
        assert np.linalg.norm(a - b) <= np.linalg.norm(first - second) + 1e-8
        # the angle at the nearest point of a convex set to any other of its points is obtuse
        assert float(jnp.vdot(first - a, b - a)) <= 1e-8


def dykstra(y, projections, rounds=20000):
    """Boyle and Dykstra 1986: nearest point of an intersection from the projections onto its parts."""
    corrections = [np.zeros_like(y) for _ in projections]
    for _ in range(rounds):
        before = y
        for k, onto in enumerate(projections):
            moved = onto(y + corrections[k])
            corrections[k], y = y + corrections[k] - moved, moved
        if np.abs(y - before).max() < 1e-15:
            break
    return y


def in_balls(y, radius):
    return y * np.minimum(1.0, radius / np.maximum(np.linalg.norm(y, axis=-1, keepdims=True), 1e-30))


def in_plane(y, normal, bound):
    return y - (max(normal @ y.ravel() - bound, 0.0) / (normal @ normal) * normal).reshape(y.shape)


def test_intersection_is_what_dykstra_finds():
    with jax.enable_x64(True):
        normals = random_maps()[2]
        feasible = Intersection((box(), Balls(jnp.asarray(0.5)), planes()))
        parts = [lambda v: np.clip(v, -0.3, 0.4), lambda v: in_balls(v, 0.5)]
        parts += [lambda v, k=k, b=b: in_plane(v, normals[k], b) for k, b in ((0, 0.1), (1, 0.5), (3, 0.0))]
        for seed in range(5):
            y = np.random.default_rng(seed).normal(size=SHAPE) * 0.5
            np.testing.assert_allclose(_project(feasible, jnp.asarray(y)), dykstra(y, parts), atol=1e-9)


def test_affine_balls_are_what_slsqp_finds():
    with jax.enable_x64(True):
        matrix, offset, _ = random_maps()
        radius = np.array([0.5, 0.7, 0.9])

        def slack(x):
            z = matrix @ x + offset
            return radius**2 - np.sum(z**2, axis=1)

        y = np.random.default_rng(3).normal(size=SHAPE)
        out = scipy.optimize.minimize(
            lambda x: 0.5 * np.sum((x - y.ravel()) ** 2),
            np.zeros(SIZE),
            jac=lambda x: x - y.ravel(),
            method="SLSQP",
            constraints={"type": "ineq", "fun": slack},
            options={"ftol": 1e-15, "maxiter": 500},
        )
        np.testing.assert_allclose(_project(affine(), jnp.asarray(y)).ravel(), out.x, atol=1e-6)


@pytest.mark.parametrize("name", SETS)
def test_constraints_are_negative_inside_and_about_the_distance_outside(name):
    with jax.enable_x64(True):
        feasible, rng = SETS[name](), np.random.default_rng(4)
        y = jnp.asarray(rng.normal(size=SHAPE))
        inside = _project(feasible, y)
        assert float(feasible.constraints(inside).max()) <= 1e-10
        assert float(feasible.constraints(y).max()) > 0 and float(feasible.violation(y)) > 0
        near = inside + 1e-6 * (y - inside)
        assert float(feasible.violation(near)) == pytest.approx(float(feasible.constraints(near).max()), rel=1e-3)


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in ("affine balls", "half-spaces") else n for n in SETS]
)
def test_derivatives_of_the_projection(name):
    """In the point, in float64: central differences of forward mode, and reverse against forward."""
    with jax.enable_x64(True):
        feasible, step = SETS[name](), 1e-5
        y = jnp.asarray(np.random.default_rng(3).normal(size=SHAPE) * 0.8)
        forward = jax.jit(jax.jacfwd(lambda y: feasible.project(y)))(y).reshape(SIZE, SIZE)
        backward = jax.jit(jax.jacrev(lambda y: feasible.project(y)))(y).reshape(SIZE, SIZE)
        moves = step * jnp.eye(SIZE).reshape(SIZE, *SHAPE)
        both = jax.jit(jax.vmap(lambda m: feasible.project(y + m) - feasible.project(y - m)))(moves)
        np.testing.assert_allclose(forward, both.reshape(SIZE, SIZE).T / (2 * step), atol=1e-7)
        np.testing.assert_allclose(backward, forward, atol=1e-10)
        assert np.linalg.matrix_rank(forward, tol=1e-6) < SIZE, "some bound is active"


def test_derivatives_in_the_bounds():
    with jax.enable_x64(True):
        y, step = jnp.asarray(np.random.default_rng(4).normal(size=SHAPE)), 1e-5
        normals = random_maps()[2]

        @jax.jit
        def nearest(x):
            return Intersection(
                (Balls(0.5 + x[0]), Halfspaces(jnp.asarray(normals), jnp.asarray([0.1, 0.5, 1.0, 0.0]) + x[1]))
            ).project(y)

        forward = jax.jit(jax.jacfwd(nearest))(jnp.zeros(2))
        for k in range(2):
            move = jnp.zeros(2).at[k].set(step)
            np.testing.assert_allclose(forward[..., k], (nearest(move) - nearest(-move)) / (2 * step), atol=1e-6)


# --- quadratic models -------------------------------------------------------------------------------------------------


def random_model(rng, rank=SIZE):
    root = rng.normal(size=(SIZE, rank))
    return jnp.asarray(root @ root.T / rank), jnp.asarray(rng.normal(size=SIZE))


_minimise = jax.jit(lambda h, g, s, y: minimise_quadratic(h, g, s, y))


@jax.jit
@jax.vmap
def nearest_twice(matrix, offset, point):
    """The violation of the nearest point, how far that of a point a thousandth of the way back is, and convergence."""
    feasible = AffineBalls(matrix, offset, jnp.asarray([0.3, 0.25]))
    nearest = feasible.project(point)
    again = feasible.project(nearest + 1e-3 * (point - nearest))
    found = minimise_quadratic(jnp.eye(point.size), jnp.zeros_like(point), feasible, point)
    return feasible.violation(nearest), jnp.abs(again - nearest).max(), found.converged


@pytest.mark.parametrize("size", [0.1, 10.0, 100.0, 1000.0])
def test_from_far_away_the_nearest_point_is_still_found(size):
    """Forty to four thousand times as far as the balls are wide, which meet at any angle."""
    with jax.enable_x64(True):
        rng = np.random.default_rng(0)
        maps = rng.normal(size=(60, 2, 2, 6)), 0.1 * rng.normal(size=(60, 2, 2)), size * rng.normal(size=(60, 6))
        violation, between, converged = nearest_twice(*maps)
        assert bool(converged.all())
        assert float(violation.max()) <= 1e-10
        assert float(between.max()) <= 1e-9 * max(size, 1.0)


@pytest.mark.parametrize("size", [1e2, 1e4, 1e8])
@pytest.mark.parametrize("x64", [False, True])
def test_nearest_point_of_a_box_given_as_half_spaces(x64, size):
    """The unit box has its projection in closed form; in float32 the sum of a far point and a step would be a guess."""
    with jax.enable_x64(x64):
        eye, y = jnp.eye(3), jnp.asarray([size, 0.01 * size, 0.002 * size])
        feasible = Halfspaces(jnp.concatenate([eye, -eye]), jnp.ones(6))
        np.testing.assert_allclose(feasible.project(y), jnp.clip(y, -1, 1), atol=1e-12 if x64 else 0.05)
        assert float(feasible.violation(feasible.project(y))) <= 1e-6


@pytest.mark.parametrize("x64", [False, True])
@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_the_tip_of_a_cone_and_a_bound_of_zero_are_minima_too(x64, size):
    """There all terms of a bound vanish, and nothing is large or small beside them."""
    with jax.enable_x64(x64):
        cone = Halfspaces(jnp.asarray([[1.0, 1.0, 0.0], [0.0, 1.0, -1.0], [-1.0, 0.0, 0.0]]), jnp.zeros(3))
        linear = size * jnp.asarray([1.0, -2.0, 0.5])
        found = minimise_quadratic(jnp.eye(3), linear, cone, jnp.zeros(3))
        assert bool(found.converged) and np.abs(found.point).max() <= 1e-6 * size
        np.testing.assert_allclose(cone.project(-linear), 0.0, atol=1e-6 * size)
        positive = Box(jnp.zeros(3), jnp.full(3, jnp.inf))
        found = minimise_quadratic(jnp.diag(jnp.asarray([1.0, 0.1, 2.0])), linear, positive, jnp.zeros(3))
        assert bool(found.converged)
        np.testing.assert_allclose(found.point, [0.0, 20 * size, 0.0], atol=1e-5 * size)


@pytest.mark.parametrize("curvature", [1e-4, 1e-6, 1e-10, 0.0])
@pytest.mark.parametrize("x64", [False, True])
def test_unknowns_of_little_curvature_are_at_their_bounds_or_not_converged(x64, curvature):
    with jax.enable_x64(x64):
        box = Box(-jnp.ones(3), jnp.ones(3))
        hessian, linear = jnp.diag(jnp.asarray([1.0, curvature, curvature])), jnp.asarray([1.0, -1.0, 0.3])
        found = minimise_quadratic(hessian, linear, box, jnp.zeros(3))
        right = np.abs(np.asarray(found.point) - [-1.0, 1.0, -1.0]).max() < (1e-8 if x64 else 1e-3)
        assert right == bool(found.converged)
        assert right or curvature == 1e-10


@pytest.mark.slow
def test_derivatives_of_the_projection_from_far_away():
    """A thousand times as far as the balls are wide: forward mode against central differences."""
    with jax.enable_x64(True):
        feasible, step = affine(), 1e-2
        y = 500.0 * jnp.asarray(np.random.default_rng(8).normal(size=SHAPE))
        forward = jax.jit(jax.jacfwd(lambda y: feasible.project(y)))(y).reshape(SIZE, SIZE)
        moves = step * jnp.eye(SIZE).reshape(SIZE, *SHAPE)
        both = jax.jit(jax.vmap(lambda m: feasible.project(y + m) - feasible.project(y - m)))(moves)
        np.testing.assert_allclose(forward, both.reshape(SIZE, SIZE).T / (2 * step), atol=1e-7)
        assert np.linalg.matrix_rank(forward, tol=1e-6) < SIZE, "some bound is active"


@pytest.mark.parametrize("scale", [1.0, 10.0, 100.0])
def test_derivatives_where_the_last_step_was_rounding(scale):
    """Of projections from far away, and of quadratics that are centred at their minimiser: planes as they are known."""
    with jax.enable_x64(True):
        levels = jnp.asarray([0.1, 0.2, -0.3])
        slopes = jax.jit(jax.jacfwd(lambda y, normals: Halfspaces(normals, levels).project(y)))
        of_quadratic = jax.jit(
            jax.jacfwd(lambda g, normals, y: minimise_quadratic(jnp.eye(6), g, Halfspaces(normals, levels), y).point)
        )
        for seed in range(30):
            rng = np.random.default_rng(seed)
            y, normals = scale * rng.normal(size=6), rng.normal(size=(3, 6))
            nearest = np.asarray(Halfspaces(normals, levels).project(jnp.asarray(y)))
            forces = np.linalg.lstsq(normals.T, y - nearest, rcond=None)[0]
            held = normals[forces > 1e-7]
            exact = np.eye(6) - held.T @ np.linalg.solve(held @ held.T, held)
            np.testing.assert_allclose(slopes(y, normals), exact, atol=1e-7, err_msg=str(seed))
            for start in (nearest, nearest + 1e-10 * rng.normal(size=6)):
                found = of_quadratic(start - y, normals, start)
                np.testing.assert_allclose(found, -exact, atol=1e-7, err_msg=str(seed))


@pytest.mark.parametrize("name", SETS)
def test_minimum_of_a_quadratic_meets_its_conditions(name):
    """The conditions are those of any minimum, whoever found it: of a regular Hessian and of a singular one."""
    with jax.enable_x64(True):
        feasible, rng = SETS[name](), np.random.default_rng(5)
        for rank in (SIZE, SIZE, 8):
            hessian, gradient = random_model(rng, rank)
            # half-spaces leave directions open, in which only the Hessian holds the minimum
            hessian = hessian + (1e-3 if name == "half-spaces" else 1e-8) * jnp.eye(SIZE)
            start = _project(feasible, jnp.asarray(rng.normal(size=SHAPE) * 0.1))
            found = _minimise(hessian, gradient, feasible, start)
            assert bool(found.converged) and int(found.iterations) <= 25
            step = found.point - start.ravel()
            quadrics = feasible.quadrics(start)
            force = found.multipliers @ quadrics.jacobian(quadrics.lift(found.point))
            np.testing.assert_allclose(gradient + hessian @ step + force, 0.0, atol=1e-7)
            assert float(found.multipliers.min()) >= 0.0
            values = np.asarray(feasible.constraints(found.point.reshape(SHAPE)))
            assert values.max() <= 1e-10
            present = np.isfinite(values)
            np.testing.assert_allclose(np.asarray(found.multipliers)[present] * values[present], 0.0, atol=1e-9)


def test_minimum_of_a_quadratic_is_what_scipy_finds():
    with jax.enable_x64(True):
        rng = np.random.default_rng(6)
        for _ in range(5):
            hessian, gradient = random_model(rng)
            found = _minimise(hessian, gradient, box(), jnp.zeros(SHAPE))
            out = scipy.optimize.lsq_linear(
                np.linalg.cholesky(hessian).T,
                -np.linalg.solve(np.linalg.cholesky(hessian), gradient),
                bounds=(-0.3, 0.4),
                method="bvls",
                tol=1e-14,
            )
            np.testing.assert_allclose(found.point, out.x, atol=1e-9)


def test_minimum_of_a_quadratic_in_float32():
    rng = np.random.default_rng(7)
    with jax.enable_x64(True):
        hessian, gradient = random_model(rng)
        exact = np.asarray(_minimise(hessian, gradient, SETS["all"](), jnp.zeros(SHAPE)).point)
    to32 = functools.partial(jax.tree.map, lambda leaf: jnp.asarray(np.asarray(leaf), jnp.float32))
    with jax.enable_x64(True):
        feasible = SETS["all"]()
    found = _minimise(to32(hessian), to32(gradient), to32(feasible), jnp.zeros(SHAPE, jnp.float32))
    assert found.point.dtype == jnp.float32
    with jax.enable_x64(True):
        # The point itself is only as sure as the Hessian is well conditioned; what it is for is not.
        point = jnp.asarray(np.asarray(found.point), float)
        best, reached = (float(gradient @ x + 0.5 * x @ hessian @ x) for x in (exact, point))
        assert best < -0.1 and reached == pytest.approx(best, rel=2e-6)
        assert float(feasible.violation(point.reshape(SHAPE))) <= 32 * np.finfo(np.float32).eps


def test_a_step_along_an_active_bound_is_not_pulled_back():
    """From a corner, the minimum lies on the same bounds: rounding must not count as leaving the set."""
    with jax.enable_x64(True):
        feasible = Box(jnp.zeros(3), jnp.full(3, 10.0))
        start = jnp.asarray([0.0, 10.0, 1e-19])
        found = _minimise(jnp.eye(3), jnp.asarray([3.0, 2.0, -5.0]), feasible, start)
        np.testing.assert_allclose(found.point, [0.0, 8.0, 5.0], atol=1e-12)


# --- bad input --------------------------------------------------------------------------------------------------------


def test_empty_sets_say_so():
    one = jnp.ones(3)
    assert not bool(Box(-one, one).empty()) and bool(Box(one, -one).empty())
    assert bool(Box(one, one * jnp.nan).empty())
    assert not bool(Balls(jnp.asarray(0.0)).empty()) and bool(Balls(jnp.asarray(-1.0)).empty())
    assert bool(Halfspaces(jnp.ones((1, 3)), jnp.asarray([-jnp.inf])).empty())
    assert bool(AffineBalls(jnp.ones((1, 1, 3)), jnp.zeros((1, 1)), -jnp.ones(1)).empty())
    assert bool(Intersection((Box(-one, one), Balls(jnp.asarray(jnp.nan)))).empty())
    apart = Intersection((Box(one, 2 * one), Halfspaces(jnp.ones((1, 3)), jnp.zeros(1))))
    assert not bool(apart.empty()) and float(apart.violation(apart.project(one))) > 0.1
    with pytest.raises(ValueError, match="at least one set"):
        Intersection(())


def test_a_ball_of_no_radius_leaves_its_centre():
    np.testing.assert_array_equal(Balls(jnp.asarray(0.0)).project(jnp.ones((2, 3))), np.zeros((2, 3)))


def test_a_normal_of_zero_bounds_nothing():
    vacuous = Halfspaces(jnp.asarray([[0.0, 0.0], [1.0, 0.0]]), jnp.asarray([1.0, 0.5]))
    np.testing.assert_allclose(vacuous.project(jnp.asarray([2.0, 3.0])), [0.5, 3.0], atol=1e-5)
    never = Halfspaces(jnp.zeros((1, 2)), jnp.asarray([-1.0]))
    assert float(never.violation(jnp.zeros(2))) > 0
