"""A small analytic cable for tests of planning: the problems that every solver is crossed with."""

import jax.numpy as jnp
import numpy as np

from against_ipopt.planning_problems import PlanningCase
from cablejax.mpc.feasible import FeasibleSet
from cablejax.mpc.problem import ObjectiveConfig, ShapingProblem
from cablejax.types import History

LENGTH = 1.0


def number(value):
    """In the precision that is set, and strictly so: arrays that are floats by default compile anew."""
    return jnp.asarray(value, jnp.result_type(float))


def hermite_shape(gripper_pose, n_keypoints):
    """Cubic Hermite curve that leaves both grippers along their directions, [N, 2]."""
    gripper_pose = jnp.asarray(gripper_pose)
    s = jnp.linspace(0.0, 1.0, n_keypoints)[:, None]
    start, end = gripper_pose[0, :2], gripper_pose[1, :2]
    tangent = LENGTH * jnp.stack([jnp.cos(gripper_pose[:, 2]), jnp.sin(gripper_pose[:, 2])], axis=1)
    return (
        (2 * s**3 - 3 * s**2 + 1) * start
        + (s**3 - 2 * s**2 + s) * tangent[0]
        + (3 * s**2 - 2 * s**3) * end
        + (s**3 - s**2) * tangent[1]
    )


def relaxing_cable(weights, history, twist):
    """Covers the fraction `weights` of the way to its grippers' Hermite curve in each step; the ends, all of it."""
    newest = history.keypoints[-1]
    way = hermite_shape(history.gripper_pose + twist, newest.shape[0]) - newest
    return (weights * way).at[jnp.array([0, -1])].set(way[jnp.array([0, -1])])


def poses(distance, turn0=0.0, turn1=0.0):
    """Two grippers on the x axis; NumPy, so that a test decides the precision by where it uses them."""
    return np.array([[0.0, 0.0, turn0], [distance, 0.0, turn1]])


START = poses(0.97)
TARGETS = {
    "near": poses(0.9, 0.15, -0.1),
    "U": poses(0.5, -1.2, 1.2),
    "S": poses(0.75, 0.9, 0.9),
}


def at_rest(pose, n_keypoints=7, n_history=3):
    keypoints = hermite_shape(pose, n_keypoints)
    return History(keypoints=jnp.tile(keypoints, (n_history, 1, 1)), gripper_pose=jnp.asarray(pose))


def feasible_set(pose, radius=0.05):
    pose = jnp.asarray(pose)
    return FeasibleSet(
        separation=pose[1, :2] - pose[0, :2],
        radius=number(radius),
        min_distance=number(0.15 * LENGTH),
        max_distance=number(0.99 * LENGTH),
    )


def problem(target="near", start=START, radius=0.05, rate=0.8, **objective):
    history = at_rest(start)
    return ShapingProblem(
        dynamics=relaxing_cable,
        weights=number(rate),
        history=history,
        target=hermite_shape(TARGETS[target], history.keypoints.shape[1]),
        feasible=feasible_set(start, radius),
        objective=ObjectiveConfig(**objective),
    )


def random_motion(seed, n_steps=4, size=0.02):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(n_steps, 2, 3)) * size)


def planning_case(name="one", radius=0.05, steps=3) -> PlanningCase:
    history = at_rest(START)
    n = history.keypoints.shape[1]
    return PlanningCase(
        name=name,
        keypoints=np.asarray(history.keypoints),
        gripper_pose=np.asarray(history.gripper_pose),
        gain=np.zeros((6, 2 * n)),
        bias=np.zeros(2 * n),
        target=np.asarray(hermite_shape(poses(0.9, 0.15, -0.1), n)),
        radius=radius,
        guess=np.asarray(random_motion(0, steps)),
    )
