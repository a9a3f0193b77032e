"""Keypoints on the nodes of a chain."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.cable import Discretisation
from cablejax.effects.physics import nominal_physics
from cablejax.simulate.keypoints import marked_keypoints


@pytest.mark.parametrize("index", [0, 6, 12])
def test_derivative_by_a_bias_along_the_cable(index):
    """Without bias: of an end, which cannot leave the cable, that of moving inwards."""
    with jax.enable_x64(True):
        config = Discretisation()
        angle = jnp.linspace(0.0, 1.2, config.n_links)
        unit = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
        nodes = jnp.cumsum(config.link_length * unit, axis=0)
        physics = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), nominal_physics(config))

        def keypoint(shift):
            biased = dataclasses.replace(physics, bias_along=physics.bias_along.at[index].set(shift))
            return marked_keypoints(config, biased, nodes, unit)[index]

        inwards = {0: 1.0, 12: -1.0}.get(index)
        step = 1e-6
        wanted = (
            (keypoint(step) - keypoint(-step)) / (2 * step)
            if inwards is None
            else inwards
            * (-3 * keypoint(0.0) + 4 * keypoint(inwards * step) - keypoint(2 * inwards * step))
            / (2 * step)
        )
        np.testing.assert_allclose(jax.jacfwd(keypoint)(0.0), wanted, atol=1e-8)
        np.testing.assert_allclose(jax.jacrev(keypoint)(0.0), wanted, atol=1e-8)
