"""Pretraining of the encoders as halves of auto-encoders, after Wang et al., RA-L 2022.

    phi_v, psi_v = argmin |v_i - psi_v(phi_v(v_i))|^2        phi_e, psi_e = argmin |e_ij - psi_e(phi_e(e_ij))|^2

over node features v and edge features e of the training data. phi_v and phi_e become the network's encoders; its
decoder takes over the layers of psi_v. All but the last: that one puts out features there and a displacement here, and
stays zero, so that training starts from the prior.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from jaxtyping import Array, Float
from tqdm import tqdm

from cablejax.dataset.windows import Window, draw_windows
from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.graph import build_graph, prior_of
from cablejax.dynamics.networks import GNS, MLP
from cablejax.dynamics.normalisation import check_trajectories, fit_normalisation
from cablejax.dynamics.symmetry import initially_symmetric, symmetrised
from cablejax.dynamics.train_config import TrainConfig
from cablejax.limits import check
from cablejax.types import Trajectory

_CHUNK = 100
_STREAM = 0x70726574
"""Keeps the draws of pretraining apart from those of training with the same seed."""


@dataclasses.dataclass(frozen=True)
class PretrainConfig:
    """Settings of the pretraining of the encoders.

    Attributes:
        steps: optimiser steps.
        batch: windows per step, each with all nodes and edges of its graph.
        lr_start: learning rate at the beginning; it falls like half a cosine.
        lr_end: at the end.
    """

    steps: int = 2_000
    batch: int = 16
    lr_start: float = 1e-3
    lr_end: float = 1e-5

    def __post_init__(self):
        check(self, "batch", steps="optimiser_steps", lr_start="learning_rate", lr_end="learning_rate")


@dataclasses.dataclass(frozen=True)
class Pretrained:
    """Result of pretraining.

    Attributes:
        model: configuration of the network, with the normalisation measured on the data.
        weights: of the whole network, for `train(..., initial=(model, weights))`.
        node_error: root mean square error of reconstructed node features over their root mean square.
        edge_error: the same of edge features.
    """

    model: ModelConfig
    weights: nnx.State
    node_error: float
    edge_error: float


class AutoEncoders(nnx.Module):
    """The encoders of a network, and a decoder back to the features for each."""

    def __init__(self, gns: GNS, rngs: nnx.Rngs):
        config = gns.config
        self.phi_v, self.phi_e = gns.node_encoder, gns.edge_encoder
        self.psi_v = MLP((config.latent,), config.node_features, config, normalise=False, rngs=rngs)
        self.psi_e = MLP((config.latent,), config.edge_features, config, normalise=False, rngs=rngs)

    def __call__(
        self, nodes: Float[Array, "rows node_features"], edges: Float[Array, "rows_e edge_features"]
    ) -> tuple[Float[Array, "rows node_features"], Float[Array, "rows_e edge_features"]]:
        """Reconstructs node and edge features from their latent vectors."""
        return self.psi_v(self.phi_v(nodes)), self.psi_e(self.phi_e(edges))


def features(windows: Window, config: ModelConfig) -> tuple[Float[Array, "rows F"], Float[Array, "rows_e G"]]:
    """Node and edge features of a batch of windows, one row for every node and every edge of every window."""

    def one(window: Window) -> tuple[Array, Array]:
        history, twist = window.history, window.twist[0]
        graph = build_graph(history, twist, prior_of(history, twist, config), config)
        return graph.nodes, graph.edges  # pyright: ignore[reportReturnType]

    nodes, edges = jax.vmap(one)(windows)
    return nodes.reshape(-1, nodes.shape[-1]), edges.reshape(-1, edges.shape[-1])


def pretrain(
    config: TrainConfig, data: Trajectory, pretraining: PretrainConfig = PretrainConfig(), *, progress: bool = True
) -> Pretrained:
    """Initial weights of `train(config, data, ...)` whose encoders have learned to keep what the features say.

    Raises:
        ValueError: bad data.
    """
    check_trajectories(data, config.model, steps=1, what="training data")
    model = dataclasses.replace(config.model, normalisation=fit_normalisation(data, config.model))
    rngs = nnx.Rngs(config.seed)
    gns = GNS(model, rngs)
    pair = AutoEncoders(gns, rngs)
    graphdef, weights = nnx.split(pair)
    weights = initially_symmetric(weights, model)
    schedule = optax.cosine_decay_schedule(
        pretraining.lr_start, pretraining.steps, pretraining.lr_end / pretraining.lr_start
    )
    optimiser = optax.adam(schedule)
    root = jax.random.fold_in(jax.random.key(config.seed), _STREAM)
    device_data = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), data)

    def loss(weights: nnx.State, nodes: Array, edges: Array):
        again_v, again_e = nnx.merge(graphdef, weights)(nodes, edges)
        error_v, error_e = jnp.mean((again_v - nodes) ** 2), jnp.mean((again_e - edges) ** 2)
        relative = jnp.sqrt(jnp.stack([error_v / jnp.mean(nodes**2), error_e / jnp.mean(edges**2)]))
        return error_v + error_e, relative

    @jax.jit
    def chunk(weights, state, steps, data):
        def one(carry, step):
            weights, state = carry
            key = jax.random.fold_in(root, step)
            windows = draw_windows(key, data, batch=pretraining.batch, history=model.history, steps=1)
            gradient, relative = jax.grad(loss, has_aux=True)(weights, *features(windows, model))
            change, state = optimiser.update(symmetrised(gradient, model), state, weights)
            return (optax.apply_updates(weights, change), state), relative

        (weights, state), relative = jax.lax.scan(one, (weights, state), steps)
        return weights, state, jnp.mean(relative, axis=0)

    state, relative = optimiser.init(weights), jnp.full(2, jnp.nan)
    with tqdm(total=pretraining.steps, desc="auto-encoders", disable=not progress, dynamic_ncols=True) as bar:
        for first in range(0, pretraining.steps, _CHUNK):
            steps = jnp.arange(first, min(first + _CHUNK, pretraining.steps))
            weights, state, relative = jax.block_until_ready(chunk(weights, state, steps, device_data))
            bar.update(steps.size)
    nnx.update(pair, weights)  # and with it the encoders of `gns`, which are the same objects
    _take_over(gns.decoder, pair.psi_v)
    return Pretrained(model, symmetrised(nnx.split(gns)[1], model), float(relative[0]), float(relative[1]))


def _take_over(decoder: MLP, psi: MLP) -> None:
    """Copies every layer but the last."""
    ours, theirs = [*decoder.first, *decoder.rest][:-1], [*psi.first, *psi.rest][:-1]
    for mine, other in zip(ours, theirs, strict=True):
        nnx.update(mine, nnx.state(other))
