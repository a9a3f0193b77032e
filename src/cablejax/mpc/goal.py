"""A plan without a model: both grippers on straight lines to where the target's ends are held.

A local solver started from the last plan can stay in a valley: between an arch and an S, say, the shape error hardly
falls for several steps. This plan crosses such ridges, and is a guess for the solver, not a command.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def goal_pose(target: Float[Array, "N 2"]) -> Float[Array, "2 3"]:
    """(x, y, theta) of the two grippers in a target shape: its ends, and tangents extrapolated to there.

    The tangent of a chord is that of the cable at its middle, so half a chord's turn is added at each end.
    """
    chords = jnp.diff(target, axis=0)
    heading = jnp.arctan2(chords[:, 1], chords[:, 0])
    first = heading[0] - 0.5 * _wrap(heading[1] - heading[0])
    last = heading[-1] + 0.5 * _wrap(heading[-1] - heading[-2])
    return jnp.concatenate([target[jnp.array([0, -1])], jnp.stack([first, last])[:, None]], axis=1)


def straight_plan(
    pose: Float[Array, "2 3"], goal: Float[Array, "2 3"], radius: Float[Array, ""], rotation_weight: float, steps: int
) -> Float[Array, "T 2 3"]:
    """Motions [m] (see `feasible`) that bring both grippers to `goal` together, as fast as the step bound allows.

    Args:
        pose: where the grippers are, (x, y, theta).
        goal: where they shall be; rotations take the shorter way.
        radius: bound on the norm of each gripper's motion in each step [m].
        rotation_weight: w [m/rad].
        steps: T; the rest of the way lies beyond the plan, and steps after the arrival are 0.
    """
    way = goal - pose
    way = jnp.concatenate([way[:, :2], rotation_weight * _wrap(way[:, 2:])], axis=1)
    longest = jnp.maximum(jnp.linalg.norm(way, axis=1).max(), 1e-9)
    fraction = jnp.minimum(radius / longest, 1.0)
    done = jnp.minimum(fraction * jnp.arange(steps + 1), 1.0)
    return jnp.diff(done)[:, None, None] * way


def _wrap(angle: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    return (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi
