"""Which gripper motions are allowed, and the nearest allowed motion to a given one.

A plan is a motion `u` of shape [T, Q, 3]: what each gripper moves in each interval, with rotations turned into lengths,
`u = (vx dt, vy dt, w omega dt)` in metres. Then the bound on one step is an ordinary Euclidean ball.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cablejax.bounded.sets import AbstractSet, ball_gauge, project_ball

__all__ = ["FeasibleSet", "feasible_from", "project_ball"]

# Relative distance kept from every bound, in units of rounding, so that a projected plan satisfies it strictly.
_MARGIN_ULP = 16
# Alternating projections within one step where a motion is made feasible step by step.
_ROUNDS = 4
# Grippers that start outside come back at this share of the fastest way, so that there is room for other aims.
_RETURN_SPEED = 0.9


class FeasibleSet(AbstractSet):
    """Motions of two grippers within all their bounds. Those that are None are not there.

    The set is convex but for the least distance, whose bound leaves out a disc: there, `project` gives a nearest point
    on the side that the motion is on. It is never empty for distances and a workspace in order: grippers that start
    outside have a bound that closes in on them as they can follow. A bound on the change may contradict the others
    (it takes a way to stop), which `project` cannot mend and `violation` tells.

    Attributes:
        separation: position of gripper 1 relative to gripper 0 at the plan's start [m], shape [2].
        radius: bound epsilon on the norm of each gripper's motion in each step [m], shape [].
        min_distance: least distance between the grippers after every step [m], shape [].
        max_distance: greatest distance between the grippers after every step [m]: a cable does not stretch, shape [].
        box: least and greatest motion of each gripper in each step [m], shape [2, Q, 3]; must include rest.
        position: of both grippers at the plan's start [m], shape [Q, 2]; goes with `workspace`.
        workspace: lowest and highest corner of where the grippers may be [m], shape [2, 2].
        change: bound on the norm of the change of each gripper's motion from step to step [m], shape [].
        previous: motion of the step before the plan [m], shape [Q, 3]; goes with `change`.
    """

    separation: Float[Array, "*batch 2"]
    radius: Float[Array, "*batch"]
    min_distance: Float[Array, "*batch"]
    max_distance: Float[Array, "*batch"]
    box: Float[Array, "*batch 2 Q 3"] | None = None
    position: Float[Array, "*batch Q 2"] | None = None
    workspace: Float[Array, "*batch 2 2"] | None = None
    change: Float[Array, "*batch"] | None = None
    previous: Float[Array, "*batch Q 3"] | None = None

    def lift(self, y: Float[Array, "..."]) -> Float[Array, " M"]:
        """The motions; and the grippers' separations, positions and changes of motion, each scaled to unit rows."""
        motion = y.reshape(-1, 2, 3)
        parts = [motion.ravel()]
        if self.box is not None:
            parts.append(motion.ravel())
        parts.append((_separations(self.separation, motion) / _row_length(motion, 2)).ravel())
        if self.workspace is not None:
            parts.append((self._positions(motion) / _row_length(motion, 1)[..., None]).ravel())
        if self.change is not None:
            parts.append((self._changes(motion) / math.sqrt(2.0)).ravel())
        return jnp.concatenate(parts)

    def clip(self, z: Float[Array, " M"]) -> Float[Array, " M"]:
        """The nearest values of all of these, each by itself."""
        motion, in_box, separation, position, change = self._pieces(z)
        parts = [project_ball(motion, self.radius).ravel()]
        if in_box is not None:
            parts.append(jnp.clip(in_box, *self.box).ravel())  # pyright: ignore[reportOptionalIterable]
        scale = _row_length(motion, 2)
        lower, upper = self._distance_bounds(motion)
        length = jnp.sqrt(jnp.maximum(jnp.sum(separation**2, axis=-1), 1e-24))
        parts.append(
            (separation * (jnp.clip(length, lower / scale[:, 0], upper / scale[:, 0]) / length)[:, None]).ravel()
        )
        if position is not None:
            scale = _row_length(motion, 1)[..., None]
            lower, upper = self._workspace_bounds(motion)
            parts.append(jnp.clip(position, lower / scale, upper / scale).ravel())
        if change is not None:
            parts.append(project_ball(change, self._change_bounds(motion)[..., None] / math.sqrt(2.0)).ravel())
        return jnp.concatenate(parts)

    def gauge(self, z: Float[Array, " M"]) -> Float[Array, " K"]:
        """By how much each bound is broken [m]: norms, box, greatest and least distances, workspace, changes."""
        motion, in_box, separation, position, change = self._pieces(z)
        parts = [ball_gauge(motion, self.radius).ravel()]
        if in_box is not None:
            parts += [(self.box[0] - in_box).ravel(), (in_box - self.box[1]).ravel()]  # pyright: ignore[reportOptionalSubscript]
        separation = separation * _row_length(motion, 2)
        lower, upper = self._distance_bounds(motion)
        parts += [ball_gauge(separation, upper), -ball_gauge(separation, lower)]
        if position is not None:
            position = position * _row_length(motion, 1)[..., None]
            lower, upper = self._workspace_bounds(motion)
            parts += [(lower - position).ravel(), (position - upper).ravel()]
        if change is not None:
            parts.append(ball_gauge(math.sqrt(2.0) * change, self._change_bounds(motion)).ravel())
        return jnp.concatenate(parts)

    def restore(self, y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """A plan close to `y` that keeps every bound but that on the change, strictly.

        Steps are treated in the order in which they will be executed, each from where the previous ones have taken the
        grippers: clipped to the ball, the box and the workspace, and scaled towards rest until the distance is within
        its bounds. Feasible plans stay as they are but for rounding.
        """
        motion = y.reshape(-1, 2, 3)
        tight = 1.0 - _MARGIN_ULP * jnp.finfo(y.dtype).eps
        radius = self.radius * tight
        lower, upper = self.min_distance * (2.0 - tight), self.max_distance * tight
        corners = (
            jnp.zeros((len(motion), 0)) if self.workspace is None else jnp.stack(self._workspace_bounds(motion), 1)
        )

        def one_step(carry, given):
            separation, position = carry
            step, corner = given
            step = project_ball(step, radius)
            step = jax.lax.fori_loop(
                0, _ROUNDS, lambda _, u: project_ball(_into_annulus(separation, u, lower, upper), radius), step
            )
            if self.box is not None:
                step = jnp.clip(step, *self.box)
            if self.workspace is not None:
                step = step.at[:, :2].set(jnp.clip(position + step[:, :2], *corner) - position)
                position = position + step[:, :2]
            scale = _largest_scale(separation, step[1, :2] - step[0, :2], self.min_distance, upper)
            step = step * scale
            return (separation + step[1, :2] - step[0, :2], position), step

        position = jnp.zeros((2, 2), y.dtype) if self.position is None else self.position
        start = (self.separation.astype(y.dtype), position.astype(y.dtype))
        return jax.lax.scan(one_step, start, (motion, corners))[1].reshape(y.shape)

    def possible(self) -> Bool[Array, ""]:
        """Whether the bounds make sense: finite, not negative, the lesser ones not above the greater ones."""
        pairs = [(self.min_distance, self.max_distance), (0.0, self.radius)]
        if self.box is not None:
            pairs += [(self.box[0], self.box[1]), (self.box[0], 0.0), (0.0, self.box[1])]
        if self.workspace is not None:
            pairs.append((self.workspace[0], self.workspace[1]))
        if self.change is not None:
            pairs.append((0.0, self.change))
        ordered = jnp.stack([jnp.all(lower <= upper) for lower, upper in pairs]).all()
        return ordered & jnp.isfinite(self.separation).all() & jnp.isfinite(self.radius)

    def starts_outside(self) -> Bool[Array, ""]:
        """Whether the grippers are beyond their distance bounds or their workspace before the first step."""
        distance = jnp.linalg.norm(self.separation)
        slack = 1e-6 * self.max_distance
        outside = (distance > self.max_distance + slack) | (distance < self.min_distance - slack)
        if self.workspace is not None:
            outside |= jnp.any(
                (self.position < self.workspace[0] - slack) | (self.position > self.workspace[1] + slack)
            )
        return outside

    def _pieces(self, z: Float[Array, " M"]):
        """What `lift` puts together; None for what is not bounded."""
        # per step: motions 6, box 6, separation 2, positions 4, changes 6
        present = (True, self.box is not None, True, self.workspace is not None, self.change is not None)
        widths = [w * there for w, there in zip((6, 6, 2, 4, 6), present, strict=True)]
        n_steps = z.size // sum(widths)
        shapes = ((n_steps, 2, 3), (n_steps, 2, 3), (n_steps, 2), (n_steps, 2, 2), (n_steps, 2, 3))
        pieces, begin = [], 0
        for width, shape in zip(widths, shapes, strict=True):
            pieces.append(z[begin : begin + width * n_steps].reshape(shape) if width else None)
            begin += width * n_steps
        return pieces

    def _positions(self, motion: Float[Array, "T 2 3"]) -> Float[Array, "T 2 2"]:
        return self.position + jnp.cumsum(motion[..., :2], axis=0)

    def _changes(self, motion: Float[Array, "T 2 3"]) -> Float[Array, "T 2 3"]:
        return jnp.diff(motion, axis=0, prepend=self.previous[None])  # pyright: ignore[reportOptionalSubscript]

    def _distance_bounds(self, motion: Float[Array, "T 2 3"]) -> tuple[Float[Array, " T"], Float[Array, " T"]]:
        """Least and greatest distance after each step, wider while the grippers come back from outside."""
        distance = jnp.linalg.norm(self.separation)
        reach = 2.0 * _RETURN_SPEED * self.radius * jnp.arange(1, len(motion) + 1)
        return jnp.minimum(self.min_distance, distance + reach), jnp.maximum(self.max_distance, distance - reach)

    def _workspace_bounds(self, motion: Float[Array, "T 2 3"]) -> tuple[Float[Array, "T 2 2"], Float[Array, "T 2 2"]]:
        """Lowest and highest positions after each step, wider while the grippers come back from outside."""
        reach = _RETURN_SPEED / math.sqrt(2.0) * self.radius * jnp.arange(1, len(motion) + 1)[:, None, None]
        lower, upper = self.workspace  # pyright: ignore[reportGeneralTypeIssues]
        return jnp.minimum(lower, self.position + reach), jnp.maximum(upper, self.position - reach)

    def _change_bounds(self, motion: Float[Array, "T 2 3"]) -> Float[Array, "T 2"]:
        """Bound on each change; the first is wider where the last command was faster than is allowed now."""
        excess = jnp.linalg.norm(self.previous, axis=-1) - self.radius
        return jnp.broadcast_to(self.change, motion.shape[:2]).at[0].max(excess)


def feasible_from(
    gripper_pose: Float[Array, "2 3"],
    radius: Float[Array, ""] | float,
    distance: tuple[float, float],
    *,
    workspace: tuple[tuple[float, float], tuple[float, float]] | None = None,
    change: float | None = None,
    previous: Float[Array, "2 3"] | None = None,
) -> FeasibleSet:
    """The motions allowed from where the grippers are.

    Args:
        gripper_pose: (x, y, theta) of both [m, rad].
        radius: bound on the norm of each gripper's motion in each step [m].
        distance: least and greatest distance between the grippers [m].
        workspace: lowest and highest corner (x, y) of where the grippers may be [m]; None = anywhere.
        change: bound on the norm of the change of each gripper's motion from step to step [m]; None = any.
        previous: motion of the step before [m], shape [2, 3]; None = rest.
    """
    dtype = gripper_pose.dtype
    return FeasibleSet(
        separation=gripper_pose[1, :2] - gripper_pose[0, :2],
        radius=jnp.asarray(radius, dtype),
        min_distance=jnp.asarray(distance[0], dtype),
        max_distance=jnp.asarray(distance[1], dtype),
        position=None if workspace is None else gripper_pose[:, :2],
        workspace=None if workspace is None else jnp.asarray(workspace, dtype),
        change=None if change is None else jnp.asarray(change, dtype),
        previous=None if change is None else (jnp.zeros((2, 3), dtype) if previous is None else previous),
    )


def _separations(start: Float[Array, " 2"], motion: Float[Array, "T 2 3"]) -> Float[Array, "T 2"]:
    """Position of gripper 1 relative to gripper 0 after each step [m]."""
    return start + jnp.cumsum(motion[:, 1, :2] - motion[:, 0, :2], axis=0)


def _row_length(motion: Float[Array, "T 2 3"], per_step: int) -> Float[Array, "T 1"]:
    """Euclidean length of the row of a sum over the steps so far."""
    return jnp.sqrt(per_step * jnp.arange(1.0, len(motion) + 1.0))[:, None]


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
