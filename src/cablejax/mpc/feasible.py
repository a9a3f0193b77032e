"""Which gripper motions are allowed, and the nearest allowed motion to a given one.

A plan is a motion `u` of shape [T, Q, 3]: what each gripper moves in each interval, with rotations turned into lengths,
`u = (vx dt, vy dt, w omega dt)` in metres. Then the bound on one step is an ordinary Euclidean ball.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# Alternating projections between the balls and the distance bounds, per step of the plan. Each round shrinks what is
# left of the violation; the scaling at the end removes the rest exactly, at the price of some motion.
_ROUNDS = 4
# Relative distance kept from every bound, so that a projected plan satisfies it strictly in float32.
_MARGIN = 2e-6


def project_ball(motion: Float[Array, "*batch D"], radius: Float[Array, ""] | float) -> Float[Array, "*batch D"]:
    """Nearest point of the Euclidean ball of `radius` around 0 to each last-axis vector.

    Differentiable in both arguments, at the centre too.
    """
    square = jnp.sum(motion**2, axis=-1, keepdims=True)
    outside = square > radius**2
    return jnp.where(outside, motion * (radius / jnp.sqrt(jnp.where(outside, square, 1.0))), motion)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class FeasibleSet:
    """Motions of two grippers within a step bound that keep the distance between the grippers within its bounds.

    Attributes:
        separation: position of gripper 1 relative to gripper 0 at the plan's start [m], shape [2].
        radius: bound epsilon on the norm of each gripper's motion in each step [m], shape [].
        min_distance: least distance between the grippers after every step [m], shape [].
        max_distance: greatest distance between the grippers after every step [m], shape [].
    """

    separation: Float[Array, "*batch 2"]
    radius: Float[Array, "*batch"]
    min_distance: Float[Array, "*batch"]
    max_distance: Float[Array, "*batch"]

    def project(self, motion: Float[Array, "T 2 3"]) -> Float[Array, "T 2 3"]:
        """A feasible plan close to `motion`; a feasible plan is left as it is.

        Steps are projected in the order in which they will be executed, each from where the previous ones have taken
        the grippers. Within a step the projection is the exact one where only the balls bind, and alternating
        projections onto the balls and the distance bounds otherwise. Holding still is always feasible, so that a step
        which these rounds leave outside is scaled towards it until it is inside. If the grippers start outside the
        distance bounds, the plan brings them back as fast as the balls allow. Differentiable almost everywhere.
        """

        def one_step(separation, step):
            step = self._project_step(separation, step)
            return separation + step[1, :2] - step[0, :2], step

        return jax.lax.scan(one_step, self.separation, motion)[1]

    def violation(self, motion: Float[Array, "T 2 3"]) -> Float[Array, ""]:
        """By how much the worst step of a plan breaks its worst bound [m]; 0 for a feasible plan."""
        norm = jnp.linalg.norm(motion, axis=-1)
        relative = self.separation + jnp.cumsum(motion[:, 1, :2] - motion[:, 0, :2], axis=0)
        distance = jnp.linalg.norm(relative, axis=-1)
        worst = jnp.stack([(norm - self.radius).max(), (distance - self.max_distance).max()])
        return jnp.maximum(jnp.maximum(worst.max(), (self.min_distance - distance).max()), 0.0)

    def _project_step(self, separation: Float[Array, " 2"], motion: Float[Array, "2 3"]) -> Float[Array, "2 3"]:
        radius = self.radius * (1.0 - _MARGIN)
        lower = self.min_distance * (1.0 + _MARGIN)
        upper = self.max_distance * (1.0 - _MARGIN)
        motion = project_ball(motion, radius)
        for _ in range(_ROUNDS):
            motion = project_ball(_into_annulus(separation, motion, lower, upper), radius)
        return motion * _largest_scale(separation, motion[1, :2] - motion[0, :2], self.min_distance, upper)


def feasible_from(
    gripper_pose: Float[Array, "2 3"], radius: Float[Array, ""] | float, distance: tuple[float, float]
) -> FeasibleSet:
    """The motions allowed from where the grippers are.

    Args:
        gripper_pose: (x, y, theta) of both [m, rad].
        radius: bound on the norm of each gripper's motion in each step [m].
        distance: least and greatest distance between the grippers [m].
    """
    dtype = gripper_pose.dtype
    return FeasibleSet(
        separation=gripper_pose[1, :2] - gripper_pose[0, :2],
        radius=jnp.asarray(radius, dtype),
        min_distance=jnp.asarray(distance[0], dtype),
        max_distance=jnp.asarray(distance[1], dtype),
    )


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
