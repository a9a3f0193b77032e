"""A learned one-step model: a network from features of the cable to its motion beyond the prior."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.graph import build_graph, frame_of, prior_of
from cablejax.dynamics.networks import GNS
from cablejax.types import History

OneStepModel = Callable[[History, Float[Array, "Q 3"]], Float[Array, "N 2"]]
"""A one-step model: the displacement X(t + 1) - X(t) [m] that a command causes after a history."""


def apply(
    model: GNS | tuple[nnx.GraphDef, nnx.State], history: History, twist: Float[Array, "2 3"]
) -> Float[Array, "N 2"]:
    """Displacement X(t + 1) - X(t) [m] of every keypoint; at the two grasped ones it is the grippers', exactly.

    Rotating and shifting the input rotates the output, in the grippers' frame. With tied weights the same holds for
    mirroring the input and for counting its keypoints from the other end. Differentiable in weights, history and twist
    (almost everywhere: the activation is ReLU).

    Args:
        model: the network, or its split form `(graphdef, weights)`. Any module with a `config` will do that maps node
            features [N, F] and edge features [E, G] to movement beyond the prior [N, 2], in units of its scale. One
            that sees the cable in another frame than the grippers' has that as `frame`, see `GNS`.
        history: the last H samples; vmap for batches.
        twist: control input of both grippers [m/s, rad/s], shape [2, 3].

    Raises:
        ValueError: a history of another number of samples or keypoints than the model was trained with.
    """
    network: GNS = nnx.merge(*model) if isinstance(model, tuple) else model
    config = network.config
    if history.keypoints.shape != (expected := (config.history, config.n_keypoints, 2)):
        raise ValueError(
            f"The history has keypoints of shape {history.keypoints.shape}, expected {expected}: this model looks back "
            f"on {config.history} samples of {config.n_keypoints} keypoints (`MPCConfig.history_length`)."
        )
    prior, frame = prior_of(history, twist, config), getattr(network, "frame", frame_of)
    graph = build_graph(history, twist, prior, config, frame)
    axes = frame(history.gripper_pose).axes
    output = network(graph.nodes, graph.edges)  # pyright: ignore[reportArgumentType]
    beyond = output[1:-1] * config.normalisation.residual
    return prior.displacement + jnp.pad(jnp.matmul(beyond, axes, precision="highest"), ((1, 1), (0, 0)))


def bind(graphdef: nnx.GraphDef, weights: nnx.State) -> OneStepModel:
    """The model as a function of history and twist alone."""
    return lambda history, twist: apply((graphdef, weights), history, twist)


def structure_of(config: ModelConfig) -> tuple[nnx.GraphDef, nnx.State]:
    """The structure of a graph network and the shapes and dtypes of its weights, without any memory."""
    return nnx.split(nnx.eval_shape(lambda: GNS(config, nnx.Rngs(0))))
