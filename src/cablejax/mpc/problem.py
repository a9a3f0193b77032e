"""The planning problem of one control step."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cablejax.arrays import rms_length
from cablejax.limits import check
from cablejax.mpc.feasible import FeasibleSet
from cablejax.mpc.target_pose import continued, target_pose, total_turn, way_to
from cablejax.residual.jacobian import Dynamics, step_jacobian
from cablejax.types import ROTATION_WEIGHT, History, advance


@dataclasses.dataclass(frozen=True)
class ObjectiveConfig:
    """Weights and units of the objective.

    Attributes:
        terminal_weight: weight of the last predicted shape; every other shape has 1.
        motion_weight: weight of the squared motion, relative to the squared keypoint error. It selects among plans
            that shape the cable equally well: small enough not to matter, large enough to make the problem well posed.
        rotation_weight: w [m/rad], the length that a rotation of one radian counts as.
        interval: duration of one control step [s].
        arrival_weight: weight of the squared way that is left, at the end of the plan, to where the target's ends are
            held. The keypoints say little about how the grippers must turn until the shape is nearly there, and a plan
            that sees six steps ahead turns them last; so the far way is made shorter from the start.
        arrival_margin: what is left of that way within this counts nothing, the keypoints alone decide there [m]: how
            the ends are held is read off the target's keypoints (`target_pose`), and is not known to a hair.
    """

    terminal_weight: float = 1.0
    motion_weight: float = 1e-3
    rotation_weight: float = ROTATION_WEIGHT
    interval: float = 1.0
    arrival_weight: float = 1.0
    arrival_margin: float = 0.05

    def __post_init__(self):
        weights = ("terminal_weight", "motion_weight", "arrival_weight", "arrival_margin")
        check(self, "interval", rotation_weight="positive", **dict.fromkeys(weights, "not_negative"))

    def to_twist(self, motion: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """The twist (vx, vy, omega) that makes a motion (metres, see `feasible`) within one interval."""
        return motion / (self.interval * jnp.asarray([1.0, 1.0, self.rotation_weight], motion.dtype))

    def to_motion(self, twist: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """The motion in metres that a twist makes within one interval; the inverse of `to_twist`."""
        return twist * (self.interval * jnp.asarray([1.0, 1.0, self.rotation_weight], twist.dtype))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Rollout:
    """Result of `ShapingProblem.rollout`.

    Attributes:
        motion: the plan [m], shape [T, Q, 3].
        met: the histories that its steps start from, with a leading axis T.
        shapes: predicted keypoints X(1), ..., X(T) [m], shape [T, N, 2].
    """

    motion: Float[Array, "*batch T Q 3"]
    met: History
    shapes: Float[Array, "*batch T N 2"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ShapingProblem:
    """Bring the cable to a target shape within a horizon (Wang et al., RA-L 2022, "Model Predictive Control").

        min over u in feasible   1/2 sum_t [ w_t / N ||X(t) - X_d||^2 + motion_weight ||u(t - 1)||^2 + l(t)^2 ]
                                 + 1/2 arrival_weight sum_q max(||way_q(T)|| - arrival_margin, 0)^2
        with X(t + 1) = X(t) + f(X(t - m : t), R(t)),   R = `objective.to_twist(u)`,   t = 1, ..., T

    l is zero unless the cable is wound up: `l = rotation_weight max(|turn - turn_d| - pi, 0)`, where turn is the angle
    from one gripper's theta to the other's along the cable. A loop cannot be shaped away with the grippers' directions
    as they are, and next to it the keypoint error alone has a minimum. way_q(T) is the motion that takes gripper q from
    the end of the plan to where the target's ends are held (`target_pose.way_to`). Both are ours, not the paper's.

    It is a nonlinear least squares problem: `value` is half the squared norm of `residuals`. All methods are pure and
    differentiable in `motion`, `history`, `target` and `weights` as far as `dynamics` is.

    Attributes:
        dynamics: one-step model `(weights, history, twist) -> displacement`; static.
        weights: its arrays, any pytree.
        history: the last H samples and the grippers' poses.
        target: desired keypoints X_d [m], shape [N, 2].
        feasible: the set that plans are taken from.
        objective: weights and units; static.
    """

    dynamics: Dynamics = dataclasses.field(metadata={"static": True})
    weights: Any
    history: History
    target: Float[Array, "*batch N 2"]
    feasible: FeasibleSet
    objective: ObjectiveConfig = dataclasses.field(default=ObjectiveConfig(), metadata={"static": True})

    @property
    def pose(self) -> Float[Array, "Q 3"]:
        """Gripper poses now, their angles continued along the cable (`target_pose.continued`) [m, rad]."""
        return continued(self.history.gripper_pose, self.history.keypoints[-1])

    def start(self, motion: Float[Array, "T Q 3"]) -> Rollout:
        """The start of a solver from a plan: the nearest feasible one, rolled out."""
        return self.rollout(self.feasible.project(motion))

    def rollout(self, motion: Float[Array, "T Q 3"]) -> Rollout:
        """Rolls a plan out with the model."""

        def one_step(history, twist):
            moved = self.dynamics(self.weights, history, twist)
            after = advance(history, moved, twist, self.objective.interval)
            return after, (history, after.keypoints[-1])

        met, shapes = jax.lax.scan(one_step, self.history, self.objective.to_twist(motion))[1]
        return Rollout(motion, met, shapes)

    def residuals(self, motion: Float[Array, "T Q 3"]) -> Float[Array, " M"]:
        """Shape errors of all predicted steps, motions, winding, way left, weighted [m]; M = T (2N + 3Q + 1) + Q."""
        return self.residuals_of(self.rollout(motion))

    def residuals_of(self, rollout: Rollout) -> Float[Array, " M"]:
        """`residuals` of a plan that is rolled out."""
        shape = self._weigh(rollout.shapes - self.target, rollout.motion)
        return jnp.concatenate([shape, self._of_grippers(rollout.motion)])

    def value(self, motion: Float[Array, "T Q 3"]) -> Float[Array, ""]:
        """The objective, half the sum of squared residuals [m^2]."""
        return self.value_of(self.rollout(motion))

    def value_of(self, rollout: Rollout) -> Float[Array, ""]:
        """The objective of a plan that is rolled out [m^2]."""
        return 0.5 * jnp.sum(self.residuals_of(rollout) ** 2)

    def linearise(
        self, motion: Float[Array, "T Q 3"], known: Rollout | None = None
    ) -> tuple[Float[Array, " M"], Float[Array, "M P"]]:
        """`residuals` and their Jacobian with respect to the flattened motion, P = 3 T Q.

        The residuals are exact; the Jacobian is as good as the model's own (`residual.jacobian.step_jacobian`).

        The model is linearised at every step of the rollout by itself, in reverse mode: up to 2N cotangents a step, all
        steps in one batch. The steps' Jacobians are then multiplied along the horizon, which costs next to nothing.
        Forward mode carries P tangents through T steps, one after the other: work that grows with the square of the
        horizon.

        Args:
            motion: the plan.
            known: the plan's rollout, where it has been made already.
        """
        here = self.rollout(motion) if known is None else known
        twist = self.objective.to_twist(motion)
        of_steps = jax.vmap(functools.partial(step_jacobian, self.dynamics, self.weights))(here.met, twist)

        unit_motions = jnp.eye(motion.size, dtype=motion.dtype).reshape(motion.size, *motion.shape)
        unit_twists = self.objective.to_twist(jnp.swapaxes(unit_motions, 0, 1))
        still = jax.tree.map(lambda x: jnp.zeros((motion.size, *x.shape), x.dtype), self.history)

        def one_step(tangents, step):
            jacobian, twists = step
            inputs = tangents.keypoints, tangents.gripper_pose, twists
            of_history, of_pose, of_twist = (
                jnp.tensordot(x, slope, (tuple(range(1, x.ndim)), tuple(range(2, slope.ndim))))
                for x, slope in zip(inputs, jacobian, strict=True)
            )
            moves = of_history + of_pose + of_twist
            # linear in all three: its own derivative
            tangents = jax.vmap(functools.partial(advance, interval=self.objective.interval))(tangents, moves, twists)
            return tangents, tangents.keypoints[:, -1]

        slope = jnp.swapaxes(jax.lax.scan(one_step, still, (of_steps, unit_twists))[1], 0, 1)
        jacobian = jax.vmap(self._weigh)(slope, unit_motions).T
        of_grippers = jax.jacfwd(self._of_grippers)(motion).reshape(-1, motion.size)
        return self.residuals_of(here), jnp.concatenate([jacobian, of_grippers])

    def shape_error(self, keypoints: Float[Array, "*batch N 2"]) -> Float[Array, "*batch"]:
        """Root mean square distance of keypoints to the target [m]."""
        return rms_length(keypoints - self.target)

    def _weigh(self, shape_error: Float[Array, "T N 2"], motion: Float[Array, "T Q 3"]) -> Float[Array, " M"]:
        n_steps, n_keypoints = shape_error.shape[:2]
        weight = jnp.ones(n_steps, motion.dtype).at[-1].set(self.objective.terminal_weight)
        shape = jnp.sqrt(weight / n_keypoints)[:, None, None] * shape_error
        return jnp.concatenate([shape.ravel(), self.objective.motion_weight**0.5 * motion.ravel()])

    def _of_grippers(self, motion: Float[Array, "T Q 3"]) -> Float[Array, " T+Q"]:
        """Residuals of the grippers' poses: winding after every step, weighted distance after the last one [m]."""
        pose, weight = self.pose, self.objective.rotation_weight
        turn = pose[1, 2] - pose[0, 2] + jnp.cumsum(motion[:, 1, 2] - motion[:, 0, 2]) / weight
        wound = weight * jnp.maximum(jnp.abs(turn - total_turn(self.target)) - jnp.pi, 0.0)
        way = way_to(pose, target_pose(self.target), weight) - motion.sum(axis=0)
        # the bound keeps the derivative finite where nothing is left
        length = jnp.sqrt(jnp.maximum(jnp.sum(way**2, axis=1), 1e-12))
        left = jnp.maximum(length - self.objective.arrival_margin, 0.0)
        return jnp.concatenate([wound, self.objective.arrival_weight**0.5 * left])
