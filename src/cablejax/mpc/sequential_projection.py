"""Sequential projection: plans made feasible one step after the other, near the given plan and cheap."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cablejax.bounded.sets import project_ball

# Alternating projections between the balls and the distance bounds, per step of the plan. Each round shrinks what is
# left of the violation; the scaling at the end removes the rest exactly, at the price of some motion.
_ROUNDS = 4


def project_sequentially(
    motion: Float[Array, "T 2 3"],
    *,
    separation: Float[Array, " 2"],
    radius: Float[Array, ""],
    lower: Float[Array, " T"],
    upper: Float[Array, " T"],
    position: Float[Array, "Q 2"] | None,
    corners: Float[Array, "T 2 Q 2"] | None,
) -> Float[Array, "T 2 3"]:
    """A plan close to `motion` that keeps all these bounds; feasible plans stay as they are but for rounding.

    Steps are treated in the order in which they will be executed, each from where the previous ones have taken the
    grippers: alternating projections onto the balls and the distance bounds, clipping to the workspace, and scaling
    towards rest until the distance is within its bounds.

    Args:
        motion: [m].
        separation: position of gripper 1 relative to gripper 0 at the start [m].
        radius: of the ball of one gripper's motion in one step [m].
        lower: least distance of the grippers after each step [m].
        upper: greatest distance [m].
        position: of the grippers at the start [m]; goes with `corners`.
        corners: lowest and highest positions after each step [m].
    """
    n_steps = len(motion)
    corners = jnp.zeros((n_steps, 0), motion.dtype) if corners is None else corners
    place = jnp.zeros((2, 2), motion.dtype) if position is None else position.astype(motion.dtype)

    def one_step(carry, given):
        separation, place = carry
        step, low, high, corner = given
        step = project_ball(step, radius)
        for _ in range(_ROUNDS):
            step = project_ball(_into_annulus(separation, step, low, high), radius)
        if corner.size:
            step = step.at[:, :2].set(jnp.clip(place + step[:, :2], *corner) - place)
        step = step * _largest_scale(separation, step[1, :2] - step[0, :2], low, high)
        return (separation + step[1, :2] - step[0, :2], place + step[:, :2]), step

    given = (motion, lower.astype(motion.dtype), upper.astype(motion.dtype), corners)
    return jax.lax.scan(one_step, (separation, place), given)[1]


def _into_annulus(
    separation: Float[Array, " 2"], motion: Float[Array, "2 3"], lower: Float[Array, ""], upper: Float[Array, ""]
) -> Float[Array, "2 3"]:
    """Nearest motion that ends with the grippers' distance within bounds: both give way by the same amount."""
    relative = separation + motion[1, :2] - motion[0, :2]
    distance = jnp.sqrt(jnp.maximum(jnp.sum(relative**2), 1e-12))
    excess = distance - jnp.clip(distance, lower, upper)
    share = 0.5 * excess * relative / distance
    return motion.at[0, :2].add(share).at[1, :2].add(-share)


def _largest_scale(
    separation: Float[Array, " 2"],
    change: Float[Array, " 2"],
    lower: Float[Array, ""],
    upper: Float[Array, ""],
) -> Float[Array, ""]:
    """Largest s in [0, 1] with `lower <= |separation + s change| <= upper`, from the roots of the two quadratics.

    A start that is itself outside counts as lying on the bound it breaks: it may come back, not go further.
    """
    a, b = jnp.sum(change**2), jnp.sum(separation * change)
    start, end = jnp.sum(separation**2), jnp.sum((separation + change) ** 2)
    moving = a > 1e-14

    # |separation + s change|^2 <= upper^2 up to the greater root, written without cancellation for either sign of b.
    leaves = moving & (end > upper**2)
    safe_a, safe_b = jnp.where(leaves, a, 1.0), jnp.where(leaves, b, 1.0)
    slack = jnp.where(leaves, jnp.maximum(upper**2 - start, 0.0), 0.0)
    root = jnp.sqrt(jnp.maximum(safe_b**2 + safe_a * slack, 1e-20))
    to_upper = jnp.where(safe_b >= 0, slack / (jnp.abs(safe_b) + root), (root - safe_b) / safe_a)

    # |separation + s change|^2 >= lower^2 up to the lesser root, if the motion approaches and the roots are real.
    slack = jnp.maximum(start - lower**2, 0.0)
    discriminant = b**2 - a * slack
    enters = moving & (end < lower**2) & (b < 0) & (discriminant > 0)
    to_lower = slack / (jnp.abs(b) + jnp.sqrt(jnp.where(enters, discriminant, 1.0)))

    scale = jnp.minimum(jnp.where(leaves, to_upper, 1.0), jnp.where(enters, to_lower, 1.0))
    return jnp.clip(scale, 0.0, 1.0)
