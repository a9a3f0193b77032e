"""Warm start of a solver: the last plan, the straight way to the target poses of the grippers, and holding still."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cablejax.mpc.config import MPCConfig
from cablejax.mpc.problem import Rollout, ShapingProblem
from cablejax.mpc.target_pose import straight_plan, straightened, target_pose, way_to

# Of the polyline through the keypoints of a cable that is hardly bent: no cable of their arc length is longer.
_ARCS = 1.005
# Of a cable, relative to its length: what polylines fall short of it by more is their bends.
_SHORTEST = 0.95


class StraightWay(NamedTuple):
    """The straight way to a pair of gripper poses.

    Attributes:
        motion: its first steps [m], shape [T, Q, 3].
        length: of the gripper that has farther to go, all the way [m], shape [].
    """

    motion: Float[Array, "T Q 3"]
    length: Float[Array, ""]


class Starts(NamedTuple):
    """Inputs of the warm start.

    Attributes:
        guess: the better of two starts: the last plan, shifted by the command that was executed, and the straight way.
        still: holding still as nearly as the bounds allow: grippers outside of them come back, and where motions may
            not change at once, they brake [m], shape [T, Q, 3].
        value_still: its objective [m^2], shape [].
        straightening: the way to where the cable is straight, feasible.
        back: the way to where the shape error was lowest, feasible.
    """

    guess: Rollout
    still: Float[Array, "T Q 3"]
    value_still: Float[Array, ""]
    straightening: StraightWay
    back: StraightWay


def find_starts(
    config: MPCConfig, problem: ShapingProblem, last: Float[Array, "T Q 3"], best_pose: Float[Array, "Q 3"]
) -> Starts:
    """Candidates of a start, and their values.

    Args:
        config: settings.
        problem: of this step.
        last: the last plan, its first command executed [m].
        best_pose: gripper poses at which the shape error was lowest.
    """
    radius, radius_max = problem.feasible.radius, jnp.asarray(config.radius_max, last.dtype)
    to_target = _straight_way(config, problem, target_pose(problem.target), radius)
    # a cable that is shorter than believed, as after a slip, is not to be pulled taut
    seen = jnp.linalg.norm(jnp.diff(problem.history.keypoints[-1], axis=0), axis=1).sum()
    length = config.cable_length * jnp.clip(_ARCS * seen / config.cable_length, _SHORTEST, 1.0)
    apart = straightened(problem.target, config.max_distance * length)
    # what leads away from here does not rest on the model
    to_straight = _straight_way(config, problem, apart, radius_max)
    to_best = _straight_way(config, problem, best_pose, radius_max)
    shifted = jnp.roll(last, -1, axis=0).at[-1].set(0.0)
    wanted = jnp.stack([shifted, to_target.motion, to_straight.motion, to_best.motion, jnp.zeros_like(last)])
    # one after the other: vmap would run the interior-point method for all, and several calls would compile it for each
    bounds = jnp.stack([radius, radius, radius_max, radius_max, radius])
    allowed = jax.lax.map(
        lambda pair: dataclasses.replace(problem.feasible, radius=pair[1]).project(pair[0]), (wanted, bounds)
    )
    # rest, where it is allowed: not for grippers that are outside their bounds, nor for those that have to brake first
    still = allowed[4]
    rollouts = jax.vmap(problem.rollout)(jnp.stack([allowed[0], allowed[1], still]))
    values = jax.vmap(problem.value_of)(rollouts)
    best = jnp.argmin(jnp.where(jnp.isfinite(values[:2]), values[:2], jnp.inf))
    guess = jax.tree.map(lambda leaf: leaf[best], rollouts)
    straightening, back = to_straight._replace(motion=allowed[2]), to_best._replace(motion=allowed[3])
    return Starts(guess, still, values[2], straightening, back)


def _straight_way(
    config: MPCConfig, problem: ShapingProblem, to: Float[Array, "2 3"], radius: Float[Array, ""]
) -> StraightWay:
    """Motions from the grippers' present poses to a pair of poses, within this bound on a step [m] and no other."""
    weight = config.objective.rotation_weight
    motion = straight_plan(problem.pose, to, radius, weight, config.n_commands)
    return StraightWay(motion, jnp.linalg.norm(way_to(problem.pose, to, weight), axis=1).max())
