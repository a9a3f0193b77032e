"""Rounded corners: how far from a ReLU, how smooth, and what a network with them predicts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from against_ipopt.rounded import Rounded, smoothed
from cablejax.dynamics.model import apply
from cablejax.types import History
from dynamics_cases import SMALL, network, trajectories

CORNER = 0.2


def test_a_rounded_corner_is_twice_differentiable_and_a_relu_beyond():
    with jax.enable_x64(True):
        x = jnp.asarray([-1.0, -CORNER, -0.1, 0.0, 0.1, CORNER, 1.0])
        rectified = Rounded(CORNER)
        value = rectified(x)
        assert float(value[3]) == pytest.approx(3 * CORNER / 16)
        excess = value - jnp.maximum(x, 0.0)
        assert float(excess.max()) == float(excess[3]) and float(excess.min()) == pytest.approx(0.0, abs=1e-15)
        # joined at both ends with the derivatives 0, 0 and 1, 0 of the lines beyond
        for end, slope in ((-CORNER, 0.0), (CORNER, 1.0)):
            for beside in (-1e-9, 1e-9):
                first = jax.grad(rectified)(end + beside)
                second = jax.grad(jax.grad(rectified))(end + beside)
                assert float(first) == pytest.approx(slope, abs=1e-7) and float(second) == pytest.approx(0.0, abs=1e-6)


def slopes(structure, weights, points):
    """Derivative of the mean predicted displacement in a gripper's speed, at several speeds."""
    data = trajectories(m=1, t=4)
    history = History(jnp.asarray(data.keypoints[0, :3], float), jnp.asarray(data.gripper_pose[0, 2], float))
    twist = jnp.asarray(data.gripper_twist[0, 2], float)

    def predicted(speed):
        return apply((structure, weights), history, twist.at[0, 0].add(speed)).mean()

    return np.asarray(jax.jit(jax.vmap(jax.value_and_grad(predicted)))(points))


def test_a_smoothed_network_predicts_the_same_with_a_derivative_that_does_not_jump():
    with jax.enable_x64(True):
        sharp, weights = network(SMALL)
        weights = jax.tree.map(lambda leaf: leaf.astype(float), weights)
        points = jnp.linspace(-0.02, 0.02, 2001)
        (value, slope), (rounded, smooth) = (slopes(g, weights, points) for g in (sharp, smoothed(sharp, weights, 0.1)))
        assert np.abs(rounded - value).max() < 0.02 * SMALL.normalisation.residual
        assert np.abs(np.diff(slope)).max() > 10 * np.abs(np.diff(smooth)).max()
        assert smoothed(sharp, weights, 0.1) == smoothed(sharp, weights, 0.1) != sharp


@pytest.mark.parametrize("corner", [0.0, -1.0, float("nan")])
def test_a_corner_has_a_size(corner):
    with pytest.raises(ValueError, match="expected a positive finite number"):
        smoothed(*network(SMALL), corner)
