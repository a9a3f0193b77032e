"""The plan that goes straight to where the target's ends are held."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.control.targets import make_target
from cablejax.mpc.target_pose import continued, straight_plan, straightened, target_pose, total_turn


@pytest.mark.parametrize("shape", ["U", "S", "Z"])
def test_goal_is_where_the_target_is_held(shape):
    target = make_target(shape)
    goal = np.asarray(target_pose(jnp.asarray(target.keypoints)))
    np.testing.assert_allclose(goal[:, :2], target.gripper_pose[:, :2], atol=1e-6)
    turn = (goal[:, 2] - target.gripper_pose[:, 2] + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(turn).max() < 0.15, "the tangent is extrapolated from chords of 8 cm"


def test_straight_plan_arrives_together_within_the_bound_and_then_rests():
    pose = jnp.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]])
    goal = jnp.array([[-0.4, 0.05, 0.3], [0.45, 0.0, -0.2]])
    plan = np.asarray(straight_plan(pose, goal, jnp.asarray(0.05), 0.15, 6))
    assert np.linalg.norm(plan, axis=-1).max() <= 0.05 * (1 + 1e-5)
    way = np.asarray(goal - pose) * [1.0, 1.0, 0.15]
    np.testing.assert_allclose(plan.sum(axis=0), way, atol=1e-6)
    np.testing.assert_allclose(plan[-1], 0.0, atol=1e-6)


def test_both_grippers_turn_the_shorter_way_and_the_cable_keeps_its_turn():
    pose = jnp.array([[0.0, 0.0, 3.0], [0.5, 0.0, 3.2]])
    goal = jnp.array([[0.0, 0.0, -3.0], [0.5, 0.0, -3.1]])
    plan = np.asarray(straight_plan(pose, goal, jnp.asarray(1.0), 0.15, 1))
    np.testing.assert_allclose(plan[0, :, 2], 0.15 * (np.array([-6.0, -6.3]) + 2 * np.pi), rtol=1e-4)
    # wound up by a whole turn: nothing but turning back by one helps, half of it at either end
    wound = pose.at[1, 2].add(2 * np.pi)
    plan = np.asarray(straight_plan(wound, pose, jnp.asarray(9.0), 0.15, 1))
    assert plan[0, 1, 2] - plan[0, 0, 2] == pytest.approx(-0.15 * 2 * np.pi, rel=1e-5)


@pytest.mark.parametrize("turn", [0.0, 1.0, -4.0, 7.0])
def test_turn_is_read_off_the_keypoints_whole_turns_included(turn):
    angle = np.linspace(0.3, 0.3 + turn, 400)
    curve = np.cumsum(np.stack([np.cos(angle), np.sin(angle)], axis=1), axis=0) / 400
    keypoints = jnp.asarray(curve[np.linspace(0, 399, 13).astype(int)])
    assert float(total_turn(keypoints)) == pytest.approx(turn, abs=0.03)
    pose = jnp.array([[0.0, 0.0, 0.3], [0.5, 0.0, 0.3 + turn - 4 * np.pi]])
    assert float(continued(pose, keypoints)[1, 2]) == pytest.approx(0.3 + turn, abs=1e-5)
    goal = np.asarray(target_pose(keypoints))
    np.testing.assert_allclose(goal[:, 2], [0.3, 0.3 + turn], atol=0.03)


def test_straightened_is_along_the_chord_around_its_middle():
    target = jnp.asarray([[0.1, 0.2], [0.3, 0.9], [0.5, 0.6]])
    pose = np.asarray(straightened(target, 0.9))
    np.testing.assert_allclose(pose[:, :2].mean(axis=0), [0.3, 0.4], atol=1e-6)
    np.testing.assert_allclose(pose[1, :2] - pose[0, :2], 0.9 * np.array([1.0, 1.0]) / np.sqrt(2), atol=1e-6)
    np.testing.assert_allclose(pose[:, 2], np.pi / 4, atol=1e-6)
    closed = straightened(jnp.zeros((3, 2)), 0.9)
    assert np.isfinite(closed).all(), "ends that meet have no chord: any direction will do"
