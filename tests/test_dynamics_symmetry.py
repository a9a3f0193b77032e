"""Tied weights: a mirrored cable, and one counted from its other end, move alike."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from autoencoder import PretrainConfig, pretrain
from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.model import apply
from cablejax.dynamics.networks import GNS
from cablejax.dynamics.symmetry import initially_symmetric, symmetrised
from cablejax.dynamics.train import train
from cablejax.types import History
from dynamics_cases import SMALL, TINY_TRAINING, arched_history, trajectories

CONFIG = ModelConfig(n_keypoints=9, radius=0.3, latent=16, hidden=24, message_passing=2, symmetric=True)
TWIST = jnp.array([[0.01, -0.02, 0.1], [-0.03, 0.005, -0.2]])


def mirrored(history: History, twist):
    flip, flip_pose = jnp.array([1.0, -1.0]), jnp.array([1.0, -1.0, -1.0])
    return dataclasses.replace(
        history, keypoints=history.keypoints * flip, gripper_pose=history.gripper_pose * flip_pose
    ), twist * flip_pose


def reversed_(history: History, twist):
    pose = history.gripper_pose[::-1] + jnp.array([0.0, 0.0, jnp.pi])
    return dataclasses.replace(history, keypoints=history.keypoints[:, ::-1], gripper_pose=pose), twist[::-1]


def random_network(config: ModelConfig, seed: int):
    """Tied weights, none of them zero."""
    graphdef, weights = nnx.split(GNS(config, nnx.Rngs(seed)))
    leaves, tree = jax.tree.flatten(weights)
    keys = jax.random.split(jax.random.key(seed), len(leaves))
    noisy = [
        leaf + 0.3 * jax.random.normal(key, leaf.shape, leaf.dtype) for key, leaf in zip(keys, leaves, strict=True)
    ]
    return graphdef, symmetrised(jax.tree.unflatten(tree, noisy), config)


def swaying_history(config: ModelConfig) -> History:
    """A cable that is neither its mirror image nor its reversal, and moves."""
    history = arched_history(config)
    ripple = 0.01 * np.random.default_rng(0).standard_normal(history.keypoints.shape)
    ripple[:, [0, -1]] = 0.0
    cable = jnp.array([0.3, -0.5]) if config.conditioned else None
    return dataclasses.replace(history, keypoints=history.keypoints + ripple, cable=cable)


@pytest.mark.parametrize("conditioned", [False, True])
@pytest.mark.parametrize("prior", ["none", "rigid", "static"])
def test_mirrored_and_reversed_cables_move_alike(prior, conditioned):
    with jax.enable_x64():
        config = dataclasses.replace(CONFIG, prior=prior, conditioned=conditioned)
        network = jax.tree.map(lambda x: x.astype(jnp.float64), random_network(config, seed=1))
        history, twist = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), (swaying_history(config), TWIST))
        move = jax.jit(functools.partial(apply, network))
        moved = move(history, twist)
        across = move(*mirrored(history, twist)) * jnp.array([1.0, -1.0])
        backwards = move(*reversed_(history, twist))[::-1]
    size = np.abs(moved).max()
    assert size > 1e-3
    np.testing.assert_allclose(across, moved, atol=1e-6 * size)
    if prior != "static":  # its Newton steps start at gripper 0, and end alike only where they converge
        np.testing.assert_allclose(backwards, moved, atol=1e-6 * size)


@pytest.mark.slow
def test_an_untied_network_does_not():
    config = dataclasses.replace(CONFIG, symmetric=False)
    network, history = random_network(config, seed=1), swaying_history(config)
    move = jax.jit(functools.partial(apply, network))
    across = move(*mirrored(history, TWIST)) * jnp.array([1.0, -1.0])
    assert np.abs(across - move(history, TWIST)).max() > 1e-3


def test_the_average_is_a_projection_and_its_own_adjoint():
    graphdef, weights = nnx.split(GNS(CONFIG, nnx.Rngs(0)))
    del graphdef

    def random(seed):
        return jax.tree.map(lambda x: jax.random.normal(jax.random.key(seed), x.shape), weights)

    def dot(a, b):
        return sum(jnp.vdot(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))

    a, b = random(1), random(2)
    once = symmetrised(a, CONFIG)
    for x, y in zip(jax.tree.leaves(symmetrised(once, CONFIG)), jax.tree.leaves(once), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-6)
    np.testing.assert_allclose(dot(once, b), dot(a, symmetrised(b, CONFIG)), rtol=1e-4)


def test_tied_weights_begin_as_large_as_others():
    config = dataclasses.replace(CONFIG, latent=64, hidden=64)
    _, weights = nnx.split(GNS(config, nnx.Rngs(0)))
    tied = initially_symmetric(weights, config)
    before, after = (float(np.std(w["processor"][0]["edge"]["rest"][0]["kernel"].get_value())) for w in (weights, tied))
    assert after == pytest.approx(before, rel=0.1)


@pytest.mark.slow
def test_training_and_pretraining_keep_them_tied(tmp_path):
    training = dataclasses.replace(TINY_TRAINING, model=dataclasses.replace(SMALL, symmetric=True))
    data = trajectories()
    pretrained = pretrain(training, data, PretrainConfig(steps=3, batch=2), progress=False)
    result = train(training, data, tmp_path, initial=(pretrained.model, pretrained.weights), progress=False)
    move = jax.jit(functools.partial(apply, (result.graphdef, result.weights)))
    history = History(jnp.asarray(data.keypoints[0, :3]), jnp.asarray(data.gripper_pose[0, 2]))
    moved = move(history, TWIST)
    np.testing.assert_allclose(move(*mirrored(history, TWIST)) * jnp.array([1.0, -1.0]), moved, atol=1e-6)
    np.testing.assert_allclose(move(*reversed_(history, TWIST))[::-1], moved, atol=1e-6)


def test_what_cannot_be_tied_is_refused():
    with pytest.raises(ValueError, match=r"ModelConfig\.latent"):
        dataclasses.replace(CONFIG, latent=10)
