"""The one-step model about no command, against finite differences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.residual.jacobian import linearised
from cablejax.types import History


def dynamics(weights, history, twist):
    """A model with every coupling, smooth in the command."""
    ends = twist[:, :2].sum(0) * jnp.linspace(0.2, 1.0, history.keypoints.shape[1])[:, None]
    return weights * history.keypoints[-1] * jnp.cos(twist.sum()) + ends + jnp.sin(twist[0, 2] * twist[1, 0])


@pytest.mark.parametrize("scale", [0.0, 1.0, 1e3], ids=["at the origin", "ordinary", "far away"])
def test_it_is_the_model_and_its_slope_without_a_command(scale):
    with jax.enable_x64(True):
        rng = np.random.default_rng(0)
        history = History(jnp.asarray(scale * rng.normal(size=(6, 13, 2))), jnp.asarray(rng.normal(size=(2, 3))))
        model = linearised(dynamics, 0.3, history, with_gain=True)
        np.testing.assert_array_equal(model.drift, dynamics(0.3, history, jnp.zeros((2, 3))))
        along, step = rng.normal(size=(2, 3)), 1e-6
        ahead, behind = (dynamics(0.3, history, jnp.asarray(sign * step * along)) for sign in (1, -1))
        slope = jnp.einsum("ncqk,qk->nc", model.gain, along)
        np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), rtol=1e-6, atol=1e-9 * max(scale, 1.0))
        moved = dataclasses.replace(history, gripper_pose=history.gripper_pose + 1.0)
        np.testing.assert_array_equal(linearised(dynamics, 0.3, moved, with_gain=True).gain, model.gain)
        without = linearised(dynamics, 0.3, history, with_gain=False)
        np.testing.assert_array_equal(without.drift, model.drift)
        assert without.gain.shape == model.gain.shape and not without.gain.any()
