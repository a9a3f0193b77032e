"""A perceptron and a bidirectional LSTM, the two networks that the graph network is compared with.

Both see the same node features (`cablejax.dynamics.graph`), correct the same prior, and are trained alike. Edge
features are not for them: what they hold follows from the nodes' positions.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.layers import MLP


class FlatMLP(nnx.Module):
    """All node features in one vector through `config.hidden_layers` layers of `config.hidden`.

    With the defaults the two-layer perceptron of Wang et al., RA-L 2022, section V.C. It fits one number of keypoints.
    """

    def __init__(self, config: ModelConfig, rngs: nnx.Rngs):
        self.config = config
        n = config.n_keypoints
        self.layers = MLP((n * config.node_features,), 2 * n, config, normalise=False, rngs=rngs)

    def __call__(
        self, node_features: Float[Array, "N node_features"], edge_features: Float[Array, "E edge_features"]
    ) -> Float[Array, "N 2"]:
        """Output of every keypoint from the node features of all; edge features are not used."""
        return self.layers(node_features.reshape(1, -1)).reshape(-1, 2)


class LSTM(nnx.Module):
    """One long short-term memory along the cable, from keypoint 0 to N - 1 or back (Hochreiter, Schmidhuber 1997)."""

    def __init__(self, inputs: int, size: int, *, backwards: bool, rngs: nnx.Rngs):
        self.size, self.backwards = size, backwards
        self.of_input = nnx.Linear(inputs, 4 * size, rngs=rngs)
        self.of_state = nnx.Linear(size, 4 * size, use_bias=False, kernel_init=nnx.initializers.orthogonal(), rngs=rngs)

    def __call__(self, along: Float[Array, "N inputs"]) -> Float[Array, "N size"]:
        """Hidden state at every keypoint. `along` holds the inputs of the gates, before the recurrent part."""
        kernel = self.of_state.kernel.get_value()

        def cell(carry, given):
            hidden, memory = carry
            enter, forget, leave, new = jnp.split(given + hidden @ kernel, 4)
            # a bias of 1: at first nothing is forgotten
            memory = jax.nn.sigmoid(forget + 1.0) * memory + jax.nn.sigmoid(enter) * jnp.tanh(new)
            hidden = jax.nn.sigmoid(leave) * jnp.tanh(memory)
            return (hidden, memory), hidden

        start = jnp.zeros(self.size, along.dtype)
        return jax.lax.scan(cell, (start, start), self.of_input(along), reverse=self.backwards)[1]


class BiLSTM(nnx.Module):
    """Recurrent along the cable, in both directions: the same cell at every keypoint.

    After Yan et al., "Self-Supervised Learning of State Estimation for Manipulating Deformable Linear Objects", RA-L
    2020: an encoder at every node, `config.hidden_layers` bidirectional layers of `config.latent`, a decoder.
    """

    def __init__(self, config: ModelConfig, rngs: nnx.Rngs):
        self.config = config
        size = config.latent
        self.encoder = MLP((config.node_features,), size, config, normalise=True, rngs=rngs)
        inputs = [size] + [2 * size] * (config.hidden_layers - 1)
        self.forwards = nnx.List([LSTM(n, size, backwards=False, rngs=rngs) for n in inputs])
        self.backwards = nnx.List([LSTM(n, size, backwards=True, rngs=rngs) for n in inputs])
        self.decoder = MLP((2 * size,), 2, config, normalise=False, rngs=rngs)

    def __call__(
        self, node_features: Float[Array, "N node_features"], edge_features: Float[Array, "E edge_features"]
    ) -> Float[Array, "N 2"]:
        """Output of every keypoint from both directions; edge features are not used."""
        along = self.encoder(node_features)
        for forwards, backwards in zip(self.forwards, self.backwards, strict=True):
            along = jnp.concatenate([forwards(along), backwards(along)], axis=-1)
        return self.decoder(along)
