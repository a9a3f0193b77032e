"""The network: shapes, symmetry, exact ends, and derivatives of a rollout."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.evaluate import predict
from cablejax.dynamics.graph import cable_topology, prior_of
from cablejax.dynamics.model import bind
from cablejax.dynamics.networks import GNS, aggregate, gather
from dynamics_cases import (
    SMALL,
    arched_history,
    as_float64,
    check_derivatives,
    moved_rigidly,
    network,
    rotation,
    straight_history,
    turned_twist,
)

TWIST = jnp.array([[0.01, -0.02, 0.1], [-0.03, 0.005, -0.2]])
STATIC = ModelConfig(history=3, latent=8, hidden=8, hidden_layers=1, message_passing=2)
COMMANDS = np.array([[[0.02, -0.01, 0.1], [-0.015, 0.02, -0.08]], [[0.01, 0.0, 0.0], [-0.02, 0.01, 0.1]]])


def test_an_untrained_network_is_its_prior():
    history = arched_history(SMALL)
    untrained = bind(*nnx.split(GNS(SMALL, nnx.Rngs(0))))
    moved, prior = jax.jit(lambda history: (untrained(history, TWIST), prior_of(history, TWIST, SMALL)))(history)
    np.testing.assert_array_equal(moved, prior.displacement)


def test_grasped_ends_follow_the_grippers_exactly_and_the_rest_is_predicted():
    history = arched_history(SMALL)
    moved = jax.jit(bind(*network(SMALL)))(history, TWIST)
    assert moved.shape == (SMALL.n_keypoints, 2) and moved.dtype == history.keypoints.dtype
    np.testing.assert_array_equal(moved[jnp.array([0, -1])], TWIST[:, :2])
    beyond = moved - prior_of(history, TWIST, SMALL).displacement
    assert (np.abs(beyond[1:-1]) > 1e-6).all()


@pytest.mark.parametrize("config", [SMALL, STATIC], ids=["rigid", "static"])
def test_prediction_turns_and_shifts_with_the_cable(config):
    with jax.enable_x64(True):
        graphdef, weights = network(config)
        model = jax.jit(bind(graphdef, as_float64(weights)))
        history, angle, twist = arched_history(config), 0.9, jnp.asarray(COMMANDS[0])
        here = model(history, twist)
        there = model(moved_rigidly(history, angle, np.array([-0.4, 1.3])), turned_twist(twist, angle))
        np.testing.assert_allclose(here @ rotation(angle).T, there, atol=1e-9)


def test_a_history_of_another_length_is_refused():
    history = arched_history(SMALL)
    longer = dataclasses.replace(history, keypoints=jnp.concatenate([history.keypoints[:1], history.keypoints]))
    with pytest.raises(ValueError, match=r"expected .*: this model looks back on"):
        bind(*network(SMALL))(longer, TWIST)


def test_batches_by_vmap_give_what_single_cables_give():
    model = jax.jit(bind(*network(SMALL)))
    histories = [arched_history(SMALL, seed) for seed in range(3)]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *histories)
    together = jax.jit(jax.vmap(model, (0, None)))(batch, TWIST)
    for history, moved in zip(histories, together, strict=True):
        np.testing.assert_allclose(model(history, TWIST), moved, atol=1e-6)


def test_shifted_slices_gather_and_aggregate_like_indices():
    topology, n = cable_topology(6, 1.0, 0.45), 6
    rng = np.random.default_rng(0)
    sent, received = rng.standard_normal((2, n, 3))
    messages = rng.standard_normal((len(topology.senders), 3))
    expected = np.zeros((n, 3))
    np.add.at(expected, topology.receivers, messages)
    np.testing.assert_allclose(aggregate(jnp.asarray(messages), topology.offsets, n), expected, atol=1e-6)
    np.testing.assert_allclose(
        gather(jnp.asarray(sent), jnp.asarray(received), topology.offsets),
        sent[topology.senders] + received[topology.receivers],
        atol=1e-6,
    )


def test_every_message_passing_step_reaches_its_radius_further():
    config = dataclasses.replace(SMALL, n_keypoints=9, radius=0.125, message_passing=3, history=1)
    model = jax.jit(bind(*network(config)))
    history = arched_history(config)

    def far_end(x0):
        keypoints = history.keypoints.at[-1, 1].add(x0)
        return model(dataclasses.replace(history, keypoints=keypoints), TWIST)

    reached = np.abs(jax.jit(jax.jacfwd(far_end))(jnp.zeros(2))).sum(axis=(1, 2)) > 0
    # node 1 through three steps of one neighbour each, one more through the edges that encode its position
    assert reached[1:5].all() and not reached[6:].any()


@pytest.mark.parametrize("where", ["arched", "straight"])
@pytest.mark.parametrize(
    "config", [pytest.param(SMALL, id="rigid", marks=pytest.mark.slow), pytest.param(STATIC, id="static")]
)
def test_gradient_of_a_rollout_against_central_differences(config, where):
    with jax.enable_x64(True):
        graphdef, weights = network(config)
        history = arched_history(config) if where == "arched" else straight_history(config)
        commands = jnp.asarray(COMMANDS)
        if where == "straight":
            # inwards: a straight cable cannot be pulled longer
            commands = jnp.abs(commands) * jnp.array([1.0, 0.1, 0.1]) * jnp.array([[1.0], [-1.0]])

        def shapes(point):
            weights, history, commands = point
            return predict(bind(graphdef, weights), history, commands)

        check_derivatives(shapes, (as_float64(weights), history, commands), step=1e-7, seeds=(0, 1))


@pytest.mark.parametrize(("setting", "value"), [("symmetric", "no"), ("conditioned", 1), ("message_passing", 1000)])
def test_settings_that_are_no_settings_are_refused(setting, value):
    with pytest.raises(ValueError, match=f"ModelConfig.{setting} is {value!r}"):
        ModelConfig(**{setting: value})
