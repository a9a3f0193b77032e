"""The mixture and the structure terms against what they are derived from."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.arrays import quarter_turn
from cablejax.perceive.curve import carried, curve, keypoints_of
from cablejax.perceive.mixture import ELONGATION, distance_to, embedding_stiffness, expectation
from perceive_cases import ARCH, REGISTRATION, shape, start_angles

MATRICES = REGISTRATION.matrices

chain_of = jax.jit(lambda angles, pose: curve(MATRICES, angles, pose))
moments_of = jax.jit(
    lambda points, shape, sigma: expectation(
        points, jnp.ones(len(points), bool), shape, MATRICES.lengths, sigma, outlier_weight=0.1, area=1.0
    )
)


@pytest.fixture
def straight():
    return chain_of(jnp.zeros(REGISTRATION.n_links - 1), jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))


def test_moments_are_the_gradient_of_the_likelihood(straight):
    # Fisher's identity: the derivative of the log likelihood is that of the complete one, averaged.
    points = jnp.asarray(np.random.default_rng(0).normal([0.5, 0.0], [0.3, 0.01], (300, 2)))
    sigma = 0.01

    @jax.jit
    def likelihood(shift):
        moved = straight._replace(centre=straight.centre + shift)
        return moments_of(points, moved, sigma).log_likelihood

    gradient = jax.jit(jax.grad(likelihood))(jnp.zeros(2))
    found = moments_of(points, straight, sigma)
    spread = (ELONGATION * MATRICES.lengths) ** 2 + sigma**2
    expected = np.array([np.sum(found.along / spread), np.sum(found.across) / sigma**2])
    np.testing.assert_allclose(gradient, expected, rtol=2e-4, atol=0.05)


def test_a_far_point_belongs_to_nobody(straight):
    points = jnp.array([[0.5, 0.001], [0.5, 0.3]])
    found = moments_of(points, straight, 2e-3)
    assert float(jnp.sum(found.weight)) == pytest.approx(1.0, abs=0.01)


def test_a_bent_cable_is_not_drawn_to_the_inside():
    # A quarter of a circle: no point is on either side on average.
    joints = REGISTRATION.n_links - 1
    pose = jnp.array([[0.0, 0.0, 0.0], [2 / np.pi, 2 / np.pi, np.pi / 2]])
    arc = chain_of(jnp.full(joints, np.pi / 2 / joints), pose)
    angle = np.random.default_rng(0).uniform(0.0, np.pi / 2, 4000)
    points = 2 / np.pi * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    found = moments_of(jnp.asarray(points), arc, 2e-3)
    assert abs(float(jnp.sum(found.across) / jnp.sum(found.weight))) < 2e-4
    assert float(jax.jit(distance_to)(jnp.asarray(points), arc, MATRICES.lengths).max()) < 1e-3


def test_local_embedding_does_not_feel_affine_maps():
    before = shape(ARCH)
    centre = chain_of(jnp.asarray(start_angles(before)), jnp.asarray(before.pose)).centre
    stiffness = np.asarray(jax.jit(embedding_stiffness)(centre))
    energy = lambda x: float(np.sum(np.asarray(x) * (stiffness @ np.asarray(x))))  # noqa: E731
    centre = np.asarray(centre)
    stretch = np.array([[1.2, 0.3], [-0.1, 0.8]])
    bump = 0.005 * np.sin(np.linspace(0.0, 20.0, len(centre)))[:, None] * np.array([0.0, 1.0])
    rest = energy(centre)
    assert energy(centre @ stretch) < 4 * rest + 1e-6  # single precision
    # A bump of 5 mm moves the points a tenth as far as that map, and costs far more.
    assert energy(centre + bump) > 20 * rest


def test_the_curve_ends_where_its_angles_lead():
    before = shape(ARCH)
    chain = chain_of(jnp.asarray(start_angles(before)), jnp.asarray(before.pose))
    assert np.linalg.norm(np.asarray(chain.end) - ARCH[1, :2]) < 5e-3
    keypoints = np.asarray(jax.jit(lambda c: keypoints_of(MATRICES, c))(chain))
    assert np.linalg.norm(keypoints - before.keypoints, axis=1).max() < 5e-3
    chords = np.linalg.norm(np.diff(keypoints, axis=0), axis=1)
    assert (chords < 1 / 12 + 1e-6).all() and (chords > 0.95 / 12).all()
    np.testing.assert_allclose(np.sum(quarter_turn(chain.tangent) * chain.tangent, axis=1), 0.0, atol=1e-6)


def test_a_rigid_shift_is_carried_exactly():
    before = shape(ARCH)
    centre = chain_of(jnp.asarray(start_angles(before)), jnp.asarray(before.pose)).centre
    shift = jnp.array([0.02, -0.01, 0.0])
    found = jax.jit(lambda *a: carried(MATRICES, *a))(
        centre, jnp.asarray(before.pose), jnp.asarray(before.pose) + shift
    )
    np.testing.assert_allclose(found, centre + shift[:2], atol=1e-6)
