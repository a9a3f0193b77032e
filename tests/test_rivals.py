"""The networks that the graph network is compared with, through the same model and training, and their weights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from cablejax.dynamics.graph import prior_of
from cablejax.dynamics.model import apply
from cablejax.dynamics.train import train
from cablejax.dynamics.weights import WeightsError, load_weights
from dynamics_cases import (
    SMALL,
    TINY_TRAINING,
    arched_history,
    as_float64,
    check_derivatives,
    moved_rigidly,
    rotation,
    trajectories,
    turned_twist,
)
from rivals import LSTM, WEIGHTS, BiLSTM, FlatMLP, WorldGNS, WorldMLP, load_any, on_another_cable

TWIST = jnp.asarray([[0.01, -0.02, 0.1], [-0.01, 0.01, -0.05]])
KINDS = (FlatMLP, BiLSTM)


def stirred(kind, seed=0):
    """A network of this kind whose weights are all random."""
    graphdef, weights = nnx.split(kind(SMALL, nnx.Rngs(seed)))
    rng = np.random.default_rng(seed)
    return graphdef, jax.tree.map(lambda w: w + 0.1 * rng.standard_normal(w.shape).astype(w.dtype), weights)


@pytest.mark.parametrize("kind", KINDS)
def test_untrained_it_is_its_prior_and_it_turns_with_the_cable(kind):
    history = arched_history(SMALL)
    model = stirred(kind)
    fresh = nnx.split(kind(SMALL, nnx.Rngs(0)))
    np.testing.assert_array_equal(apply(fresh, history, TWIST), prior_of(history, TWIST, SMALL).displacement)
    moved = apply(model, history, TWIST)
    assert np.abs(moved - prior_of(history, TWIST, SMALL).displacement).max() > 1e-4
    turned = apply(model, moved_rigidly(history, 0.7, np.array([0.3, -0.2])), turned_twist(TWIST, 0.7))
    np.testing.assert_allclose(turned, moved @ rotation(0.7).T, atol=2e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_match_finite_differences(kind):
    with jax.enable_x64(True):
        graphdef, weights = stirred(kind)
        history, weights = as_float64(arched_history(SMALL)), as_float64(weights)
        check_derivatives(
            lambda point: apply((graphdef, point[0]), point[1], point[2]), (weights, history, as_float64(TWIST))
        )


def test_the_recurrence_runs_both_ways_along_the_cable():
    x = jnp.asarray(np.random.default_rng(0).standard_normal((6, 3)), jnp.float32)
    for backwards, reached in ((False, range(3, 6)), (True, range(0, 4))):
        cell = LSTM(3, 4, backwards=backwards, rngs=nnx.Rngs(1))
        change = np.abs(cell(x.at[3].add(1.0)) - cell(x)).max(axis=1)
        assert set(np.flatnonzero(change > 0)) == set(reached)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [FlatMLP, BiLSTM, WorldMLP, WorldGNS])
def test_it_trains_like_the_graph_network(kind, tmp_path):
    result = train(TINY_TRAINING, trajectories(), tmp_path / "run", network=kind, progress=False)
    assert result.completed
    again = train(TINY_TRAINING, trajectories(), tmp_path / "run", network=kind, progress=False)
    jax.tree.map(np.testing.assert_array_equal, again.weights, result.weights)
    assert np.isfinite(apply((result.graphdef, result.weights), arched_history(SMALL), TWIST)).all()
    with pytest.raises(ValueError, match=r"differs in config\.model\.network"):
        train(TINY_TRAINING, trajectories(), tmp_path / "run", progress=False)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(folder.name, marks=pytest.mark.slow if folder.name.startswith("lstm") else ())
        for folder in sorted(WEIGHTS.iterdir())
    ],
)
def test_kept_weights_move_a_cable(name):
    model = load_any(name)
    history = arched_history(model.config)
    moved = model.dynamics(model.weights, history, TWIST)
    prior = prior_of(history, TWIST, model.config).displacement
    np.testing.assert_array_equal(moved[jnp.array([0, -1])], prior[jnp.array([0, -1])])
    assert 1e-5 < np.abs(moved - prior).max() < 0.05
    if name != "gns-rigid":
        with pytest.raises(WeightsError, match=r"experiments/rivals\.py"):
            load_weights(WEIGHTS / name)


def test_in_the_worlds_axes_a_network_sees_where_the_cable_is():
    history = arched_history(load_any("mlp-rigid-world").config)
    there = moved_rigidly(history, 0.0, np.array([0.3, -0.7]))
    for name, place_matters in (("mlp-rigid-world", True), ("mlp-rigid", False)):
        model = load_any(name)
        change = np.abs(
            model.dynamics(model.weights, there, TWIST) - model.dynamics(model.weights, history, TWIST)
        ).max()
        assert (change > 1e-4) == place_matters


def test_another_cable_is_read_by_what_shares_its_weights_along_the_cable():
    model = on_another_cable(load_any("lstm-static"), n_keypoints=9, length=0.7)
    assert model.dynamics(model.weights, arched_history(model.config), TWIST).shape == (9, 2)
    with pytest.raises(ValueError, match="cannot read 9"):
        on_another_cable(load_any("mlp-static"), n_keypoints=9, length=0.7)
