"""The fast kernel of the graph network against `jraph.GraphNetwork` on the same `GraphsTuple`."""

import jax
import jax.numpy as jnp
import jraph
import numpy as np
import pytest
from flax import nnx

from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.graph import build_graph, prior_of
from cablejax.dynamics.networks import GNS, MessagePassing
from cablejax.dynamics.weights import load_weights
from dynamics_cases import arched_history

CONFIG = ModelConfig(n_keypoints=9, radius=0.3, latent=16, hidden=16, message_passing=3)
TWIST = jnp.array([[0.01, -0.02, 0.1], [-0.03, 0.005, -0.2]])


def as_graph_network(step: MessagePassing):
    """One message-passing step written with jraph: it reads senders and receivers, and adds up its own residuals."""

    def update_edge(edges, sent, received, _globals):
        return step.edge(edges, sent, received)

    def update_node(nodes, _sent, received, _globals):
        return nodes + step.node(nodes, received)

    network = jraph.GraphNetwork(update_edge_fn=update_edge, update_node_fn=update_node)

    def apply(graph: jraph.GraphsTuple) -> jraph.GraphsTuple:
        after = network(graph)
        return after._replace(edges=graph.edges + after.edges)

    return apply


def through_jraph(network: GNS, graph: jraph.GraphsTuple) -> jax.Array:
    graph = jraph.GraphMapFeatures(embed_node_fn=network.node_encoder, embed_edge_fn=network.edge_encoder)(graph)
    for step in network.processor:
        graph = as_graph_network(step)(graph)
    return network.decoder(graph.nodes)


def with_a_decoder(config: ModelConfig, seed: int) -> GNS:
    """A fresh network whose decoder is not zero, as it is before training."""
    network = GNS(config, nnx.Rngs(seed))
    kernel = network.decoder.rest[-1].kernel
    kernel.set_value(jax.random.normal(jax.random.key(seed), kernel.get_value().shape))
    return network


@pytest.mark.parametrize("seed", [0, 1])
def test_the_kernel_is_jraphs_graph_network(seed):
    network = with_a_decoder(CONFIG, seed)
    history = arched_history(CONFIG)
    graph = build_graph(history, TWIST, prior_of(history, TWIST, CONFIG), CONFIG)
    expected = through_jraph(network, graph)
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(network(graph.nodes, graph.edges), expected, atol=1e-6 * np.abs(expected).max())


def test_the_order_of_the_edges_is_the_only_thing_the_kernel_takes_for_granted():
    """jraph gives the same for edges in any order; so the kernel's order is a matter of speed, not of meaning."""
    network = with_a_decoder(CONFIG, 2)
    history = arched_history(CONFIG)
    graph = build_graph(history, TWIST, prior_of(history, TWIST, CONFIG), CONFIG)
    order = np.random.default_rng(0).permutation(len(graph.senders))
    shuffled = graph._replace(edges=graph.edges[order], senders=graph.senders[order], receivers=graph.receivers[order])
    expected = network(graph.nodes, graph.edges)
    np.testing.assert_allclose(through_jraph(network, shuffled), expected, atol=1e-6 * np.abs(expected).max())


def test_the_released_network_reads_its_graph_as_jraph_does():
    config, graphdef, weights = load_weights("gns-reference")
    network = nnx.merge(graphdef, weights)
    history = arched_history(config)
    graph = build_graph(history, TWIST, prior_of(history, TWIST, config), config)
    expected = through_jraph(network, graph)
    np.testing.assert_allclose(network(graph.nodes, graph.edges), expected, atol=1e-6 * np.abs(expected).max())
