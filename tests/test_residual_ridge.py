import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cablejax.residual
from cablejax.residual import Corrected, RidgeConfig, apply, zero_residual
from cablejax.residual.ridge import BIAS_SCALE

W, N, Q = 5, 4, 2
# one program for each shape of a window: op by op, every line would be compiled by itself
fit = jax.jit(cablejax.residual.fit, static_argnums=3)


def window(seed=0, motion=0.03, n=W):
    """Random commands of a realistic size and errors of a few millimetres."""
    rng = np.random.default_rng(seed)
    twist = rng.normal(size=(n, Q, 3)) * motion
    return jnp.asarray(rng.normal(size=(n, N, 2)) * 3e-3), jnp.asarray(twist), jnp.ones(n, bool)


def scaled_regressors(twist, config):
    units = np.array([config.motion_scale] * 2 + [config.motion_scale / config.rotation_weight])
    rows = np.asarray(twist).reshape(len(twist), -1) / np.tile(units, Q)
    if config.bias:
        rows = np.concatenate([rows, np.full((len(rows), 1), BIAS_SCALE)], axis=1)
    return rows


def primal_prediction(delta, twist, weight, config, query):
    """The textbook solution (A'WA + lambda I)^-1 A'W dX, in the inputs' space."""
    rows = scaled_regressors(twist, config)
    gram = rows.T @ (weight[:, None] * rows) + config.regularisation * np.eye(rows.shape[1])
    coefficients = np.linalg.solve(gram, rows.T @ (weight[:, None] * np.asarray(delta).reshape(len(rows), -1)))
    return (scaled_regressors(query[None], config) @ coefficients).reshape(N, 2)


@pytest.mark.parametrize("bias", [False, True])
@pytest.mark.parametrize("n", [3, 5, 9])
def test_dual_form_equals_primal_form(bias, n):
    config = RidgeConfig(bias=bias, forgetting=0.8)
    with jax.enable_x64(True):
        delta, twist, valid = window(n=n)
        weight = 0.8 ** np.arange(n - 1, -1, -1)
        query = np.asarray(twist)[0] * 0.7
        expected = primal_prediction(delta, twist, weight, config, query)
        np.testing.assert_allclose(apply(fit(delta, twist, valid, config), query), expected, rtol=1e-9, atol=1e-15)


def test_recovers_an_affine_error():
    config = RidgeConfig(regularisation=1e-4)
    rng = np.random.default_rng(1)
    gain, bias = rng.normal(size=(3 * Q, 2 * N)) * 0.1, rng.normal(size=2 * N) * 2e-3
    _, twist, valid = window(n=12)
    delta = (np.asarray(twist).reshape(12, -1) @ gain + bias).reshape(12, N, 2)
    model = fit(jnp.asarray(delta), twist, valid, config)
    np.testing.assert_allclose(model.gain, gain, atol=2e-3)
    np.testing.assert_allclose(model.bias, bias, atol=2e-5)


def test_seeds_penalty_of_ten_shrinks_mildly_at_full_speed_and_strongly_at_a_crawl():
    """Each input on its own, W samples of one size: the gain is what it should be times s / (s + lambda)."""
    config = RidgeConfig(bias=False)

    def shrinkage(motion):
        twist = jnp.zeros((W, Q, 3)).at[:, :, 0].set(motion)
        delta = 0.1 * twist[:, :1, :1] * jnp.ones((W, N, 2))
        return float(apply(fit(delta, twist, jnp.ones(W, bool), config), twist[0])[0, 0] / (0.1 * motion))

    assert shrinkage(0.05) == pytest.approx(250 / 260, rel=1e-4)
    assert shrinkage(0.01) == pytest.approx(10 / 20, rel=1e-4)
    assert shrinkage(0.001) < 0.02


def test_bias_carries_an_error_that_stays_when_the_grippers_are_still():
    error = jnp.full((W, N, 2), 2e-3)
    still, valid = jnp.zeros((W, Q, 3)), jnp.ones(W, bool)
    with_bias = apply(fit(error, still, valid, RidgeConfig()), still[0])
    np.testing.assert_allclose(with_bias, 125 / 135 * error[0], rtol=1e-5)
    without = apply(fit(error, still, valid, RidgeConfig(bias=False)), still[0])
    np.testing.assert_allclose(without, 0.0)


def test_empty_window_corrects_nothing():
    delta, twist, _ = window()
    model = fit(delta * jnp.nan, twist, jnp.zeros(W, bool), RidgeConfig())
    np.testing.assert_array_equal(model.gain, 0.0)
    np.testing.assert_array_equal(model.bias, 0.0)
    np.testing.assert_array_equal(apply(zero_residual(N), twist[0]), 0.0)


def test_half_full_window_is_the_fit_to_what_is_there():
    delta, twist, valid = window()
    valid = valid.at[:2].set(False)
    masked = fit(delta.at[:2].set(jnp.nan), twist, valid, RidgeConfig())
    short = fit(delta[2:], twist[2:], valid[2:], RidgeConfig())
    np.testing.assert_allclose(masked.gain, short.gain, rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(masked.bias, short.bias, rtol=1e-5, atol=1e-8)


def test_a_keypoint_that_was_hidden_learns_from_its_other_samples_and_leaves_the_rest_alone():
    delta, twist, valid = window()
    everywhere = jnp.broadcast_to(valid[:, None], (W, N))
    hidden = fit(delta.at[3, 1].set(jnp.nan), twist, everywhere.at[3, 1].set(False), RidgeConfig())
    full = fit(delta, twist, valid, RidgeConfig())
    without = fit(delta, twist, valid.at[3].set(False), RidgeConfig())
    gain = [m.gain.reshape(3 * Q, N, 2) for m in (hidden, full, without)]
    np.testing.assert_allclose(gain[0][:, [0, 2, 3]], gain[1][:, [0, 2, 3]], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(gain[0][:, 1], gain[2][:, 1], rtol=1e-4, atol=1e-6)


def test_forgetting_follows_the_newest_sample():
    twist = jnp.zeros((W, Q, 3))
    delta = jnp.zeros((W, N, 2)).at[-1].set(1e-3)
    valid = jnp.ones(W, bool)
    even, recent = (fit(delta, twist, valid, RidgeConfig(forgetting=f)).bias for f in (1.0, 0.5))
    assert (recent > 2 * even).all()


def test_a_model_on_another_branch_is_not_carried_over_the_horizon():
    config = RidgeConfig(outlier=0.02)
    delta, twist, valid = window()
    lost = jnp.full_like(delta, 0.06)
    rest = np.zeros((Q, 3))
    assert np.abs(apply(fit(lost, twist, valid, config), rest)).max() < 0.05 * 0.06
    assert np.abs(apply(fit(lost, twist, valid, RidgeConfig()), rest)).max() > 0.5 * 0.06
    # errors of millimetres are corrected as they would be without a bound
    np.testing.assert_allclose(
        apply(fit(delta, twist, valid, config), rest), apply(fit(delta, twist, valid, RidgeConfig()), rest), atol=2e-4
    )
    # one lost sample among good ones leaves them what they say
    mixed = apply(fit(delta.at[2].set(0.3), twist, valid, config), rest)
    np.testing.assert_allclose(mixed, apply(fit(delta, twist, valid.at[2].set(False), config), rest), atol=2e-4)


@pytest.mark.parametrize("bias", [False, True])
def test_gradients(bias):
    """Central differences in float64, and JVP against VJP, through fit and prediction."""
    config = RidgeConfig(bias=bias, forgetting=0.9, outlier=5e-3)
    with jax.enable_x64(True):
        delta, twist, valid = window(3)
        query = twist[0] + 0.01

        @jax.jit
        def predict(delta, twist):
            return apply(fit(delta, twist, valid.at[0].set(False), config), query)

        rng = np.random.default_rng(4)
        tangent = (jnp.asarray(rng.normal(size=delta.shape)), jnp.asarray(rng.normal(size=twist.shape)))
        cotangent = jnp.asarray(rng.normal(size=(N, 2)))
        _, forward = jax.jvp(predict, (delta, twist), tangent)
        step = 1e-6
        sides = [predict(delta + s * step * tangent[0], twist + s * step * tangent[1]) for s in (1, -1)]
        central = (sides[0] - sides[1]) / (2 * step)
        assert np.linalg.norm(forward - central) <= 1e-5 * np.linalg.norm(central)
        pullback = jax.vjp(predict, delta, twist)[1](cotangent)
        backward = sum(jnp.vdot(a, b) for a, b in zip(pullback, tangent, strict=True))
        assert abs(backward - jnp.vdot(cotangent, forward)) <= 1e-8 * abs(backward)


def test_gradient_is_finite_where_nothing_moved():
    still = jnp.zeros((W, Q, 3))
    grads = jax.grad(lambda d, r: fit(d, r, jnp.ones(W, bool), RidgeConfig()).gain.sum(), argnums=(0, 1))(
        jnp.full((W, N, 2), 1e-3), still
    )
    assert all(np.isfinite(g).all() for g in grads)


def test_batches_over_cables():
    deltas, twists, valids = (jnp.stack(x) for x in zip(*(window(s) for s in range(3)), strict=True))
    batched = jax.jit(jax.vmap(lambda d, r, v: fit(d, r, v, RidgeConfig())))(deltas, twists, valids)
    for i in range(3):
        single = fit(deltas[i], twists[i], valids[i], RidgeConfig())
        np.testing.assert_allclose(batched.gain[i], single.gain, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"regularisation": 0.0}, "regularisation"),
        ({"motion_scale": float("nan")}, "motion_scale"),
        ({"forgetting": 0.0}, "forgetting"),
        ({"outlier": "a"}, r"outlier is 'a', expected a number .* with infinity all count fully"),
    ],
)
def test_impossible_settings_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(RidgeConfig(), **change)


def test_shapes_that_do_not_belong_together_are_refused():
    delta, twist, valid = window()
    with pytest.raises(ValueError, match=r"expected delta \[W, N, 2\]"):
        fit(delta, twist[1:], valid, RidgeConfig())
    with pytest.raises(ValueError, match=r"expected delta \[W, N, 2\]"):
        fit(delta[:, 0, 0], twist, valid, RidgeConfig())
    with pytest.raises(ValueError, match=r"twist \[W, Q, 3\]"):
        fit(delta, jnp.concatenate([twist, twist], axis=2), valid, RidgeConfig())


def test_corrected_dynamics_is_the_sum_of_both():
    delta, twist, valid = window()
    model = fit(delta, twist, valid, RidgeConfig())

    def offline(weights, history, twist):
        return weights * jnp.ones((N, 2))

    total = Corrected(offline)((2.0, model), None, twist[0])
    np.testing.assert_allclose(total, 2.0 + apply(model, twist[0]), rtol=1e-6)
