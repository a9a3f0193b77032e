import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cablejax.bounded import project_ball
from cablejax.mpc import feasible_from
from mpc_cases import feasible_set

T = 4
LOWER, UPPER = 0.15, 0.99
profile = settings(max_examples=60, deadline=None, derandomize=True)
coordinate = st.floats(-0.25, 0.25, width=32, allow_subnormal=False)
motions = arrays(np.float32, (T, 2, 3), elements=coordinate)
radii = st.floats(2.0**-9, 0.125, width=32)
separations = st.tuples(st.floats(LOWER, UPPER), st.floats(-np.pi, np.pi)).map(
    lambda polar: np.float32(polar[0]) * np.array([np.cos(polar[1]), np.sin(polar[1])], np.float32)
)


def project(motion, radius, separation):
    pose = np.zeros((2, 3), np.float32)
    pose[1, :2] = separation
    return _project(feasible_set(pose, radius), motion)


_project = jax.jit(lambda feasible, motion: (feasible.project(motion), feasible))
_ball = jax.jit(project_ball)


@profile
@given(motions, radii, separations)
def test_projection_is_feasible(motion, radius, separation):
    projected, feasible = project(motion, radius, separation)
    # A start on a bound may itself be outside by rounding; nothing may go further out than it.
    distance = np.linalg.norm(np.asarray(feasible.separation, np.float64))
    start = max(distance - UPPER, LOWER - distance, 0.0)
    assert float(feasible.violation(projected)) <= start + 1e-7
    # What a plant checks, in double precision: the first command strictly within its ball.
    norms = np.linalg.norm(np.asarray(projected, np.float64), axis=-1)
    assert (norms < np.float64(feasible.radius)).all()


@profile
@given(motions, radii, separations)
def test_projection_is_idempotent(motion, radius, separation):
    once, feasible = project(motion, radius, separation)
    twice, _ = _project(feasible, once)
    np.testing.assert_allclose(twice, once, atol=1e-6)


@profile
@given(motions, radii, separations)
def test_feasible_plans_are_left_alone(motion, radius, separation):
    """Shrunk to a hundredth of the radius and started away from the bounds, no bound is near."""
    size = np.maximum(np.linalg.norm(motion, axis=-1, keepdims=True), 1e-6)
    small = motion / size * 0.01 * radius
    separation = separation / np.linalg.norm(separation) * np.clip(np.linalg.norm(separation), 0.2, 0.9)
    np.testing.assert_allclose(project(small, radius, separation)[0], small, atol=1e-9)


@profile
@given(motions, motions, radii)
def test_ball_projection_is_nonexpansive_and_nearest(first, second, radius):
    a, b = _ball(first, radius), _ball(second, radius)
    gaps = np.linalg.norm(a - b, axis=-1), np.linalg.norm(first - second, axis=-1)
    assert (gaps[0] <= gaps[1] * (1 + 1e-5) + 1e-6).all()
    inside = _ball(second, radius)
    to_projection, to_other = np.linalg.norm(first - a, axis=-1), np.linalg.norm(first - inside, axis=-1)
    assert (to_projection <= to_other * (1 + 1e-5) + 1e-6).all()


@pytest.mark.slow
@profile
@given(motions, radii, separations)
def test_projection_is_hardly_farther_than_any_feasible_plan(motion, radius, separation):
    """Of one step, where the set is the intersection of balls and a ring: not worse than holding still or others."""
    projected, feasible = project(motion, radius, separation)
    first = np.asarray(projected)[0]
    rng = np.random.default_rng(0)
    others = rng.normal(size=(50, 1, 2, 3)) * radius
    others = np.asarray(jax.vmap(feasible.project)(jnp.asarray(others, jnp.float32)))[:, 0]
    distance = np.linalg.norm((others - motion[0]).reshape(50, -1), axis=1).min()
    assert np.linalg.norm(first - motion[0]) <= distance + 0.5 * radius


def test_taut_cable_slides_sideways_but_is_not_pulled():
    """At the greatest distance the grippers still turn about each other; only the outward part is lost."""
    pose = jnp.asarray([[0.0, 0.0, 0.0], [0.989999, 0.0, 0.0]])
    feasible = feasible_set(pose)
    apart = jnp.zeros((3, 2, 3)).at[:, 1, 0].set(0.03).at[:, 1, 1].set(0.02)
    projected = feasible.project(apart)
    assert float(feasible.violation(projected)) == 0.0
    assert float(projected[0, 1, 1]) > 0.015
    end = np.asarray(feasible.separation) + np.sum(projected[:, 1, :2] - projected[:, 0, :2], axis=0)
    assert np.linalg.norm(end) == pytest.approx(0.99, abs=1e-5)


def test_close_grippers_do_not_stick():
    """At the least distance a motion towards each other with a sideways part keeps its sideways part."""
    feasible = feasible_set(jnp.asarray([[0.0, 0.0, 0.0], [0.150001, 0.0, 0.0]]))
    projected = feasible.project(jnp.zeros((1, 2, 3)).at[0, 1].set(jnp.asarray([-0.02, 0.02, 0.0])))
    assert float(feasible.violation(projected)) == 0.0
    assert float(jnp.linalg.norm(projected)) > 0.01


@pytest.mark.parametrize(("distance", "sign"), [(1.02, -1.0), (0.1, 1.0)])
def test_a_start_outside_is_led_back_inside(distance, sign):
    feasible = feasible_set(jnp.asarray([[0.0, 0.0, 0.0], [distance, 0.0, 0.0]]))
    projected = feasible.project(jnp.zeros((3, 2, 3)))
    assert float(sign * (projected[0, 1, 0] - projected[0, 0, 0])) > 0.02
    relative = feasible.separation + jnp.sum(projected[:, 1, :2] - projected[:, 0, :2], axis=0)
    assert LOWER <= float(jnp.linalg.norm(relative)) <= UPPER


@pytest.mark.parametrize("start", ["at rest", "moving outwards"])
def test_a_start_outside_is_led_back_within_the_bound_on_the_change(start):
    """From both outside, command by command: every bound that closes in is kept, and the grippers come inside."""
    with jax.enable_x64(True):
        change, radius, inside = 0.004, 0.02, jnp.asarray([[-0.16, -0.12], [0.16, 0.12]])
        pose = jnp.asarray([[-0.198, 0.15, 0.0], [0.198, 0.0, 0.0]])
        last = jnp.zeros((2, 3)) if start == "at rest" else jnp.asarray([[-0.015, 0.0, 0.0], [0.0, 0.0, 0.015]])

        def next_command(carry, _):
            pose, last = carry
            feasible = feasible_from(
                pose, radius, (0.06, 0.4), workspace=tuple(map(tuple, inside)), change=change, previous=last
            )
            plan = feasible.project(jnp.zeros((T, 2, 3)))
            return (pose + plan[0], plan[0]), (feasible.violation(plan), plan[0], pose[:, :2])

        _, (broken, motion, places) = jax.jit(lambda: jax.lax.scan(next_command, (pose, last), length=14))()
        assert float(broken.max()) <= 1e-11
        changes = jnp.linalg.norm(jnp.diff(motion, axis=0, prepend=last[None]), axis=-1)
        assert float(changes.max()) <= change + 1e-11
        assert float(jnp.maximum(inside[0] - places[-1], places[-1] - inside[1]).max()) <= 1e-11


def test_after_a_motion_faster_than_is_allowed_now_there_is_room():
    """The bound on a step has shrunk since the last one, and a bound on the change is kept from there."""
    with jax.enable_x64(True):
        pose, last = jnp.asarray([[0.0, 0.0, 0.0], [0.6, 0.0, 0.0]]), jnp.asarray([[0.05, 0.0, 0.0], [0.0, 0.05, 0.0]])
        feasible = feasible_from(pose, 0.0475, (LOWER, UPPER), change=0.001, previous=last)
        plans = jnp.asarray(np.random.default_rng(0).normal(size=(20, T, 2, 3)) * 0.03)
        # a plan inside, by more than rounding
        slower = jnp.tile(last * (0.0475 / 0.05 - 0.005), (T, 1, 1))

        @jax.jit
        def excess(plans, slower):
            projected = jax.vmap(feasible.project)(plans)
            return jax.vmap(feasible.violation)(projected).max(), feasible.constraints(slower).max()

        broken, inside = excess(plans, slower)
        assert float(broken) <= 1e-11 and float(inside) < -1e-5


def test_projection_has_finite_gradients_at_the_centre_and_on_the_bound():
    feasible = feasible_set(jnp.asarray([[0.0, 0.0, 0.0], [0.99, 0.0, 0.0]]))
    for motion in (jnp.zeros((T, 2, 3)), jnp.zeros((T, 2, 3)).at[:, :, 0].set(0.05), jnp.ones((T, 2, 3))):
        assert np.isfinite(jax.jacfwd(feasible.project)(motion)).all()
