"""Registration: accuracy, what it must not depend on, and its derivatives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.perceive import RegistrationConfig, register
from cablejax.perceive.initial import padded
from perceive_cases import ARCH, CAPACITY, REGISTRATION, S_SHAPE, cloud, mean_error, moved, shape, start_angles

SIGMA = 0.015
STEP = 1e-4


@pytest.fixture(scope="module", params=[ARCH, S_SHAPE], ids=["arch", "S"])
def case(request):
    """A cable, and where it was before its grippers moved by a centimetre."""
    before = shape(request.param)
    return before, shape(moved(request.param), guess=before)


def fitted(points, before, after, *, iterations=8):
    return register_rows(padded(points, CAPACITY), before, after, iterations=iterations)


def register_rows(rows, before, after, *, iterations=8):
    return register(
        REGISTRATION,
        jnp.asarray(rows.points),
        jnp.asarray(rows.mask),
        jnp.asarray(after.pose, jnp.float32),
        jnp.asarray(start_angles(before), jnp.float32),
        jnp.asarray(before.pose, jnp.float32),
        jnp.asarray(SIGMA, jnp.float32),
        iterations=iterations,
    )


@pytest.mark.parametrize(
    ("clutter", "bound"),
    [({}, 1e-3), ({"hidden": (0.25, 0.55), "outliers": 0.1}, 3e-3), ({"noise": 0.0}, 1e-3)],
    ids=["2 mm noise", "30 % hidden, 10 % outliers", "no noise"],
)
def test_keypoints_are_found(case, clutter, bound):
    before, after = case
    fit = fitted(cloud(after, 1, **clutter), before, after)
    assert mean_error(fit.keypoints, after) < bound
    # The start was wrong by more than that.
    assert mean_error(before.keypoints, after) > 1.5 * bound
    assert fit.gap < 1e-4
    np.testing.assert_allclose(fit.keypoints[jnp.array([0, -1])], after.pose[:, :2], atol=1e-4)


def test_what_is_estimated_about_the_cloud_is_right(case):
    before, after = case
    fit = fitted(cloud(after, 2, hidden=(0.25, 0.55), outliers=0.1), before, after)
    assert float(fit.sigma) == pytest.approx(2e-3, rel=0.1)
    assert float(fit.support) == pytest.approx(0.9, abs=0.04)
    assert float(fit.seen) == pytest.approx(0.7, abs=0.06)


def test_dense_points_do_not_pull_the_keypoints_along(case):
    before, after = case
    dense = cloud(after, 3, n=700, hidden=(0.4, 1.0))
    sparse = cloud(after, 4, n=100, hidden=(0.0, 0.4))
    fit = fitted(np.concatenate([dense, sparse]), before, after)
    assert mean_error(fit.keypoints, after) < 1e-3


def test_turning_everything_turns_the_result(case):
    before, after = case
    points = cloud(after, 5)
    angle, shift = 2.0, np.array([0.3, -0.2])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

    def carried(cable):
        pose = np.concatenate([cable.pose[:, :2] @ turn.T + shift, cable.pose[:, 2:] + angle], axis=1)
        return dataclasses.replace(cable, pose=pose, points=cable.points @ turn.T + shift)

    fit = fitted(points, before, after)
    turned = fitted(points @ turn.T + shift, carried(before), carried(after))
    np.testing.assert_allclose(turned.keypoints, np.asarray(fit.keypoints) @ turn.T + shift, atol=2e-5)


def test_padding_and_the_order_of_points_do_not_matter(case):
    before, after = case
    points = cloud(after, 6, n=CAPACITY // 2)
    fit = fitted(points, before, after)
    shuffled = np.full((CAPACITY, 2), np.nan)
    shuffled[1::2] = points[::-1]
    np.testing.assert_allclose(fitted(shuffled, before, after).keypoints, fit.keypoints, atol=2e-5)


@pytest.mark.parametrize("padding", [np.nan, np.inf, 1e10])
def test_padding_may_be_anything(case, padding):
    before, after = case
    points = cloud(after, 6, n=CAPACITY // 2)
    rows = padded(points, CAPACITY)
    rows = rows._replace(points=np.where(rows.mask[:, None], rows.points, np.float32(padding)))
    np.testing.assert_array_equal(register_rows(rows, before, after).keypoints, fitted(points, before, after).keypoints)


@pytest.mark.parametrize("far", [1e6, 3.4e38, 1e300])
def test_a_point_that_no_camera_sees_is_no_point(case, far):
    points = cloud(case[1], 6, n=CAPACITY // 2)
    rows = padded(np.concatenate([points, [[far, 0.0]]]), CAPACITY)
    assert rows.mask.sum() == len(points) and rows.dropped == 1


@pytest.mark.parametrize("heading", [0.0, 0.3, np.pi / 2])
@pytest.mark.parametrize("span", [1.0, 0.9])
def test_a_straight_start_is_a_start(heading, span):
    direction = np.array([np.cos(heading), np.sin(heading)])
    pose = jnp.asarray(
        np.array([[*(-0.5 * span * direction), heading], [*(0.5 * span * direction), heading]]), jnp.float32
    )
    points = np.linspace(-0.5 * span, 0.5 * span, 200)[:, None] * direction
    rows = padded(points + 1e-3 * np.random.default_rng(0).normal(size=points.shape), CAPACITY)
    start = jnp.zeros(REGISTRATION.n_links - 1)
    fit = register(
        REGISTRATION,
        jnp.asarray(rows.points),
        jnp.asarray(rows.mask),
        pose,
        start,
        pose,
        jnp.asarray(SIGMA),
        iterations=8,
    )
    assert np.isfinite(fit.keypoints).all() and float(fit.gap) < 1e-3


@pytest.mark.slow
def test_derivatives():
    """Central differences, and JVP against VJP, in float64 through all iterations."""
    with jax.enable_x64(True):
        before = shape(ARCH)
        after = shape(moved(ARCH), guess=before)
        points = jnp.asarray(cloud(after, 7, n=120))
        inputs = (
            points,
            jnp.asarray(after.pose),
            jnp.asarray(start_angles(before)),
            jnp.asarray(before.pose),
            jnp.asarray(SIGMA),
        )

        def keypoints(points, pose, angles, angles_pose, sigma):
            mask = jnp.ones(len(points), bool)
            return register(REGISTRATION, points, mask, pose, angles, angles_pose, sigma, iterations=4).keypoints

        push = jax.jit(lambda at, directions: jax.jvp(keypoints, at, directions))
        random = np.random.default_rng(8)
        cotangent = jnp.asarray(random.standard_normal((13, 2)))
        pulled = jax.jit(lambda cotangent: jax.vjp(keypoints, *inputs)[1](cotangent))(cotangent)
        for index, (value, back) in enumerate(zip(inputs, pulled, strict=True)):
            direction = jnp.asarray(random.standard_normal(value.shape)) * 1e-3
            directions = tuple(jnp.zeros_like(v) if i != index else direction for i, v in enumerate(inputs))
            forward = push(inputs, directions)[1]
            up, down = (
                push(jax.tree.map(lambda v, d, s=sign: v + s * STEP * d, inputs, directions), directions)[0]
                for sign in (1, -1)
            )
            np.testing.assert_allclose(forward, (up - down) / (2 * STEP), atol=1e-6 * np.abs(forward).max() + 1e-10)
            assert float(jnp.vdot(cotangent, forward)) == pytest.approx(float(jnp.vdot(back, direction)), rel=1e-8)
            assert np.abs(forward).max() > 0


def test_grippers_at_one_point_hold_the_ends_as_any_others():
    """A closed loop: nothing jumps as the grippers come together, nor do the derivatives."""
    with jax.enable_x64(True):
        angle, n = np.linspace(0, 2 * np.pi, 120), REGISTRATION.n_links - 1
        loop = jnp.asarray(np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1) * REGISTRATION.length / (2 * np.pi))
        angles = jnp.full(n, 2 * np.pi / n)
        begun = jnp.array([[0.0, 0.0, 0.0], [0.02, 0.0, 2 * np.pi]])

        def fit(apart):
            pose = begun.at[1, 0].set(apart)
            mask = jnp.ones(len(loop), bool)
            return register(REGISTRATION, loop, mask, pose, angles, begun, jnp.asarray(0.02), iterations=6)

        value, slope = jax.jit(lambda at: jax.jvp(lambda x: (fit(x).keypoints, fit(x).gap), (at,), (1.0,)))(
            jnp.linspace(-1e-5, 1e-5, 3)[1]
        )
        near = {at: jax.jit(fit)(at) for at in (-1e-5, 1e-9, 1e-5)}
        wanted = (near[1e-5].keypoints - near[-1e-5].keypoints) / 2e-5
    assert float(value[1]) < 1e-5 and float(near[1e-9].gap) < 1e-5
    np.testing.assert_allclose(value[0], near[1e-9].keypoints, atol=1e-7)
    np.testing.assert_allclose(slope[0], wanted, atol=1e-5)


@pytest.mark.parametrize(
    "change", [{"length": -1.0}, {"outlier_weight": 1.0}, {"n_links": 3}, {"coherence": np.nan}, {"bending": 0.0}]
)
def test_impossible_settings_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change)).replace("n_links", "links")):
        RegistrationConfig(**change)
