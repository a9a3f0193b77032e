"""Pretrained encoders keep what the features say, and become part of the network that is trained afterwards."""

import dataclasses

import jax
import numpy as np
import pytest
from flax import nnx

from autoencoder import AutoEncoders, PretrainConfig, features, pretrain
from cablejax.dataset.windows import draw_windows
from cablejax.dynamics.graph import build_graph, prior_of
from cablejax.dynamics.model import apply
from cablejax.dynamics.networks import GNS
from cablejax.dynamics.normalisation import fit_normalisation
from cablejax.dynamics.train import train
from dynamics_cases import SMALL, TINY_TRAINING, arched_history, trajectories

DATA = trajectories()
FRESH = nnx.split(GNS(SMALL, nnx.Rngs(TINY_TRAINING.seed)))[1]


@pytest.fixture(scope="module")
def pretrained():
    return pretrain(TINY_TRAINING, DATA, PretrainConfig(steps=150, batch=8, lr_start=1e-2), progress=False)


@pytest.mark.slow
def test_auto_encoders_learn_to_reconstruct(pretrained):
    early = pretrain(TINY_TRAINING, DATA, PretrainConfig(steps=1, batch=8), progress=False)
    assert early.node_error > 0.8 and early.edge_error > 0.8
    assert pretrained.node_error < 0.7 * early.node_error
    assert pretrained.edge_error < 0.3 * early.edge_error


def test_encoders_and_decoder_are_replaced_and_the_processor_is_not(pretrained):
    flat = {key: value.get_value() for key, value in nnx.to_flat_state(pretrained.weights)}
    changed = {key for key, value in nnx.to_flat_state(FRESH) if not np.array_equal(value.get_value(), flat[key])}
    assert {key[0] for key in changed} == {"node_encoder", "edge_encoder", "decoder"}
    assert jax.tree.structure(pretrained.weights) == jax.tree.structure(FRESH)
    assert not flat[("decoder", "rest", 0, "kernel")].any(), "what has another shape in psi starts at zero"


def test_training_begins_at_the_prior(pretrained):
    history, twist = arched_history(SMALL), np.full((2, 3), 0.02, np.float32)
    graphdef = nnx.split(GNS(SMALL, nnx.Rngs(0)))[0]
    model = (graphdef, pretrained.weights)
    moved, prior = jax.jit(lambda history: (apply(model, history, twist), prior_of(history, twist, SMALL)))(history)
    np.testing.assert_array_equal(moved, prior.displacement)


@pytest.mark.slow
def test_pretraining_repeats_to_the_bit_and_training_goes_on_from_it(pretrained, tmp_path):
    again = pretrain(TINY_TRAINING, DATA, PretrainConfig(steps=150, batch=8, lr_start=1e-2), progress=False)
    jax.tree.map(np.testing.assert_array_equal, again.weights, pretrained.weights)
    config = dataclasses.replace(TINY_TRAINING, ema=0.0)
    result = train(config, DATA, tmp_path / "run", initial=(pretrained.model, pretrained.weights), progress=False)
    kernel = ("node_encoder", "first", 0, "kernel")
    of = {
        name: dict(nnx.to_flat_state(w))[kernel].get_value()
        for name, w in (("before", pretrained.weights), ("after", result.weights), ("fresh", FRESH))
    }
    assert np.abs(of["after"] - of["before"]).max() < 0.1 * np.abs(of["fresh"] - of["before"]).max()
    with pytest.raises(ValueError, match=r"differs in .*data"):
        train(config, DATA, tmp_path / "run", progress=False)


def test_features_are_those_of_the_graphs_row_by_row():
    config = dataclasses.replace(SMALL, normalisation=fit_normalisation(DATA, SMALL))
    windows = draw_windows(jax.random.key(0), DATA, batch=3, history=3, steps=1)
    last = jax.tree.map(lambda x: x[2], windows)

    @jax.jit
    def of_both(windows, last):
        graph = build_graph(last.history, last.twist[0], prior_of(last.history, last.twist[0], config), config)
        return features(windows, config), graph

    (nodes, edges), graph = of_both(windows, last)
    np.testing.assert_allclose(nodes[-config.n_keypoints :], graph.nodes, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(edges[-len(graph.senders) :], graph.edges, rtol=1e-4, atol=1e-4)
    pair = AutoEncoders(GNS(config, nnx.Rngs(0)), nnx.Rngs(1))
    again_v, again_e = pair(nodes, edges)
    assert again_v.shape == nodes.shape and again_e.shape == edges.shape


def test_impossible_pretraining_is_refused():
    with pytest.raises(ValueError, match="steps is 0"):
        PretrainConfig(steps=0)
    with pytest.raises(ValueError, match=r"lr_end is 0\.0, expected a number from"):
        PretrainConfig(lr_end=0.0)
    with pytest.raises(ValueError, match="another cable"):
        pretrain(TINY_TRAINING, trajectories(n=6), progress=False)
