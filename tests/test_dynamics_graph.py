"""The graph: who is connected, what nodes and edges say, and that none of it depends on where the cable lies."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.dynamics.config import ModelConfig, Normalisation
from cablejax.dynamics.graph import build_graph, cable_topology, frame_of, prior_of, rigid_interpolation
from dynamics_cases import SMALL, arched_history, moved_rigidly, straight_history, turned_twist

TWIST = jnp.array([[0.01, -0.02, 0.1], [-0.03, 0.005, -0.2]])


@functools.partial(jax.jit, static_argnames="config")
def graph_of(history, twist, config):
    return build_graph(history, twist, prior_of(history, twist, config), config)


def test_the_seeds_cable_has_46_directed_edges_and_no_loops():
    topology = cable_topology(13, 1.0, 0.2)
    pairs = set(zip(topology.senders.tolist(), topology.receivers.tolist(), strict=True))
    assert len(pairs) == len(topology.senders) == 46
    assert pairs == {(i, j) for i in range(13) for j in range(13) if 0 < abs(i - j) <= 2}


@pytest.mark.parametrize(("n", "radius"), [(5, 0.25), (5, 10.0), (8, 0.3)])
def test_edges_are_those_within_the_radius_sorted_by_offset(n, radius):
    topology = cable_topology(n, 1.0, radius)
    offset = topology.receivers - topology.senders
    assert (np.diff(offset) >= 0).all() and set(offset) == set(topology.offsets)
    expected = {(i, j) for i in range(n) for j in range(n) if i != j and abs(i - j) / (n - 1) <= radius * (1 + 1e-9)}
    assert set(zip(topology.senders, topology.receivers, strict=True)) == expected


def test_a_radius_below_the_spacing_is_refused():
    with pytest.raises(ValueError, match="no two would be connected"):
        ModelConfig(n_keypoints=5, radius=0.2)


@pytest.mark.parametrize(("name", "value"), [("n_keypoints", 2), ("length", -1.0), ("history", 0), ("prior", "all")])
def test_impossible_configurations_are_refused(name, value):
    with pytest.raises(ValueError, match=f"ModelConfig.{name} is"):
        dataclasses.replace(ModelConfig(), **{name: value})
    with pytest.raises(ValueError, match=r"Normalisation.residual is 0"):
        Normalisation(residual=0.0)


def test_shapes_are_those_the_configuration_promises():
    graph = graph_of(arched_history(SMALL), TWIST, SMALL)
    assert graph.nodes.shape == (SMALL.n_keypoints, SMALL.node_features)
    assert graph.edges.shape == (len(graph.senders), SMALL.edge_features)
    assert graph.n_node.tolist() == [5] and graph.n_edge.tolist() == [len(graph.senders)]


def test_features_do_not_change_when_the_cable_is_turned_and_shifted():
    for config in (SMALL, dataclasses.replace(SMALL, prior="static")):
        history, angle = arched_history(config), 2.1
        here = graph_of(history, TWIST, config)
        there = graph_of(moved_rigidly(history, angle, np.array([0.3, -0.7])), turned_twist(TWIST, angle), config)
        np.testing.assert_allclose(here.nodes, there.nodes, atol=2e-3)
        np.testing.assert_allclose(here.edges, there.edges, atol=2e-3)


def test_only_grasped_nodes_see_the_command():
    history = arched_history(SMALL)
    moved, still = graph_of(history, TWIST, SMALL), graph_of(history, jnp.zeros((2, 3)), SMALL)
    changed = np.abs(moved.nodes - still.nodes) > 0
    prior = np.arange(SMALL.node_features) >= SMALL.node_features - 4
    assert not changed[1:-1][:, ~prior].any()
    assert changed[[0, -1]][:, ~prior].any(axis=1).all()


def test_a_straight_cable_is_nowhere_shorter_than_itself():
    graph = graph_of(straight_history(SMALL), TWIST, SMALL)
    np.testing.assert_allclose(graph.edges[:, 2], 0.0, atol=1e-3)
    np.testing.assert_allclose(graph.edges[:, 3], (graph.receivers - graph.senders) * SMALL.spacing / SMALL.radius)


def test_the_frame_is_a_rotation_along_the_grippers():
    grippers = arched_history(SMALL).gripper_pose
    origin, axes = frame_of(grippers)
    np.testing.assert_allclose(axes @ axes.T, np.eye(2), atol=1e-6)
    assert np.linalg.det(axes) == pytest.approx(1.0, abs=1e-6)
    along = np.diff(grippers[:, :2], axis=0)[0]
    np.testing.assert_allclose(axes @ along, [np.linalg.norm(along), 0.0], atol=1e-6)
    np.testing.assert_allclose(origin, grippers[:, :2].mean(axis=0), atol=1e-7)


def test_without_a_prior_only_the_held_ends_are_expected_to_move():
    config = dataclasses.replace(SMALL, prior="none")
    moved, strain = prior_of(arched_history(config), TWIST, config)
    np.testing.assert_allclose(moved[jnp.array([0, -1])], TWIST[:, :2] * config.interval)
    assert not moved[1:-1].any() and not strain.any()


def test_interpolation_is_exact_for_a_translation_and_at_both_ends():
    pose = arched_history(SMALL).gripper_pose
    same = jnp.array([[0.02, 0.01, 0.0]] * 2)
    moved = rigid_interpolation(pose, same, n_keypoints=7, length=1.0)
    np.testing.assert_allclose(moved, np.tile([0.02, 0.01], (7, 1)), rtol=1e-6)
    moved = rigid_interpolation(pose, TWIST, n_keypoints=7, length=1.0, interval=0.5)
    np.testing.assert_allclose(moved[jnp.array([0, -1])], 0.5 * TWIST[:, :2], rtol=1e-6)
