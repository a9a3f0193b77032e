"""Online visual servo of a cable's shape: no model, only a deformation Jacobian estimated while moving.

Near the present shape the keypoints' displacement is taken as linear in the grippers' motion,

    X(t + 1) - X(t) = J u(t),        J [2N, 6],

with motions `u = (vx dt, vy dt, w omega dt)` of both grippers in metres (see `mpc.feasible`). J is the least squares
fit to the last W observed steps (Zhu et al., IROS 2018), weighted and regularised as in Jin et al., IROS 2019:

    J(t) = argmin  sum_i rho^age_i w_i ||dX_i - J u_i||^2 + lambda ||J - J(t - 1)||^2

where the weights `w_i` leave out keypoints that were not observed and lower the share of outliers (Huber). The penalty
keeps what is known about directions in which the grippers did not move lately. Both papers begin with small motions
of one input after the other; they are part of the run. Then the damped least squares step

    u = -gain (J'J + damping^2 I)^-1 J' (X - X_d)

is shortened as a whole to the largest allowed motion and projected onto the set that `mpc.FeasibleSet` describes.
"""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from cablejax.limits import check
from cablejax.mpc.feasible import feasible_from
from cablejax.mpc.problem import ObjectiveConfig
from cablejax.mpc.validation import check_history, check_measurement, check_target
from cablejax.types import History, Measurement


@dataclasses.dataclass(frozen=True)
class ServoConfig:
    """Settings of the visual servo.

    Attributes:
        cable_length: free length of the cable L [m].
        min_distance: least distance of the grippers, relative to L.
        max_distance: greatest distance of the grippers, relative to L.
        radius: bound on one step's motion of each gripper [m].
        gain: share of the error that one step is to remove, in (0, 1].
        damping: added in squares to the singular values of J (which maps metres to metres): larger is more careful
            where the Jacobian says that a motion does little.
        window: past steps W that J is fitted to.
        forgetting: rho, weight ratio of a step and the next newer one, in (0, 1].
        regularisation: lambda [m^2]; a motion of `sqrt(lambda)` in some direction changes J there half way.
        outlier: displacements farther than this from what J said [m] count in proportion to the distance, not its
            square.
        probe: motion of each input in the beginning [m]; a rotation of `probe / rotation_weight`.
        probe_back: whether each of these motions is taken back by the next step, so that J is that of the start.
        rotation_weight: w [m/rad], the length that a rotation of one radian counts as.
        interval: duration of one control step [s].
    """

    cable_length: float = 1.0
    min_distance: float = 0.15
    max_distance: float = 0.99
    radius: float = 0.05
    gain: float = 0.8
    damping: float = 0.2
    window: int = 8
    forgetting: float = 0.8
    regularisation: float = 2e-5
    outlier: float = 0.02
    probe: float = 0.01
    probe_back: bool = False
    rotation_weight: float = 0.15
    interval: float = 1.0

    def __post_init__(self):
        positive = ("cable_length", "radius", "damping", "regularisation", "outlier", "probe", "rotation_weight")
        check(self, "interval", gain="share", forgetting="share", **dict.fromkeys(positive, "positive"))
        if not 0 <= self.min_distance < self.max_distance <= 1:
            raise ValueError(
                f"ServoConfig distances {self.min_distance} to {self.max_distance}: expected 0 <= min_distance < "
                "max_distance <= 1, relative to the cable's length."
            )
        if self.window < 6:
            raise ValueError(f"ServoConfig.window is {self.window}, expected at least 6, one step for each input.")

    @property
    def n_probes(self) -> int:
        """Steps spent on moving every input of two grippers once."""
        return 12 if self.probe_back else 6


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ServoState:
    """State of the visual servo between steps.

    Attributes:
        jacobian: J, displacement of each keypoint by each input's motion [m/m], shape [N, 2, 6].
        displacement: of the keypoints in the last W steps [m], oldest first, shape [W, N, 2].
        window_motion: of the grippers in these steps [m], shape [W, 6].
        valid: whether a displacement was observed, shape [W, N].
        keypoints: last observation, gaps filled with what J expected [m], shape [N, 2].
        observed: keypoints seen at the last step, shape [N].
        gripper_pose: last measured pose, shape [Q, 3].
        motion: the last command [m], shape [Q, 3].
        steps: control steps so far, shape [].
        unobserved: keypoint observations missing so far, shape [].
    """

    jacobian: Float[Array, "*batch N 2 R"]
    displacement: Float[Array, "*batch W N 2"]
    window_motion: Float[Array, "*batch W R"]
    valid: Bool[Array, "*batch W N"]
    keypoints: Float[Array, "*batch N 2"]
    observed: Bool[Array, "*batch N"]
    gripper_pose: Float[Array, "*batch Q 3"]
    motion: Float[Array, "*batch Q 3"]
    steps: Int[Array, "*batch"]
    unobserved: Int[Array, "*batch"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ServoInfo:
    """Report of one step; every field has shape [].

    Attributes:
        shape_error: root mean square distance to the target now [m].
        predicted_error: the same, expected by J after the command [m].
        fit_error: root mean square distance of the keypoints from what J expected of the last command [m].
        probing: whether the command belongs to the motions of the beginning.
        radius: bound on one step's motion [m].
        unobserved: keypoints not observed now, replaced by their prediction.
    """

    shape_error: Float[Array, "*batch"]
    predicted_error: Float[Array, "*batch"]
    fit_error: Float[Array, "*batch"]
    probing: Bool[Array, "*batch"]
    radius: Float[Array, "*batch"]
    unobserved: Int[Array, "*batch"]


class VisualServo(eqx.Module):
    """Controller without a model: `init` once, then `step` at every control interval.

    Both are pure and may be called inside compiled code. The object is a pytree: vmap over the states for many cables,
    over `target` as well for one target each.

    Attributes:
        config: see `ServoConfig`; static.
        target: desired keypoints [m], shape [N, 2].

    Raises:
        ValueError: if the target is not an array of finite keypoints.
    """

    config: ServoConfig = eqx.field(static=True)
    target: Float[Array | np.ndarray, "*batch N 2"]

    def __check_init__(self):
        check_target(self.target)

    def init(self, history: History) -> ServoState:
        """State for a cable seen at rest, with a Jacobian of zeros; only the newest sample of the history is used.

        Raises:
            ValueError: if the history is empty, not finite or not of floating-point numbers, or has another number of
                keypoints than the target.
        """
        check_history(self.target, history)
        history = jax.tree.map(jnp.asarray, history)
        keypoints = history.keypoints[-1]
        n_keypoints, dtype = keypoints.shape[0], keypoints.dtype
        return ServoState(
            jacobian=jnp.zeros((n_keypoints, 2, history.gripper_pose.size), dtype),
            displacement=jnp.zeros((self.config.window, n_keypoints, 2), dtype),
            window_motion=jnp.zeros((self.config.window, history.gripper_pose.size), dtype),
            valid=jnp.zeros((self.config.window, n_keypoints), bool),
            keypoints=keypoints,
            observed=jnp.ones(n_keypoints, bool),
            gripper_pose=history.gripper_pose,
            motion=jnp.zeros_like(history.gripper_pose),
            steps=jnp.zeros((), jnp.int32),
            unobserved=jnp.zeros((), jnp.int32),
        )

    def step(self, state: ServoState, measurement: Measurement) -> tuple[ServoState, Float[Array, "Q 3"], ServoInfo]:
        """One control step, compiled at its first call: the next state, the twist to hold until then, the report.

        Raises:
            ValueError: if the measurement has another shape than the target's keypoints and two grippers.
        """
        check_measurement(self.target, measurement)
        return _step(self, state, measurement)


@jax.jit
def _step(servo: VisualServo, state: ServoState, measurement: Measurement) -> tuple[ServoState, Array, ServoInfo]:
    """See `VisualServo.step`."""
    config = servo.config
    units = ObjectiveConfig(rotation_weight=config.rotation_weight, interval=config.interval)
    target = jnp.asarray(servo.target)
    state, fit_error, unobserved = _observe(config, units, state, measurement)
    state = dataclasses.replace(state, jacobian=_fit_jacobian(config, state))
    error = state.keypoints - target

    probing = state.steps < config.n_probes
    motion = jnp.where(probing, _probe(config, state), _towards(config, state.jacobian, error))
    limits = config.min_distance * config.cable_length, config.max_distance * config.cable_length
    motion = feasible_from(state.gripper_pose, config.radius, limits).project(motion[None])[0]
    motion = jnp.where(jnp.isfinite(motion).all(), motion, 0.0)
    info = ServoInfo(
        shape_error=_root_mean_square(error),
        predicted_error=_root_mean_square(error + state.jacobian @ motion.reshape(-1)),
        fit_error=fit_error,
        probing=probing,
        radius=jnp.full_like(fit_error, config.radius),
        unobserved=unobserved,
    )
    state = dataclasses.replace(state, motion=motion, steps=state.steps + 1, unobserved=state.unobserved + unobserved)
    return state, units.to_twist(motion), info


def _observe(
    config: ServoConfig, units: ObjectiveConfig, state: ServoState, measurement: Measurement
) -> tuple[ServoState, Float[Array, ""], Int[Array, ""]]:
    """The state with the observation and the step that led to it, how far J was off, and how many keypoints lack.

    The motion is that of the measured poses, which a robot may reach only in part.
    """
    (keypoints, gripper_pose), dtype = map(jnp.asarray, measurement[:2]), state.keypoints.dtype
    expected = state.keypoints + state.jacobian @ state.motion.reshape(-1)
    observed = jnp.isfinite(keypoints).all(axis=-1)
    keypoints = jnp.where(observed[:, None], keypoints, expected).astype(dtype)
    expected_pose = state.gripper_pose + config.interval * units.to_twist(state.motion)
    gripper_pose = jnp.where(jnp.isfinite(gripper_pose), gripper_pose, expected_pose).astype(dtype)
    motion = units.to_motion((gripper_pose - state.gripper_pose) / config.interval)

    valid = observed & state.observed & (state.steps > 0)
    off = jnp.where(valid, jnp.sum((keypoints - expected) ** 2, axis=-1), 0.0)
    state = dataclasses.replace(
        state,
        displacement=_push(state.displacement, keypoints - state.keypoints),
        window_motion=_push(state.window_motion, motion.reshape(-1)),
        valid=_push(state.valid, valid),
        keypoints=keypoints,
        observed=observed,
        gripper_pose=gripper_pose,
    )
    fit_error = jnp.sqrt(off.sum() / jnp.maximum(valid.sum(), 1))
    return state, fit_error, jnp.sum(~observed, dtype=jnp.int32)


def _fit_jacobian(config: ServoConfig, state: ServoState) -> Float[Array, "N 2 R"]:
    """The weighted, regularised least squares fit, as a correction of the last Jacobian.

    Each keypoint has its own system, because it may be unobserved at other times than its neighbours.
    """
    age = jnp.arange(config.window - 1, -1, -1)
    off = state.displacement - jnp.einsum("ndr,wr->wnd", state.jacobian, state.window_motion)
    distance = jnp.sqrt(jnp.sum(off**2, axis=-1) + 1e-18)
    # Nothing is expected before every input has been moved, so nothing is an outlier.
    huber = jnp.where(state.steps > config.n_probes, jnp.minimum(1.0, config.outlier / distance), 1.0)
    weight = state.valid * huber * (config.forgetting**age)[:, None]
    gram = jnp.einsum("wn,wr,ws->nrs", weight, state.window_motion, state.window_motion)
    moment = jnp.einsum("wn,wr,wnd->nrd", weight, state.window_motion, off)
    # While every input is moved for the first time there is no past estimate worth keeping.
    kept = jnp.where(state.steps > config.n_probes, config.regularisation, 1e-3 * config.probe**2)
    change = jnp.linalg.solve(gram + kept * jnp.eye(gram.shape[-1]), moment)
    fitted = state.jacobian + jnp.swapaxes(change, 1, 2)
    return jnp.where(jnp.isfinite(fitted), fitted, state.jacobian)


def _probe(config: ServoConfig, state: ServoState) -> Float[Array, "Q 3"]:
    """The next small motion of one input; translations go towards the other gripper, where the cable has slack."""
    index = state.steps // 2 if config.probe_back else state.steps
    towards = jnp.where(state.gripper_pose[1, :2] >= state.gripper_pose[0, :2], 1.0, -1.0)
    sign = jnp.concatenate([towards, jnp.ones(1), -towards, -jnp.ones(1)])
    back = jnp.where(config.probe_back & (state.steps % 2 == 1), -1.0, 1.0)
    return (back * config.probe * sign * (jnp.arange(6) == index)).reshape(2, 3).astype(state.motion.dtype)


def _towards(config: ServoConfig, jacobian: Float[Array, "N 2 R"], error: Float[Array, "N 2"]) -> Float[Array, "Q 3"]:
    """The damped least squares motion, shortened as a whole, so that its direction stays, to the step bound."""
    matrix = jacobian.reshape(-1, jacobian.shape[-1])
    normal = matrix.T @ matrix + config.damping**2 * jnp.eye(matrix.shape[1], dtype=matrix.dtype)
    motion = -config.gain * jnp.linalg.solve(normal, matrix.T @ error.reshape(-1)).reshape(2, 3)
    largest = jnp.linalg.norm(motion, axis=-1).max()
    return motion * jnp.minimum(1.0, config.radius / jnp.maximum(largest, 1e-12))


def _root_mean_square(error: Float[Array, "N 2"]) -> Float[Array, ""]:
    return jnp.sqrt(jnp.mean(jnp.sum(error**2, axis=-1)))


def _push(window: Array, newest: Array) -> Array:
    return jnp.concatenate([window, newest[None]])[1:]
