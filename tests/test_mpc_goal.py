"""The plan that goes straight to where the target's ends are held."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.mpc.goal import goal_pose, straight_plan
from cablejax.targets import make_target


@pytest.mark.parametrize("shape", ["U", "S", "Z"])
def test_goal_is_where_the_target_is_held(shape):
    target = make_target(shape)
    goal = np.asarray(goal_pose(jnp.asarray(target.keypoints)))
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


def test_rotations_take_the_shorter_way():
    pose = jnp.array([[0.0, 0.0, 3.0], [0.5, 0.0, -3.0]])
    goal = jnp.array([[0.0, 0.0, -3.0], [0.5, 0.0, 3.0]])
    plan = np.asarray(straight_plan(pose, goal, jnp.asarray(1.0), 0.15, 1))
    np.testing.assert_allclose(np.abs(plan[0, :, 2]), 0.15 * (2 * np.pi - 6.0), rtol=1e-4)
