import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.residual import PAPER, Candidate, LearnerConfig, RidgeConfig, apply, fit
from cablejax.residual.jacobian import Linearised
from cablejax.residual.learner import Sample, initial_learner, learned, observe, weights

N, Q = 13, 2
CONFIG = LearnerConfig()
NONE, DRIFT, RIDGE, DRIFT_RIDGE, RESPONSE, BOTH = range(6)


def steps(kind, n=40, seed=0):
    """Samples of a plant that the model is right about but for one thing, with 0.1 mm of noise."""
    rng = np.random.default_rng(seed)
    wrong, course = rng.normal(size=(Q * 3, N * 2)) * 0.1, rng.normal(size=(Q, 3)) * 0.03
    share = np.linspace(0.0, 1.0, N)[:, None]
    # what a model gets wrong at rest shows where the grippers creep
    pace = 0.02 if kind == "drift" else 1.0
    for _ in range(n):
        # a gripper that is under way keeps its course, more or less
        twist = pace * (course + rng.normal(size=(Q, 3)) * 0.01)
        drift = rng.normal(size=(1, 2)) * 1e-3 + rng.normal(size=(N, 2)) * 1e-3
        gain = rng.normal(size=(N, 2, Q, 3))
        error = {
            "nothing": 0.0 * drift,
            "drift": -drift,
            "response": -share * np.einsum("ncqk,qk->nc", gain, twist),
            "gain": (twist.ravel() @ wrong).reshape(N, 2),
        }[kind]
        yield Sample(
            jnp.asarray(error + rng.normal(size=(N, 2)) * 1e-4),
            jnp.asarray(twist),
            jnp.ones(N, bool),
            Linearised(jnp.asarray(drift), jnp.asarray(gain)),
        )


@functools.cache
def compiled(config):
    return jax.jit(functools.partial(observe, config)), jax.jit(functools.partial(learned, config))


def after(samples, config=CONFIG):
    state = initial_learner(config, N, Q, jnp.float32)
    for sample in samples:
        state = compiled(config)[0](state, sample)
    return state


@pytest.mark.parametrize(
    ("kind", "believed", "share"),
    [
        ("nothing", (NONE, DRIFT, RESPONSE, BOTH), 0.65),
        ("drift", (DRIFT, DRIFT_RIDGE, BOTH), 0.99),
        ("gain", (RIDGE, DRIFT_RIDGE), 0.95),
        ("response", (RESPONSE, BOTH), 0.99),
    ],
)
def test_what_has_predicted_well_is_believed_and_the_mixture_is_never_much_worse_than_the_best(kind, believed, share):
    state = after(steps(kind))
    assert float(weights(CONFIG, state)[jnp.array(believed)].sum()) > share
    *candidates, mixture = np.asarray(state.loss)
    # it starts undecided, and loses what no correction loses in a step
    assert mixture <= 1.1 * min(candidates) + candidates[NONE] / 40
    if kind != "nothing":
        assert mixture < 0.5 * candidates[NONE]


def test_where_friction_holds_the_cable_the_corrected_model_predicts_no_motion_at_rest():
    state = after(steps("drift"))
    drift = jnp.asarray(np.random.default_rng(1).normal(size=(N, 2)) * 1e-3)
    model = Linearised(drift, jnp.zeros((N, 2, Q, 3)))
    moved = drift + apply(compiled(CONFIG)[1](state, model), jnp.zeros((Q, 3)))
    assert float(jnp.abs(moved).max()) < 0.05 * float(jnp.abs(drift).max())


def test_a_keypoint_that_friction_holds_is_predicted_to_stay_and_one_at_a_gripper_to_follow():
    *before, last = steps("response")
    model = compiled(CONFIG)[1](after(before), last.model)
    response = np.einsum("ncqk,qk->nc", last.model.gain, last.twist)
    held = np.asarray(apply(model, last.twist)) / -response
    np.testing.assert_allclose(held[[0, 6, 12]], np.array([[0.0], [0.5], [1.0]]) * np.ones(2), atol=0.05)
    np.testing.assert_allclose(apply(model, last.twist), last.error, atol=0.1 * np.abs(response).max())


def test_where_the_grippers_creep_the_response_is_learned_as_no_ridge_can():
    """Of 2 mm a step, ten samples."""
    slow = [
        s._replace(twist=s.twist / 15, error=s.error / 15, model=s.model._replace(drift=s.model.drift * 0.0))
        for s in steps("response", 10)
    ]
    ridge = LearnerConfig((Candidate(ridge=RidgeConfig(bias=False)),))
    ours, none = np.asarray(after(slow).loss)[[-1, 0]]
    assert ours < 0.35 * none
    assert float(after(slow, ridge).loss[-1]) > 0.7 * none


def test_a_single_candidate_is_the_papers_ridge():
    samples = list(steps("gain", 5))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *samples)
    expected = fit(stacked.error, stacked.twist, stacked.valid, RidgeConfig(bias=False))
    model = compiled(PAPER)[1](after(samples, PAPER), samples[-1].model)
    np.testing.assert_allclose(model.gain, expected.gain, rtol=1e-5, atol=1e-7)
    assert (np.asarray(model.bias) == 0).all()


def test_one_snap_through_does_not_stay_in_the_evidence_and_what_was_not_seen_is_none():
    calm = list(steps("drift"))
    lost = calm[30]._replace(error=calm[30].error + 0.1)
    blind = calm[31]._replace(error=calm[31].error * jnp.nan, valid=jnp.zeros(N, bool))
    state = after([*calm[:30], lost, blind])
    assert float(state.count) == pytest.approx(float(after([*calm[:30], lost]).count))
    again = after([*calm[:30], lost, blind, *calm[32:], *calm])
    np.testing.assert_allclose(weights(CONFIG, again), weights(CONFIG, after([*calm, *calm])), atol=0.02)
    assert np.isfinite(again.loss).all()


def test_what_is_not_finite_and_not_seen_leaves_no_trace():
    calm = list(steps("drift"))
    blind = calm[31]._replace(error=calm[31].error * jnp.nan, twist=calm[31].twist * jnp.nan, valid=jnp.zeros(N, bool))
    wild = calm[31]._replace(error=jnp.full_like(calm[31].error, 1e30))
    for one in (blind, wild):
        state = after([*calm[:30], one, *calm[32:]])
        assert np.isfinite(state.evidence).all() and np.isfinite(weights(CONFIG, state)).all()


def test_gradients_match_finite_differences():
    with jax.enable_x64(True):
        samples = jax.tree.map(lambda *leaves: jnp.stack(leaves), *steps("gain", 6))
        probe = jnp.asarray(np.random.default_rng(2).normal(size=(Q, 3)) * 0.02)

        def displacement(inputs):
            error, drift, gain = inputs
            state = initial_learner(CONFIG, N, Q, jnp.float64)
            for i in range(6):
                model = jax.tree.map(lambda leaf, i=i: leaf[i], samples.model)
                state = observe(CONFIG, state, Sample(error[i], samples.twist[i], samples.valid[i], model))
            return apply(learned(CONFIG, state, Linearised(drift, gain)), probe)

        rng = np.random.default_rng(3)
        at = samples.error, samples.model.drift[-1], samples.model.gain[-1]
        along = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape) * 1e-3), at)
        f = jax.jit(displacement)
        _, tangent = jax.jvp(f, (at,), (along,))

        def moved(by):
            return f(jax.tree.map(lambda a, d: a + by * d, at, along))

        ahead, behind = moved(1e-3), moved(-1e-3)
        np.testing.assert_allclose(tangent, (ahead - behind) / 2e-3, rtol=1e-5, atol=1e-9)
        cotangent = jnp.asarray(rng.normal(size=(N, 2)))
        (pulled,) = jax.vjp(f, at)[1](cotangent)
        back = sum(jnp.vdot(a, d) for a, d in zip(pulled, along, strict=True))
        np.testing.assert_allclose(back, jnp.vdot(cotangent, tangent), rtol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"candidates": ()}, "expected one `Candidate` or more"),
        ({"candidates": (RidgeConfig(),)}, "expected one `Candidate` or more"),
        ({"candidates": 3}, "expected one `Candidate` or more"),
        ({"window": 0}, "window is 0, expected a whole number from 1"),
        ({"error_std": 0.0}, "error_std is 0.0, expected"),
        ({"memory": 1.5}, "memory is 1.5"),
    ],
)
def test_impossible_settings_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        LearnerConfig(**change)


@pytest.mark.parametrize("interval", [0.1, 5.0])
def test_the_same_motions_teach_the_same_in_steps_of_any_duration(interval):
    samples, config = list(steps("gain", 6)), LearnerConfig()
    faster = [
        s._replace(twist=s.twist / interval, model=s.model._replace(gain=s.model.gain * interval)) for s in samples
    ]
    one, other = after(samples, config), after(faster, config.scaled(1.0, interval))
    np.testing.assert_allclose(other.loss, one.loss, rtol=1e-4)


def test_a_longer_cable_is_learned_like_a_short_one():
    config = LearnerConfig((Candidate(), Candidate(response=True), Candidate(ridge=RidgeConfig(outlier=0.02)))).scaled(
        2.0
    )
    assert config.candidates[2].ridge == RidgeConfig(motion_scale=0.02, rotation_weight=0.3, outlier=0.04)
    samples = list(steps("gain", 6))
    double = [
        s._replace(
            error=2 * s.error,
            twist=s.twist * jnp.array([2.0, 2.0, 1.0]),
            model=Linearised(2 * s.model.drift, s.model.gain * jnp.array([1.0, 1.0, 2.0])),
        )
        for s in samples
    ]
    one, two = (
        after(
            samples, LearnerConfig((Candidate(), Candidate(response=True), Candidate(ridge=RidgeConfig(outlier=0.02))))
        ),
        after(double, config),
    )
    np.testing.assert_allclose(two.loss, one.loss, rtol=1e-4)
