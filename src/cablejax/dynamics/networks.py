"""The graph network on the features of `cablejax.dynamics.graph`.

It encodes, processes by message passing, and decodes:

    encode     v_i = f_V(node features),  e_ij = f_E(edge features)
    process    e_ij <- e_ij + f^k_e(e_ij, v_i, v_j),  v_j <- v_j + f^k_v(v_j, sum_i e'_ij)      k = 1, ..., K
    decode     output_j = f_D(v_j)

after Sanchez-Gonzalez et al., "Learning to Simulate Complex Physics with Graph Networks", ICML 2020, with the sizes of
Wang et al., RA-L 2022. Every f is a ReLU network, followed by layer normalisation except in the decoder.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.graph import frame_of, topology_of


class MLP(nnx.Module):
    """ReLU network whose first layer takes the sum of several inputs, each with a weight matrix of its own.

    That sum is the same as one matrix on the inputs' concatenation; written apart, an input that many rows share can
    be multiplied before it is copied to them.

    Attributes:
        activation: between the layers.
    """

    activation: Callable[[Array], Array] = staticmethod(jax.nn.relu)

    def __init__(self, inputs: tuple[int, ...], output: int, config: ModelConfig, *, normalise: bool, rngs: nnx.Rngs):
        share = nnx.initializers.variance_scaling(1.0 / len(inputs), "fan_in", "truncated_normal")
        self.first = nnx.List(
            [nnx.Linear(n, config.hidden, use_bias=i == 0, kernel_init=share, rngs=rngs) for i, n in enumerate(inputs)]
        )
        sizes = [config.hidden] * config.hidden_layers + [output]
        self.rest = nnx.List([nnx.Linear(a, b, rngs=rngs) for a, b in itertools.pairwise(sizes)])
        if not normalise:
            # The decoder starts at zero: an untrained model is its prior.
            self.rest[-1].kernel.set_value(jnp.zeros_like(self.rest[-1].kernel.get_value()))
        self.norm = nnx.LayerNorm(output, epsilon=1e-5, rngs=rngs) if normalise else None

    def after_first(self, x: Float[Array, "rows hidden"]) -> Float[Array, "rows output"]:
        """The network from the first layer's sum on."""
        for layer in self.rest:
            x = layer(self.activation(x))
        return x if self.norm is None else self.norm(x)

    def __call__(self, *inputs: Float[Array, "rows _"]) -> Float[Array, "rows output"]:
        """Applies the layers to the concatenation of the inputs, without concatenating them."""
        first = sum(layer(x) for layer, x in zip(self.first[1:], inputs[1:], strict=True))
        return self.after_first(self.first[0](inputs[0]) + first)


class MessagePassing(nnx.Module):
    """One step: every edge reads its two nodes, every node reads the sum of its incoming edges."""

    def __init__(self, config: ModelConfig, rngs: nnx.Rngs):
        n = config.latent
        self.offsets = topology_of(config).offsets
        self.edge = MLP((n, n, n), n, config, normalise=True, rngs=rngs)
        self.node = MLP((n, n), n, config, normalise=True, rngs=rngs)

    def __call__(
        self, nodes: Float[Array, "N latent"], edges: Float[Array, "E latent"]
    ) -> tuple[Float[Array, "N latent"], Float[Array, "E latent"]]:
        """One round of messages: every edge, then every node, is updated by its residual network."""
        own, sender, receiver = self.edge.first
        shared = gather(sender(nodes), receiver(nodes), self.offsets)
        message = self.edge.after_first(own(edges) + shared)
        update = self.node(nodes, aggregate(message, self.offsets, nodes.shape[0]))
        return nodes + update, edges + message


def gather(
    sent: Float[Array, "N latent"], received: Float[Array, "N latent"], offsets: tuple[int, ...]
) -> Float[Array, "E latent"]:
    """`sent[senders] + received[receivers]` for edges in a `Topology`'s order."""
    n = sent.shape[0]
    return jnp.concatenate(
        [sent[max(0, -k) : n - max(0, k)] + received[max(0, k) : n - max(0, -k)] for k in offsets], axis=0
    )


def aggregate(messages: Float[Array, "E latent"], offsets: tuple[int, ...], n: int) -> Float[Array, "N latent"]:
    """Sum of the incoming messages of every node, for edges in a `Topology`'s order."""
    # the derivative of a split is a concatenation; that of slices would be a sum of padded copies
    parts = jax.lax.split(messages, [n - abs(k) for k in offsets])
    return sum(jnp.pad(part, ((max(0, k), max(0, -k)), (0, 0))) for k, part in zip(offsets, parts, strict=True))  # pyright: ignore[reportReturnType]


class EncodeProcessDecode(nnx.Module):
    """The network of `topology_of(config)`, from features of any kind to numbers of any kind.

    Attributes:
        config: sizes, and which nodes are connected.
    """

    def __init__(self, features: tuple[int, int], outputs: int, config: ModelConfig, rngs: nnx.Rngs):
        """Draws the first weights.

        Args:
            features: numbers of features of a node and of an edge.
            outputs: numbers predicted per node; all 0 before training.
            config: sizes, and which nodes are connected.
            rngs: of the first weights.
        """
        node, edge = features
        self.config = config
        self.node_encoder = MLP((node,), config.latent, config, normalise=True, rngs=rngs)
        self.edge_encoder = MLP((edge,), config.latent, config, normalise=True, rngs=rngs)
        self.processor = nnx.List([MessagePassing(config, rngs) for _ in range(config.message_passing)])
        self.decoder = MLP((config.latent,), outputs, config, normalise=False, rngs=rngs)

    def __call__(
        self, node_features: Float[Array, "N node_features"], edge_features: Float[Array, "E edge_features"]
    ) -> Float[Array, "N outputs"]:
        """Encodes nodes and edges, passes messages, and decodes the nodes."""
        nodes, edges = self.node_encoder(node_features), self.edge_encoder(edge_features)
        for step in self.processor:
            nodes, edges = step(nodes, edges)
        return self.decoder(nodes)


class GNS(EncodeProcessDecode):
    """Predicts how the cable moves beyond its prior, in the grippers' frame and in units of its scale, shape [N, 2].

    Reads the features of `cablejax.dynamics.graph`.
    """

    frame = staticmethod(frame_of)
    """By the grippers' poses, the frame that the network sees the cable in."""

    def __init__(self, config: ModelConfig, rngs: nnx.Rngs):
        super().__init__((config.node_features, config.edge_features), 2, config, rngs)
