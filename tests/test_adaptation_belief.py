"""The filter on what cable it is: exact where it must be, and indifferent to what says nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.adaptation.belief import AdaptationConfig, prior_belief, update

CONFIG = AdaptationConfig(memory=1.0, outlier=1e6, max_step=10.0, limits=((-10.0, 10.0), (-10.0, 10.0)))
SEEN = np.ones(13, bool)


def linear_world(seed, truth, steps, noise=0.0):
    rng = np.random.default_rng(seed)
    sensitivity = 1e-2 * rng.standard_normal((steps, 13, 2, 2))
    return sensitivity, noise * rng.standard_normal((steps, 13, 2)), np.asarray(truth)


def run(config, sensitivity, noise, truth):
    belief = prior_belief(config)
    for h, e in zip(sensitivity, noise, strict=True):
        belief = update(config, belief, jnp.asarray(h), jnp.asarray(h @ (truth - np.asarray(belief.mean)) + e), SEEN)
    return belief


def test_linear_errors_give_the_ridge_solution():
    with jax.enable_x64(True):
        sensitivity, noise, truth = linear_world(0, [0.7, -1.1], steps=6, noise=1e-3)
        belief = run(CONFIG, sensitivity, noise, truth)
        rows = sensitivity.reshape(-1, 2) / CONFIG.error_std
        seen = (sensitivity @ truth + noise).reshape(-1) / CONFIG.error_std
        np.testing.assert_allclose(belief.mean, np.linalg.solve(rows.T @ rows + np.eye(2), rows.T @ seen), rtol=1e-9)
        np.testing.assert_allclose(belief.information, rows.T @ rows + np.eye(2), rtol=1e-9)


def test_what_is_not_seen_stays_where_the_prior_put_it():
    with jax.enable_x64(True):
        sensitivity, noise, _ = linear_world(1, [0, 0], steps=20)
        ratio = np.array([1.0, -1.0])  # only the difference of the two log ratios moves the cable
        sensitivity = (sensitivity @ ratio)[..., None] * ratio
        belief = run(CONFIG, sensitivity, noise, np.array([1.0, 0.0]))
        np.testing.assert_allclose(belief.mean, [0.5, -0.5], atol=1e-2)
        np.testing.assert_allclose(belief.mean.sum(), 0.0, atol=1e-9)


def test_where_nothing_is_seen_a_belief_fades_to_its_prior():
    config = AdaptationConfig(prior_mean=(-0.7, 0.4), memory=0.8)
    belief = prior_belief(config)
    np.testing.assert_allclose(belief.mean, [-0.7, 0.4], rtol=1e-6)
    moved = type(belief)(belief.mean + 0.3, belief.information)
    for _ in range(40):
        moved = update(config, moved, jnp.zeros((13, 2, 2)), jnp.zeros((13, 2)), SEEN)
    np.testing.assert_allclose(moved.mean, [-0.7, 0.4], atol=1e-3)
    with pytest.raises(ValueError, match="prior_mean is"):
        AdaptationConfig(prior_mean=(5.0, 0.0))


def test_missing_keypoints_and_snap_throughs_say_nothing():
    sensitivity, _, truth = linear_world(2, [0.5, 0.5], steps=1)
    h, belief = jnp.asarray(sensitivity[0], jnp.float32), prior_belief(CONFIG)
    error = jnp.asarray(sensitivity[0] @ truth, jnp.float32)
    unseen = update(CONFIG, belief, h, jnp.full((13, 2), jnp.nan), SEEN)
    np.testing.assert_array_equal(unseen.mean, belief.mean)
    np.testing.assert_array_equal(unseen.information, belief.information)
    half = np.arange(13) < 6
    np.testing.assert_array_equal(
        update(CONFIG, belief, h, error.at[6:].set(jnp.nan), SEEN).mean, update(CONFIG, belief, h, error, half).mean
    )
    careful = AdaptationConfig()
    assert np.abs(update(careful, belief, h, error + 0.3, SEEN).mean).max() < 0.05


def test_it_never_leaves_its_limits_and_follows_a_change():
    config = AdaptationConfig(memory=0.9, outlier=1e6)
    sensitivity, noise, _ = linear_world(3, [0, 0], steps=60)
    belief = run(config, sensitivity, noise, np.array([9.0, -9.0]))
    np.testing.assert_allclose(belief.mean, [config.limits[0][1], config.limits[1][0]], atol=1e-6)
    for h in sensitivity:
        error = jnp.asarray(h @ (np.array([-0.4, 0.2]) - np.asarray(belief.mean)))
        belief = update(config, belief, jnp.asarray(h), error, SEEN)
    np.testing.assert_allclose(belief.mean, [-0.4, 0.2], atol=0.02)
    assert (np.sqrt(np.diag(np.linalg.inv(belief.information))) < 0.2).all()


def test_derivatives_match_finite_differences():
    with jax.enable_x64(True):
        sensitivity, noise, truth = linear_world(4, [0.3, -0.2], steps=1, noise=1e-3)
        h, belief = jnp.asarray(sensitivity[0]), prior_belief(AdaptationConfig())
        error = jnp.asarray(sensitivity[0] @ truth + noise[0])
        of = lambda e: update(AdaptationConfig(), belief, h, e, SEEN).mean  # noqa: E731
        way = jnp.asarray(np.random.default_rng(5).standard_normal((13, 2)))
        step = 1e-6
        numeric = (of(error + step * way) - of(error - step * way)) / (2 * step)
        forward = jax.jvp(of, (error,), (way,))[1]
        np.testing.assert_allclose(forward, numeric, rtol=1e-6, atol=1e-9)
        back = jax.vjp(of, error)[1](jnp.ones(2))[0]
        np.testing.assert_allclose(jnp.sum(back * way), forward.sum(), rtol=1e-9)


@pytest.mark.parametrize(
    "wrong",
    [
        {"memory": 0.0},
        {"prior_std": -1.0},
        {"limits": ((1.0, 0.1), (-1.0, 1.0))},
        {"limits": 1.0},
        {"prior_mean": 0.0},
        {"prior_mean": ("a", "b")},
    ],
)
def test_settings_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError, match="AdaptationConfig"):
        AdaptationConfig(**wrong)


def test_a_belief_has_the_type_of_the_observations():
    """Or a model in single precision would go on in double, and a loop over its steps fails."""
    with jax.enable_x64(True):
        sensitivity = jnp.full((13, 2, 2), 1e-2, jnp.float32)
        belief = prior_belief(AdaptationConfig(), jnp.float32)
        after = update(AdaptationConfig(), belief, sensitivity, jnp.full((13, 2), 1e-3, jnp.float32), SEEN)
        assert {leaf.dtype for one in (belief, after) for leaf in jax.tree.leaves(one)} == {np.dtype(np.float32)}
