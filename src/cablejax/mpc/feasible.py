"""The feasible set of gripper motions, and the projection onto it.

A plan is a motion `u` of shape [T, Q, 3]: what each gripper moves in each interval, with rotations turned into lengths,
`u = (vx dt, vy dt, w omega dt)` in metres. Then the bound on one step is an ordinary Euclidean ball.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from cablejax.bounded.sets import AbstractSet, AffineBalls, Balls, ConvexSet, Halfspaces, Intersection
from cablejax.mpc.sequential_projection import project_sequentially

# Relative distance kept from every bound, in units of rounding, so that a projected plan satisfies it strictly.
_MARGIN_ULP = 16
# Grippers that start outside come back at this share of the fastest way, so that there is room for other aims.
_RETURN_SPEED = 0.9
# Room, relative to the bound on a step, for the first motion after one that was faster than is allowed now.
_CHANGE_ROOM = 0.02


class FeasibleSet(AbstractSet):
    """Motions of two grippers within all bounds. A bound that is None is absent and costs nothing.

    The set is convex but for the least distance, whose bound leaves out a disc: `at` has a half-plane of relative
    positions instead, which touches the disc on the side where the grippers are. Grippers that start outside have a
    bound that closes in on them as they can follow, within the bound on the change, so that distances or a workspace
    alone never leave the set empty. Together, outside both, they may contradict each other, and so may a bound on the
    change (it takes a way to stop): `violation` of a projected plan is then positive.

    Attributes:
        separation: position of gripper 1 relative to gripper 0 at the plan's start [m], shape [2].
        radius: bound epsilon on the norm of each gripper's motion in each step [m], shape [].
        min_distance: least distance between the grippers after every step [m], shape [].
        max_distance: greatest distance between the grippers after every step [m]: a cable does not stretch, shape [].
        position: of both grippers at the plan's start [m], shape [Q, 2]; goes with `workspace`.
        workspace: lowest and highest corner of where the grippers may be [m], shape [2, 2].
        change: bound on the norm of the change of each gripper's motion from step to step [m], shape [].
        previous: motion of the step before the plan [m], shape [Q, 3]; goes with `change`.
    """

    separation: Float[Array, "*batch 2"]
    radius: Float[Array, "*batch"]
    min_distance: Float[Array, "*batch"]
    max_distance: Float[Array, "*batch"]
    position: Float[Array, "*batch Q 2"] | None = None
    workspace: Float[Array, "*batch 2 2"] | None = None
    change: Float[Array, "*batch"] | None = None
    previous: Float[Array, "*batch Q 3"] | None = None

    def at(self, y: Float[Array, "T 2 3"]) -> ConvexSet:
        """The convex part of the set around a feasible plan, and within all bounds by rounding."""
        n_steps, dtype = len(y), y.dtype
        tight = 1.0 - _MARGIN_ULP * jnp.finfo(dtype).eps
        lower, upper = self._distance_bounds(n_steps)
        apart = jnp.asarray(_sums(n_steps)[:, 1] - _sums(n_steps)[:, 0], dtype)
        start = jnp.broadcast_to(self.separation, (n_steps, 2)).astype(dtype)
        relative = start + jnp.cumsum(y[:, 1, :2] - y[:, 0, :2], axis=0)
        length = jnp.linalg.norm(relative, axis=-1, keepdims=True)
        # where the grippers are at one point no direction is better than another
        outward = jnp.where(length > 1e-9, relative / jnp.maximum(length, 1e-9), jnp.asarray([1.0, 0.0], dtype))
        members: list[ConvexSet] = [
            Balls(self.radius * tight),
            AffineBalls(apart, start, upper * tight),
            Halfspaces(
                -jnp.einsum("ti,tip->tp", outward, apart),
                jnp.sum(outward * start, axis=-1) - lower * (2.0 - tight),
            ),
        ]
        if self.workspace is not None and self.position is not None:
            members.append(self._workspace_planes(n_steps, dtype))
        if self.change is not None and self.previous is not None:
            members.append(self._change_balls(n_steps, dtype))
        return Intersection(tuple(members))

    def project(self, y: Float[Array, "T 2 3"]) -> Float[Array, "T 2 3"]:
        """The nearest feasible plan, on the side of the least distance that the plan is on; a feasible one is left.

        The side is that of the plan with each step made feasible in the order in which they will be executed, each from
        where the previous ones have taken the grippers. If the grippers start outside the distance bounds, the plan
        brings them back. Differentiable almost everywhere.
        """
        return _nearest_plan(self, y)

    def restore(self, y: Float[Array, "T 2 3"]) -> Float[Array, "T 2 3"]:
        """A plan that keeps every bound but that on the change, cheaply, where the grippers start inside them.

        From outside it comes near the bounds that close in, no more: see `project_sequentially`.
        """
        tight = 1.0 - _MARGIN_ULP * jnp.finfo(y.dtype).eps
        corners = None
        if self.workspace is not None:
            corners = jnp.stack(self._workspace_bounds(len(y)), axis=1).astype(y.dtype)
        lower, upper = self._distance_bounds(len(y))
        return project_sequentially(
            y,
            separation=self.separation.astype(y.dtype),
            radius=self.radius * tight,
            lower=lower * (2.0 - tight),
            upper=upper * tight,
            position=self.position,
            corners=corners,
        )

    def constraints(self, y: Float[Array, "T 2 3"]) -> Float[Array, " K"]:
        """Smooth violation of each bound [m]: norms, greatest and least distance, workspace, changes."""
        lower, upper = self._distance_bounds(len(y))
        relative = self._separations(y)
        parts = [
            _ball_excess(y, self.radius).ravel(),
            _ball_excess(relative, upper),
            -_ball_excess(relative, jnp.maximum(lower, 0.1 * upper), lower),
        ]
        if self.workspace is not None:
            low, high = self._workspace_bounds(len(y))
            parts += [(low - self._positions(y)).ravel(), (self._positions(y) - high).ravel()]
        if self.change is not None:
            parts.append(_ball_excess(self._changes(y), self._change_bounds(len(y))).ravel())
        return jnp.concatenate(parts)

    def violation(self, y: Float[Array, "T 2 3"]) -> Float[Array, ""]:
        """By how much the worst step of a plan breaks its worst bound [m]; 0 for a feasible plan."""
        return jnp.maximum(self._worst_excess(y, tight=1.0), 0.0)

    def _worst_excess(self, y: Float[Array, "T 2 3"], tight: float) -> Float[Array, ""]:
        """The worst excess over a bound [m], radius and distances being tightened by a factor; negative inside."""
        lower, upper = self._distance_bounds(len(y))
        distance = jnp.linalg.norm(self._separations(y), axis=-1)
        excess = [
            (jnp.linalg.norm(y, axis=-1) - self.radius * tight).max(),
            (distance - upper * tight).max(),
            (lower * (2.0 - tight) - distance).max(),
        ]
        if self.workspace is not None:
            low, high = self._workspace_bounds(len(y))
            excess += [(low - self._positions(y)).max(), (self._positions(y) - high).max()]
        if self.change is not None:
            excess.append((jnp.linalg.norm(self._changes(y), axis=-1) - self._change_bounds(len(y))).max())
        return jnp.stack(excess).max()

    def empty(self) -> Bool[Array, ""]:
        """Whether bounds, or the poses and motions that they are about, contradict themselves or are NaN.

        A radius of zero is not empty: it allows rest.
        """
        pairs = [(self.min_distance, self.max_distance), (0.0, self.radius)]
        if self.workspace is not None:
            pairs.append((self.workspace[0], self.workspace[1]))
        if self.change is not None:
            pairs.append((0.0, self.change))
        ordered = jnp.stack([jnp.all(lower <= upper) for lower, upper in pairs]).all()
        known = [x for x in (self.separation, self.radius, self.position, self.previous) if x is not None]
        return ~(ordered & jnp.stack([jnp.isfinite(x).all() for x in known]).all())

    def _separations(self, motion: Float[Array, "T 2 3"]) -> Float[Array, "T 2"]:
        """Position of gripper 1 relative to gripper 0 after each step [m]."""
        return self.separation + jnp.cumsum(motion[:, 1, :2] - motion[:, 0, :2], axis=0)

    def _positions(self, motion: Float[Array, "T 2 3"]) -> Float[Array, "T 2 2"]:
        return self.position + jnp.cumsum(motion[..., :2], axis=0)  # pyright: ignore[reportOptionalOperand]

    def _changes(self, motion: Float[Array, "T 2 3"]) -> Float[Array, "T 2 3"]:
        return jnp.diff(motion, axis=0, prepend=self.previous[None])  # pyright: ignore[reportOptionalSubscript]

    def _distance_bounds(self, n_steps: int) -> tuple[Float[Array, " T"], Float[Array, " T"]]:
        """Least and greatest distance after each step, wider while the grippers come back from outside."""
        distance = jnp.linalg.norm(self.separation)
        apart = jnp.zeros_like(distance)
        if self.previous is not None:
            outward = self.separation / jnp.maximum(distance, 1e-9)
            apart = jnp.sum(outward * (self.previous[1, :2] - self.previous[0, :2]))
        out, back = (self._way_back(n_steps, speed, 2.0 * _RETURN_SPEED) for speed in (apart, -apart))
        return self._outside_only(distance, (self.min_distance, self.max_distance), (distance + out, distance - back))

    def _workspace_bounds(self, n_steps: int) -> tuple[Float[Array, "T 2 2"], Float[Array, "T 2 2"]]:
        """Lowest and highest positions after each step, wider while the grippers come back from outside."""
        lower, upper = self.workspace  # pyright: ignore[reportGeneralTypeIssues]
        position: Array = self.position  # pyright: ignore[reportAssignmentType]
        speed = jnp.zeros_like(position) if self.previous is None else self.previous[:, :2]
        up, down = (self._way_back(n_steps, towards, _RETURN_SPEED / math.sqrt(2.0)) for towards in (speed, -speed))
        return self._outside_only(position, (lower, upper), (position + up, position - down))

    def _way_back(self, n_steps: int, towards: Float[Array, "..."], share: float) -> Float[Array, "T ..."]:
        """How far the grippers come after each step [m], at a share of the radius and of the bound on the change.

        `towards` is their motion in that direction in the step before [m].
        """
        steps = jnp.arange(1, n_steps + 1).reshape(-1, *[1] * towards.ndim)
        if self.change is None:
            return share * self.radius * steps
        return jnp.cumsum(jnp.minimum(share * self.radius, towards + share * self.change * steps), axis=0)

    def _outside_only(self, start: Array, bounds: tuple[Array, Array], closing: tuple[Array, Array]) -> Any:
        """Bounds that are as far out as `closing` where the grippers start outside of them."""
        (lower, upper), (low, high) = bounds, closing
        wider = jnp.minimum(lower, low), jnp.maximum(upper, high)
        if self.change is None:
            return wider
        # grippers that start inside and cannot brake in time get no wider bound
        return jnp.where(start < lower, wider[0], lower), jnp.where(start > upper, wider[1], upper)

    def _workspace_planes(self, n_steps: int, dtype) -> Halfspaces:
        low, high = self._workspace_bounds(n_steps)
        rows = jnp.asarray(_sums(n_steps).reshape(-1, 6 * n_steps), dtype)
        start = jnp.broadcast_to(self.position, low.shape)  # pyright: ignore[reportArgumentType]
        margin = _MARGIN_ULP * jnp.finfo(dtype).eps * (jnp.abs(low) + jnp.abs(high))
        bounds = jnp.concatenate([(high - margin - start).ravel(), (start - low - margin).ravel()])
        return Halfspaces(jnp.concatenate([rows, -rows]), bounds)

    def _change_bounds(self, n_steps: int) -> Float[Array, "T 2"]:
        """Bound on each change; the first is wider where the last command was faster than is allowed now."""
        excess = jnp.linalg.norm(self.previous, axis=-1) - self.radius  # pyright: ignore[reportArgumentType]
        wider = excess + _CHANGE_ROOM * self.radius
        return jnp.broadcast_to(self.change, (n_steps, 2)).at[0].max(wider)  # pyright: ignore[reportArgumentType]

    def _change_balls(self, n_steps: int, dtype) -> AffineBalls:
        difference = np.kron(np.eye(n_steps) - np.eye(n_steps, k=-1), np.eye(6)).reshape(2 * n_steps, 3, 6 * n_steps)
        previous = jnp.zeros((n_steps, 2, 3), dtype).at[0].set(-self.previous.astype(dtype))  # pyright: ignore[reportOptionalMemberAccess]
        tight = 1.0 - _MARGIN_ULP * jnp.finfo(dtype).eps
        return AffineBalls(
            jnp.asarray(difference, dtype), previous.reshape(-1, 3), self._change_bounds(n_steps).ravel() * tight
        )


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


@jax.jit
def _nearest_plan(feasible: FeasibleSet, y: Float[Array, "T 2 3"]) -> Float[Array, "T 2 3"]:
    """See `FeasibleSet.project`; compiled once also where nothing around it is."""

    def nearest():
        convex = feasible.at(feasible.restore(y))
        return convex.restore(convex.project(y))

    # Half the margin: what was projected stays, and what only touches a bound does not pass it in other units. A plan
    # that is not a number is not broken either.
    tight = 1.0 - 0.5 * _MARGIN_ULP * float(jnp.finfo(y.dtype).eps)
    return jax.lax.cond(feasible._worst_excess(y, tight) > 0.0, nearest, lambda: y)


def _sums(n_steps: int) -> np.ndarray:
    """Rows that give both grippers' displacements (x, y) after each step from the flattened plan, [T, Q, 2, P]."""
    so_far = np.tril(np.ones((n_steps, n_steps)))
    return np.einsum("ts,qr,ij->tqisrj", so_far, np.eye(2), np.eye(2, 3)).reshape(n_steps, 2, 2, 6 * n_steps)


def _ball_excess(
    vectors: Float[Array, "*batch D"], scale: Float[Array, "..."], radius: Float[Array, "..."] | None = None
) -> Float[Array, "*batch"]:
    """`(|v|^2 - r^2) / 2 s`, smooth, and for s = r about `|v| - r` near the bound."""
    radius = scale if radius is None else radius
    return (jnp.sum(vectors**2, axis=-1) - radius**2) / (2.0 * jnp.maximum(scale, 1e-9))
