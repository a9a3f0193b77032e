"""A trained network on a cable of another length, seen at another number of keypoints."""

from __future__ import annotations

import dataclasses

from flax import nnx

from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.model import make_network


def structure_of(config: ModelConfig) -> tuple[nnx.GraphDef, nnx.State]:
    """The structure of a network and the shapes and dtypes of its weights, without any memory."""
    return nnx.split(nnx.eval_shape(lambda: make_network(config, nnx.Rngs(0))))


def on_another_cable(config: ModelConfig, *, n_keypoints: int, length: float) -> tuple[ModelConfig, nnx.GraphDef]:
    """Configuration and structure with which the same weights read another cable.

    A graph network has the same weights at every node and edge, and so has a recurrence along the cable. The connective
    radius stays what it was in metres, so that finer keypoints have more neighbours; nothing says that the network has
    learned what those mean.

    Raises:
        ValueError: the network has weights of its own for every keypoint, or no two keypoints would be connected.
    """
    if config.network == "mlp" and n_keypoints != config.n_keypoints:
        raise ValueError(
            f"The network is a perceptron over {config.n_keypoints} keypoints: it cannot read {n_keypoints}. "
            "Train another one."
        )
    other = dataclasses.replace(config, n_keypoints=n_keypoints, length=length)
    return other, structure_of(other)[0]
