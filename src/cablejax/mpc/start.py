"""Where a solver may begin: the last plan, the straight way to where the target's ends are held, and holding still."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cablejax.mpc.config import MPCConfig
from cablejax.mpc.goal import continued, straight_plan, way_to
from cablejax.mpc.problem import ShapingProblem
from cablejax.mpc.rollout import Rollout


class StraightWay(NamedTuple):
    """The straight way to a pair of gripper poses.

    Attributes:
        motion: its first steps, feasible [m], shape [T, Q, 3].
        length: of the gripper that has farther to go, all the way [m], shape [].
    """

    motion: Float[Array, "T Q 3"]
    length: Float[Array, ""]


def find_straight_way(config: MPCConfig, problem: ShapingProblem, goal: Float[Array, "2 3"]) -> StraightWay:
    """The straight way from where the grippers are to a pair of poses; a step's length is the problem's radius."""
    pose = continued(problem.history.gripper_pose, problem.history.keypoints[-1])
    weight = config.objective.rotation_weight
    motion = straight_plan(pose, goal, problem.feasible.radius, weight, config.n_commands)
    length = jnp.linalg.norm(way_to(pose, goal, weight), axis=1).max()
    return StraightWay(problem.feasible.project(motion), length)


class Starts(NamedTuple):
    """What is known before a solver is asked.

    Attributes:
        guess: the better of two starts: the last plan, shifted by the command that was executed, and the straight way.
        still: holding, or where motions may not change at once, braking [m], shape [T, Q, 3].
        value_still: its objective [m^2], shape [].
    """

    guess: Rollout
    still: Float[Array, "T Q 3"]
    value_still: Float[Array, ""]


def find_starts(config: MPCConfig, problem: ShapingProblem, last: Float[Array, "T Q 3"], way: StraightWay) -> Starts:
    """What may be begun from, and what it is worth.

    Args:
        config: settings.
        problem: of this step.
        last: the last plan, its first command executed [m].
        way: to where the target's ends are held.
    """
    still = jnp.zeros_like(last)
    if config.max_change is not None:
        # grippers that move brake first, as fast as they may
        still = problem.feasible.project(still)
    shifted = jnp.roll(last, -1, axis=0).at[-1].set(0.0)
    motions = jnp.stack([problem.feasible.project(shifted), way.motion, still])
    rollouts = jax.vmap(problem.rollout)(motions)
    values = jax.vmap(problem.value_of)(rollouts)
    best = jnp.argmin(jnp.where(jnp.isfinite(values[:2]), values[:2], jnp.inf))
    return Starts(jax.tree.map(lambda leaf: leaf[best], rollouts), still, values[2])
