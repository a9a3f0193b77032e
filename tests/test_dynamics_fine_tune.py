"""A model conditioned on the cable, and trainings that start from another."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.dynamics.config import Normalisation
from cablejax.dynamics.fine_tune import starting_from
from cablejax.dynamics.model import apply
from cablejax.dynamics.train import train
from cablejax.dynamics.weights import load_weights, save_weights
from cablejax.types import REFERENCE_FRICTION, REFERENCE_STIFFNESS, advance, cable_descriptor
from dynamics_cases import SMALL, TINY_TRAINING, arched_history, network, resized, trajectories

TWIST = jnp.asarray([[0.01, -0.02, 0.1], [-0.01, 0.01, -0.05]])
TRAINED = dataclasses.replace(SMALL, normalisation=Normalisation(position=0.31))
CONDITIONED = dataclasses.replace(SMALL, conditioned=True)


def test_descriptor_of_the_reference_cable_is_zero_and_no_table_is_finite():
    np.testing.assert_allclose(cable_descriptor(*np.array([REFERENCE_STIFFNESS, REFERENCE_FRICTION])), 0.0, atol=1e-6)
    np.testing.assert_allclose(
        cable_descriptor(*np.array([2 * REFERENCE_STIFFNESS, 0.0])), [np.log(2), np.log(1e-3)], rtol=1e-5
    )


@pytest.fixture
def trained(tmp_path):
    graphdef, weights = network(TRAINED)
    save_weights(tmp_path / "trained.safetensors", TRAINED, weights, {})
    return tmp_path / "trained.safetensors", (graphdef, weights)


@pytest.mark.slow
def test_a_conditioned_model_starts_as_the_model_it_came_from_and_learns_to_listen(trained, tmp_path):
    path, model = trained
    config, weights = starting_from(path, CONDITIONED)
    assert config.normalisation == TRAINED.normalisation and config.conditioned
    training = resized(TINY_TRAINING, conditioned=True)
    data = dataclasses.replace(trajectories(), cable=np.array([[0.5, 0], [0, 1], [-1, 0], [0, 0]], np.float32))
    result = train(training, data, tmp_path / "run", initial=(config, weights), progress=False)
    assert result.model == config, "its scales stay"

    def moved(weights, cable):
        history = dataclasses.replace(arched_history(SMALL), cable=jnp.asarray(cable))
        assert advance(history, jnp.zeros((5, 2)), TWIST).cable is history.cable
        return np.asarray(apply((result.graphdef, weights), history, TWIST))

    before = apply(model, arched_history(SMALL), TWIST)
    np.testing.assert_allclose(moved(weights, [1.0, -1.0]), before, atol=1e-7)
    assert np.abs(moved(result.weights, [1.0, -1.0]) - moved(result.weights, [0.0, 0.0])).max() > 0


@pytest.mark.parametrize("conditioned", [False, True])
def test_what_started_symmetric_predicts_the_same_and_learns_a_side(tmp_path, conditioned):
    symmetric = dataclasses.replace(TRAINED, symmetric=True)
    graphdef, weights = network(symmetric)
    path = tmp_path / "symmetric.safetensors"
    save_weights(path, symmetric, weights, {})
    config, weights = starting_from(path, dataclasses.replace(SMALL, conditioned=conditioned))
    assert not config.symmetric
    known = jnp.asarray([0.3, -0.4]) if conditioned else None
    history = dataclasses.replace(arched_history(SMALL), cable=known)
    before = apply((graphdef, load_weights(path)[2]), arched_history(SMALL), TWIST)
    np.testing.assert_allclose(apply((network(config)[0], weights), history, TWIST), before, atol=1e-7)


def test_what_does_not_fit_is_refused(trained, tmp_path):
    path, _ = trained
    with pytest.raises(ValueError, match=r"latent is 8 in that model and 16 here\. Only adding `conditioned` and"):
        starting_from(path, dataclasses.replace(SMALL, latent=16))
    with pytest.raises(
        ValueError, match=r"symmetric is False in that model and True here\. .* and dropping `symmetric`"
    ):
        starting_from(path, dataclasses.replace(SMALL, symmetric=True))
    with pytest.raises(ValueError, match="conditioned model is trained with a descriptor"):
        train(resized(TINY_TRAINING, conditioned=True), trajectories(), tmp_path / "run", progress=False)
    with pytest.raises(ValueError, match=r"needs History\.cable"):
        apply(network(CONDITIONED), arched_history(SMALL), TWIST)
    with pytest.raises(ValueError, match="starting_from"):
        train(
            TINY_TRAINING,
            trajectories(),
            tmp_path / "other",
            initial=(CONDITIONED, network(CONDITIONED)[1]),
            progress=False,
        )
