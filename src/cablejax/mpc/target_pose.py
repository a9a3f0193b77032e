"""Target pose of the grippers, and a plan without a model: both grippers on straight lines to it.

A local solver started from the last plan can stay in a valley: between an arch and an S, say, the shape error hardly
falls for several steps. This plan crosses such ridges, and is a guess for the solver, not a command.

How far the grippers turn is more than where they point. The directions at both ends say the cable's total turn only up
to whole turns, and a cable that is brought to the right directions by the wrong way round has a loop in it. Its turn is
therefore read off the keypoints, and both plans and objective (`ShapingProblem`) go by it.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from cablejax.arrays import turns


def total_turn(keypoints: Float[Array, "N 2"]) -> Float[Array, ""]:
    """Angle [rad] by which the tangent turns from the first to the last keypoint, whole turns included.

    The tangent of a chord is that of the cable at its middle, so half a chord's turn is added at each end. Right as
    long as the cable turns by less than pi from chord to chord.
    """
    turned = turns(jnp.diff(keypoints, axis=0))
    return jnp.sum(turned) + 0.5 * (turned[0] + turned[-1])


def target_pose(target: Float[Array, "N 2"]) -> Float[Array, "2 3"]:
    """(x, y, theta) of the two grippers in a target shape; theta of the second continues that of the first."""
    chord = target[1] - target[0]
    first = jnp.arctan2(chord[1], chord[0]) - 0.5 * turns(jnp.diff(target, axis=0))[0]
    heading = jnp.stack([first, first + total_turn(target)])
    return jnp.concatenate([target[jnp.array([0, -1])], heading[:, None]], axis=1)


def straightened(target: Float[Array, "N 2"], distance: float | Float[Array, ""]) -> Float[Array, "2 3"]:
    """(x, y, theta) of the two grippers holding a straight cable along the target's chord, around its middle.

    From there stable shapes lead to every target (Borum and Bretl, ICRA 2015), whatever shape the cable had before.
    """
    first, last = target[0], target[-1]
    chord = last - first
    heading = jnp.arctan2(chord[1], chord[0])
    half = 0.5 * distance * jnp.stack([jnp.cos(heading), jnp.sin(heading)])
    middle = 0.5 * (first + last)
    return jnp.concatenate([jnp.stack([middle - half, middle + half]), jnp.full((2, 1), heading)], axis=1)


def continued(pose: Float[Array, "2 3"], keypoints: Float[Array, "N 2"]) -> Float[Array, "2 3"]:
    """Gripper poses with whole turns added to the second theta, so that it continues the first along the cable."""
    turn = pose[1, 2] - pose[0, 2]
    return pose.at[1, 2].add(2 * jnp.pi * jnp.round((total_turn(keypoints) - turn) / (2 * jnp.pi)))


def way_to(pose: Float[Array, "2 3"], target: Float[Array, "2 3"], rotation_weight: float) -> Float[Array, "2 3"]:
    """The shortest motion [m] from one pair of poses to another, both `continued` along their cable.

    Motions that differ by whole turns of both grippers together lead to the same poses.
    """
    way = target - pose
    whole_turns = 2 * jnp.pi * jnp.round(jnp.mean(way[:, 2]) / (2 * jnp.pi))
    return jnp.concatenate([way[:, :2], rotation_weight * (way[:, 2:] - whole_turns)], axis=1)


def straight_plan(
    pose: Float[Array, "2 3"], target: Float[Array, "2 3"], radius: Float[Array, ""], rotation_weight: float, steps: int
) -> Float[Array, "T 2 3"]:
    """Motions [m] (see `feasible`) that bring both grippers to `target` together, as fast as the step bound allows.

    Args:
        pose: where the grippers are, (x, y, theta), the second's theta `continued` from the first.
        target: where they shall be, likewise, see `way_to`.
        radius: bound on the norm of each gripper's motion in each step [m].
        rotation_weight: w [m/rad].
        steps: T; the rest of the way lies beyond the plan, and steps after the arrival are 0.
    """
    way = way_to(pose, target, rotation_weight)
    longest = jnp.maximum(jnp.linalg.norm(way, axis=1).max(), 1e-9)
    fraction = jnp.minimum(radius / longest, 1.0)
    done = jnp.minimum(fraction * jnp.arange(steps + 1), 1.0)
    return jnp.diff(done)[:, None, None] * way
