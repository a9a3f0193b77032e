"""What is learned of the curvature from one step to the next."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.bounded.secant import positive_update, secant_update, sized


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def draw(seed, n=5):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n))
    return jnp.asarray(root @ root.T), jnp.asarray(rng.normal(size=n)), rng


@pytest.mark.parametrize("seed", range(5))
def test_a_positive_update_foretells_the_change_that_was_met(seed):
    model, moved, rng = draw(seed)
    truth = jnp.asarray(np.diag(rng.uniform(1.0, 3.0, 5))) + model
    updated = positive_update(model, moved, truth @ moved)
    np.testing.assert_allclose(updated @ moved, truth @ moved, rtol=1e-9)
    np.testing.assert_allclose(updated, updated.T, atol=1e-12)
    assert np.linalg.eigvalsh(updated)[0] > 0


@pytest.mark.parametrize("seed", range(5))
def test_negative_curvature_never_makes_the_model_grow(seed):
    """Met again and again, as at the minimum on a curved bound: with Powell's damping the model would grow."""
    model, _, rng = draw(seed)
    largest = float(np.linalg.eigvalsh(model)[-1])
    for _ in range(50):
        moved = jnp.asarray(rng.normal(size=5))
        model = positive_update(model, moved, -moved + 0.1 * jnp.asarray(rng.normal(size=5)))
        eigenvalues = np.linalg.eigvalsh(model)
        assert -1e-12 * largest < eigenvalues[0] and eigenvalues[-1] <= largest * (1 + 1e-12)


def test_a_model_that_sees_nothing_learns_what_there_is():
    blind, moved = jnp.zeros((3, 3)), jnp.asarray([1.0, 0.0, 0.0])
    np.testing.assert_allclose(positive_update(blind, moved, jnp.asarray([2.0, 1.0, 0.0]))[0], [2.0, 1.0, 0.0])
    np.testing.assert_array_equal(positive_update(blind, moved, -moved), blind)
    np.testing.assert_array_equal(positive_update(blind, 0 * moved, moved), blind)
    np.testing.assert_array_equal(positive_update(jnp.eye(3), moved, moved * jnp.nan), jnp.eye(3))


def test_sizes_follow_the_curvature_where_there_is_one():
    moved, bent = jnp.asarray([1.0, 1.0]), jnp.asarray([3.0, 1.0])
    np.testing.assert_allclose(sized(jnp.eye(2), moved, bent), 2.5 * np.eye(2))
    np.testing.assert_array_equal(sized(jnp.eye(2), moved, -bent), jnp.eye(2))


def test_the_secant_update_meets_its_equation():
    model, moved, rng = draw(7)
    bent, slope = jnp.asarray(rng.normal(size=5)), moved + 0.1 * jnp.asarray(rng.normal(size=5))
    updated = secant_update(model, moved, bent, slope)
    np.testing.assert_allclose(updated @ moved, bent, rtol=1e-9)
    np.testing.assert_allclose(updated, updated.T, atol=1e-12)
