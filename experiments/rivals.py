"""The networks that the graph network is compared with, and all weights in experiments/weights.

A perceptron over all keypoints and a bidirectional recurrence along the cable. Both see the same node features
(`cablejax.dynamics.graph`), correct the same prior, and are trained alike, by `cablejax.dynamics.train.train` with
`network=FlatMLP` or `BiLSTM`; `WorldMLP` and `WorldGNS` see the cable in the world's axes instead of the grippers'.
Edge features are for the graph networks only: what those hold follows from the nodes' positions.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float
from safetensors import safe_open

from cablejax.control.shaping import Model, NetworkDynamics, load_model
from cablejax.dynamics.config import RECORDED, ModelConfig, Normalisation
from cablejax.dynamics.graph import Frame
from cablejax.dynamics.networks import GNS, MLP
from cablejax.dynamics.weights import cable_of_weights, weights_path
from cablejax.simulate.chain.statics import Statics

WEIGHTS = Path(__file__).parent / "weights"
"""A folder for each model."""


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


def worlds_frame(gripper_pose: Float[Array, "2 3"]) -> Frame:
    """The world's own axes, wherever the grippers are."""
    return Frame(jnp.zeros(2, gripper_pose.dtype), jnp.eye(2, dtype=gripper_pose.dtype))


class WorldGNS(GNS):
    """The graph network in the world's axes, as in the paper."""

    frame = staticmethod(worlds_frame)


class WorldMLP(FlatMLP):
    """The perceptron in the world's axes."""

    frame = staticmethod(worlds_frame)


NETWORKS: dict[tuple[str, str], Callable[[ModelConfig, nnx.Rngs], nnx.Module]] = {
    ("gns", "grippers"): GNS,
    ("mlp", "grippers"): FlatMLP,
    ("lstm", "grippers"): BiLSTM,
    ("gns", "world"): WorldGNS,
    ("mlp", "world"): WorldMLP,
}
"""The networks by name and frame, as files of weights record them."""


def load_rival(folder: Path) -> Model:
    """The model in a folder of experiments/weights: any network, in either frame.

    Raises:
        WeightsError: there are no weights, or they name no cable.
    """
    path = weights_path(folder)
    with safe_open(path, framework="numpy") as file:
        recorded: dict[str, Any] = json.loads(file.metadata()["cablejax"])["config"]
        tensors = {name: jnp.asarray(file.get_tensor(name)) for name in file.keys()}  # noqa: SIM118
    kind, frame = (recorded.pop(name, usual) for name, usual in RECORDED.items())
    recorded["normalisation"] = Normalisation(**recorded["normalisation"])
    recorded["statics"] = Statics(**recorded.get("statics", {}))
    config = ModelConfig(**recorded)
    graphdef, expected = nnx.split(nnx.eval_shape(lambda: NETWORKS[kind, frame](config, nnx.Rngs(0))))
    flat = nnx.to_flat_state(expected)
    weights = nnx.from_flat_state([(key, leaf.replace(tensors[".".join(map(str, key))])) for key, leaf in flat])
    return Model(str(folder), config, NetworkDynamics(graphdef), weights, cable_of_weights(path))


def load_any(name: str) -> Model:
    """A model of experiments/weights, a released one by its name, or that in a training's folder."""
    return load_rival(WEIGHTS / name) if (WEIGHTS / name).is_dir() else load_model(name)


def on_another_cable(model: Model, *, n_keypoints: int, length: float) -> Model:
    """The same weights, reading another cable.

    A graph network has the same weights at every node and edge, and so has a recurrence along the cable. The connective
    radius stays what it was in metres, so that finer keypoints have more neighbours; nothing says that the network has
    learned what those mean.

    Raises:
        ValueError: the network has weights of its own for every keypoint, or no two keypoints would be connected.
    """
    assert isinstance(model.dynamics, NetworkDynamics)
    kind = type(nnx.merge(model.dynamics.graphdef, model.weights))
    if kind is FlatMLP and n_keypoints != model.config.n_keypoints:
        raise ValueError(
            f"The network is a perceptron over {model.config.n_keypoints} keypoints: it cannot read {n_keypoints}. "
            "Train another one."
        )
    config = dataclasses.replace(model.config, n_keypoints=n_keypoints, length=length)
    graphdef = nnx.split(nnx.eval_shape(lambda: kind(config, nnx.Rngs(0))))[0]
    dynamics = dataclasses.replace(model.dynamics, graphdef=graphdef)
    return dataclasses.replace(model, config=config, dynamics=dynamics)
