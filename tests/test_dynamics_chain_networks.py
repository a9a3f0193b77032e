"""The networks that the graph network is compared with, through the same model, training and files."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from cablejax.dynamics.graph import prior_of
from cablejax.dynamics.model import apply, make_network
from cablejax.dynamics.networks import LSTM
from cablejax.dynamics.train import train
from cablejax.dynamics.weights import load_weights, save_weights
from dynamics_cases import (
    SMALL,
    TINY_TRAINING,
    arched_history,
    as_float64,
    check_derivatives,
    moved_rigidly,
    resized,
    rotation,
    trajectories,
    turned_twist,
)

TWIST = jnp.asarray([[0.01, -0.02, 0.1], [-0.01, 0.01, -0.05]])
KINDS = ("mlp", "lstm")


def stirred(kind, seed=0):
    """A network of this kind whose weights are all random."""
    config = dataclasses.replace(SMALL, network=kind)
    graphdef, weights = nnx.split(make_network(config, nnx.Rngs(seed)))
    rng = np.random.default_rng(seed)
    return config, (graphdef, jax.tree.map(lambda w: w + 0.1 * rng.standard_normal(w.shape).astype(w.dtype), weights))


@pytest.mark.parametrize("kind", KINDS)
def test_untrained_it_is_its_prior_and_it_turns_with_the_cable(kind):
    history = arched_history(SMALL)
    config, model = stirred(kind)
    fresh = make_network(config, nnx.Rngs(0))
    np.testing.assert_array_equal(apply(fresh, history, TWIST), prior_of(history, TWIST, config).displacement)
    moved = apply(model, history, TWIST)
    assert np.abs(moved - prior_of(history, TWIST, config).displacement).max() > 1e-4
    turned = apply(model, moved_rigidly(history, 0.7, np.array([0.3, -0.2])), turned_twist(TWIST, 0.7))
    np.testing.assert_allclose(turned, moved @ rotation(0.7).T, atol=2e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_match_finite_differences(kind):
    with jax.enable_x64(True):
        _, (graphdef, weights) = stirred(kind)
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
@pytest.mark.parametrize("kind", KINDS)
def test_it_trains_and_is_saved_like_the_graph_network(kind, tmp_path):
    config = resized(TINY_TRAINING, network=kind)
    result = train(config, trajectories(), tmp_path / "run", progress=False)
    assert result.completed
    save_weights(tmp_path / "weights.safetensors", result.model, result.weights, {})
    read, graphdef, weights = load_weights(tmp_path)
    assert read == result.model and read.network == kind
    jax.tree.map(np.testing.assert_array_equal, weights, result.weights)
    history = arched_history(SMALL)
    np.testing.assert_array_equal(
        apply((graphdef, weights), history, TWIST), apply((result.graphdef, result.weights), history, TWIST)
    )


def test_another_kind_of_network_is_refused():
    with pytest.raises(ValueError, match="network"):
        dataclasses.replace(SMALL, network="cnn")
