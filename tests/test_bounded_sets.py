"""Projections onto feasible sets: against Dykstra's algorithm, by their properties, and their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cablejax.bounded import Balls, Box, Intersection, certify, minimise_quadratic
from cablejax.mpc import feasible_from

profile = settings(max_examples=25, deadline=None, derandomize=True)
SIZE = 12
points = arrays(np.float64, SIZE, elements=st.floats(-2.0, 2.0, allow_subnormal=False))
_project = jax.jit(lambda feasible, y: feasible.project(y))


def box_and_balls():
    return Intersection((Box(jnp.full(SIZE, -0.3), jnp.full(SIZE, 0.4)), Balls(jnp.asarray(0.5), 3)))


def grippers():
    """Balls, greatest distance, workspace and change of motion: convex, and all of them near."""
    pose = jnp.asarray([[0.0, 0.0, 0.0], [0.9, 0.0, 0.0]])
    return feasible_from(pose, 0.3, (0.0, 0.95), workspace=((-0.2, -0.1), (1.2, 0.2)), change=0.25)


SETS = {"box and balls": box_and_balls, "grippers": grippers}


def dykstra(y, projections, rounds=4000):
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


def balls(y, radius):
    vectors = y.reshape(-1, 3)
    return (vectors * np.minimum(1.0, radius / np.maximum(np.linalg.norm(vectors, axis=1), 1e-30))[:, None]).ravel()


def test_is_what_dykstra_finds():
    with jax.enable_x64(True):
        for seed in range(5):
            y = np.random.default_rng(seed).normal(size=SIZE) * 0.5
            expected = dykstra(y, [lambda v: np.clip(v, -0.3, 0.4), lambda v: balls(v, 0.5)])
            np.testing.assert_allclose(_project(box_and_balls(), jnp.asarray(y)), expected, atol=1e-10)


@pytest.mark.parametrize("name", SETS)
@profile
@given(first=points, second=points)
def test_is_feasible_idempotent_nonexpansive_and_nearest(name, first, second):
    with jax.enable_x64(True):
        feasible = SETS[name]()
        a, b = _project(feasible, jnp.asarray(first)), _project(feasible, jnp.asarray(second))
        assert float(feasible.violation(a)) <= 1e-12
        np.testing.assert_allclose(_project(feasible, a), a, atol=1e-12)
        assert np.linalg.norm(a - b) <= np.linalg.norm(first - second) + 1e-9
        # the angle at a nearest point of a convex set to any other point is obtuse
        assert float(jnp.vdot(first - a, b - a)) <= 1e-9


@pytest.mark.parametrize("name", SETS)
def test_derivatives_of_the_projection(name):
    """Central differences in the point, in float64, forward and reverse."""
    with jax.enable_x64(True):
        feasible, step = SETS[name](), 1e-6
        y = jnp.asarray(np.random.default_rng(3).normal(size=SIZE) * 0.4)
        forward = jax.jacfwd(lambda y: _project(feasible, y))(y)
        backward = jax.jacrev(lambda y: _project(feasible, y))(y)
        moves = step * jnp.eye(SIZE)
        expected = jax.vmap(lambda m: _project(feasible, y + m) - _project(feasible, y - m))(moves).T / (2 * step)
        np.testing.assert_allclose(forward, expected, atol=1e-7)
        np.testing.assert_allclose(backward, forward, atol=1e-12)
        assert np.linalg.matrix_rank(forward, tol=1e-6) < SIZE, "some bound is active"


def test_derivatives_in_the_bounds():
    with jax.enable_x64(True):
        y, step = jnp.asarray(np.random.default_rng(4).normal(size=SIZE)), 1e-6

        def nearest(radius):
            return Intersection((Box(jnp.full(SIZE, -0.3), jnp.full(SIZE, 0.4)), Balls(radius, 3))).project(y)

        expected = (nearest(0.5 + step) - nearest(0.5 - step)) / (2 * step)
        np.testing.assert_allclose(jax.jacfwd(nearest)(0.5), expected, atol=1e-7)


@pytest.mark.parametrize("name", SETS)
def test_minimum_of_a_quadratic_meets_its_conditions(name):
    """Also one that is singular; checked by what makes a minimum, not by another solver."""
    with jax.enable_x64(True):
        feasible, random = SETS[name](), np.random.default_rng(5)
        for rank in (SIZE, 5):
            root = jnp.asarray(random.normal(size=(SIZE, rank)))
            hessian, gradient = root @ root.T, jnp.asarray(random.normal(size=SIZE))
            centre = feasible.project(jnp.asarray(random.normal(size=SIZE)) * 0.1)
            found = minimise_quadratic(feasible, centre, gradient, hessian, iterations=2000)
            assert bool(found.polished) and (found.multipliers >= 0).all()
            certificate = certify(feasible, centre + found.step, gradient + hessian @ found.step)
            assert float(certificate.residual) < 1e-8 and float(certificate.violation) < 1e-10


def test_grippers_that_start_outside_have_somewhere_to_go():
    pose = jnp.asarray([[0.0, 0.0, 0.0], [1.2, 0.5, 0.0]])
    feasible = feasible_from(pose, 0.05, (0.15, 0.99), workspace=((-0.1, -0.1), (1.3, 0.3)))
    assert bool(feasible.starts_outside()) and bool(feasible.possible())
    motion = feasible.project(jnp.zeros((6, 2, 3)))
    assert float(feasible.violation(motion)) <= 1e-6
    end = pose[:, :2] + motion[..., :2].sum(axis=0)
    assert float(jnp.linalg.norm(end[1] - end[0])) <= 0.99 + 1e-5 and float(end[1, 1]) <= 0.3 + 1e-5


def test_bounds_that_contradict_each_other_are_not_possible():
    pose = jnp.asarray([[0.0, 0.0, 0.0], [0.9, 0.0, 0.0]])
    assert bool(feasible_from(pose, 0.05, (0.15, 0.99)).possible())
    assert not bool(feasible_from(pose, 0.05, (0.99, 0.15)).possible())
    assert not bool(feasible_from(pose, -0.05, (0.15, 0.99)).possible())
    assert not bool(feasible_from(pose, float("nan"), (0.15, 0.99)).possible())
    assert not bool(feasible_from(pose, 0.05, (0.15, 0.99), workspace=((1.0, 0.0), (0.0, 1.0))).possible())
