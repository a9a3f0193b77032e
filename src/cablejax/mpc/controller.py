"""The receding-horizon controller: observe, correct the model, plan, command; all of it one compiled call."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from cablejax.adaptation.belief import CableBelief, update
from cablejax.mpc.config import MPCConfig
from cablejax.mpc.controller_state import ControlInfo, ControllerState, initial_state
from cablejax.mpc.edge import check_observation, check_start, check_target
from cablejax.mpc.fallback import plan_or_hold, plan_or_restart
from cablejax.mpc.feasible import FeasibleSet, feasible_from
from cablejax.mpc.problem import ShapingProblem
from cablejax.mpc.start import find_starts
from cablejax.residual.corrected import Corrected
from cablejax.residual.jacobian import Dynamics
from cablejax.residual.ridge import ResidualModel, apply, fit
from cablejax.types import History


def control(
    config: MPCConfig,
    dynamics: Dynamics,
    weights: Any,
    target: Float[Array | np.ndarray, "N 2"],
    state: ControllerState,
    keypoints: Float[Array | np.ndarray, "N 2"],
    gripper_pose: Float[Array | np.ndarray, "Q 3"],
) -> tuple[ControllerState, Float[Array, "Q 3"], ControlInfo]:
    """One control step as a pure function: vmap it over `state`, `keypoints`, `gripper_pose` for many cables.

    Args:
        config: settings; static.
        dynamics: the offline model `(weights, history, twist) -> displacement`; static.
        weights: its arrays.
        target: desired keypoints [m], shape [N, 2].
        state: from the last step.
        keypoints: observed now [m]; a keypoint with a NaN counts as not observed, shape [N, 2].
        gripper_pose: measured now; NaN = not measured, shape [Q, 3].

    Returns:
        The state for the next step, the twist to hold until then (finite and within all bounds) and the report.
    """
    state, n_held = _take_in(config, state, jnp.asarray(keypoints), jnp.asarray(gripper_pose))
    residual = _fit_residual(config, state)
    problem = ShapingProblem(
        dynamics=dynamics if residual is None else Corrected(dynamics),
        weights=weights if residual is None else (weights, residual),
        history=state.history,
        target=jnp.asarray(target, state.predicted.dtype),
        feasible=_feasible_set(config, state),
        objective=config.objective,
    )
    error = problem.shape_error(state.history.keypoints[-1])
    rho, radius = _update_radius(config, state, error, problem.shape_error(state.predicted))
    problem = dataclasses.replace(problem, feasible=dataclasses.replace(problem.feasible, radius=radius))
    start = find_starts(config, problem, state.plan)
    plan = plan_or_hold(config, config.solver(problem, start.guess), start)
    plan, state = plan_or_restart(config, state, problem, error, plan, start.straightening)

    twist = config.objective.to_twist(plan.motion[0])
    offline, cable = _displacement(dynamics, weights, state, twist)
    online = jnp.zeros_like(offline) if residual is None else apply(residual, twist)
    newest = state.history.keypoints[-1]
    moved = newest + offline + online
    predicted = jnp.where(jnp.isfinite(moved), moved, newest)
    size_offline, size_online = jnp.linalg.norm(offline), jnp.linalg.norm(online)
    info = ControlInfo(
        shape_error=error,
        predicted_error=problem.shape_error(predicted),
        rho=rho,
        radius=radius,
        objective=plan.value,
        objective_hold=start.value_still,
        evaluations=plan.evaluations,
        outcome=plan.outcome,
        residual_share=jnp.nan_to_num(size_online / jnp.maximum(size_offline + size_online, 1e-12)),
        condition=jnp.ones_like(error) if residual is None else residual.condition,
        held=n_held,
        cable=None if cable is None else cable[0],
    )
    state = dataclasses.replace(
        state,
        plan=plan.motion,
        cable=cable,
        twist=twist,
        model_displacement=offline,
        predicted=predicted,
        shape_error=error,
        radius=radius,
        steps=state.steps + 1,
        held=state.held + n_held,
    )
    return state, twist, info


def _displacement(
    dynamics: Dynamics, weights: Any, state: ControllerState, twist: Float[Array, "Q 3"]
) -> tuple[Float[Array, "N 2"], tuple[CableBelief, Float[Array, "N 2 2"]] | None]:
    """What the offline model expects of a command [m], and how that depends on what is believed of the cable."""
    if state.cable is None:
        return dynamics(weights, state.history, twist), None

    def of_cable(cable: Float[Array, "2"]):
        displacement = dynamics(weights, dataclasses.replace(state.history, cable=cable), twist)
        return displacement, displacement

    belief = state.cable[0]
    sensitivity, displacement = jax.jacfwd(of_cable, has_aux=True)(belief.mean)
    return displacement, (belief, sensitivity)


def _take_in(
    config: MPCConfig, state: ControllerState, keypoints: Float[Array, "N 2"], gripper_pose: Float[Array, "Q 3"]
) -> tuple[ControllerState, Int[Array, ""]]:
    """The state with the observation in its history and window, and how many keypoints had to be filled in.

    What was not observed is taken from the prediction, and its error is not learned from: neither that of the step
    which led here nor that of the next, which starts from a position not seen.
    """
    dtype = state.predicted.dtype
    observed = jnp.isfinite(keypoints).all(axis=-1)
    keypoints = jnp.where(observed[:, None], keypoints, state.predicted).astype(dtype)
    expected_pose = state.history.gripper_pose + config.objective.interval * state.twist
    gripper_pose = jnp.where(jnp.isfinite(gripper_pose), gripper_pose, expected_pose).astype(dtype)

    first = state.steps == 0
    past = state.history.keypoints
    # The first observation is the history's own newest sample, seen again.
    past = jnp.where(first, past, jnp.roll(past, -1, axis=0)).at[-1].set(keypoints)
    delta = keypoints - state.history.keypoints[-1] - state.model_displacement
    valid = observed & state.observed & jnp.isfinite(delta).all(axis=-1) & ~first
    cable, known = state.cable, state.history.cable
    if config.adaptation is not None and cable is not None:
        belief, sensitivity = cable
        belief = update(config.adaptation, belief, sensitivity, delta, valid)
        cable, known = (belief, sensitivity), belief.mean
    state = dataclasses.replace(
        state,
        history=History(keypoints=past, gripper_pose=gripper_pose, cable=known),
        cable=cable,
        delta=_push(state.delta, delta),
        window_twist=_push(state.window_twist, state.twist),
        valid=_push(state.valid, valid),
        observed=observed,
    )
    return state, jnp.sum(~observed, dtype=jnp.int32)


def _fit_residual(config: MPCConfig, state: ControllerState) -> ResidualModel | None:
    if config.residual is None:
        return None
    return fit(state.delta, state.window_twist, state.valid, config.residual)


def _feasible_set(config: MPCConfig, state: ControllerState) -> FeasibleSet:
    limits = config.min_distance * config.cable_length, config.max_distance * config.cable_length
    return feasible_from(
        state.history.gripper_pose,
        state.radius,
        limits,
        workspace=config.workspace,
        change=config.max_change,
        previous=config.objective.to_motion(state.twist),
    )


def _update_radius(
    config: MPCConfig, state: ControllerState, error: Float[Array, ""], predicted_error: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """rho and the new trust-region size (Wang et al., RA-L 2022, algorithm 1).

    A plan may accept a larger error now for a smaller one later. Then `rho = actual / predicted` would be large where
    the plant did worse than predicted, so it is written `1 + (actual - predicted) / |predicted|`: the same for a
    predicted reduction, and still above 1 exactly where the plant did better.
    """
    actual, predicted = state.shape_error - error, state.shape_error - predicted_error
    telling = (state.steps > 0) & (jnp.abs(predicted) >= config.min_reduction)
    rho = jnp.where(telling, 1.0 + (actual - predicted) / jnp.where(telling, jnp.abs(predicted), 1.0), 1.0)
    factor = jnp.where(rho >= config.grow_above, config.grow, jnp.where(rho <= config.shrink_below, config.shrink, 1.0))
    radius = state.radius * jnp.where(telling, factor, 1.0)
    return rho, jnp.clip(radius, config.radius_min, config.radius_max)


def _push(window: Array, newest: Array) -> Array:
    return jnp.concatenate([window, newest[None]])[1:]


_compiled_control = jax.jit(control, static_argnums=(0, 1))


@dataclasses.dataclass(frozen=True, eq=False)
class Controller:
    """Steers a cable towards a target shape: `init` once, then `step` at every control interval.

    Attributes:
        config: see `MPCConfig`.
        dynamics: offline model `(weights, history, twist) -> displacement`, a pure function.
        weights: its arrays; a traced argument of the compiled step, so that new weights do not compile anew.
        target: desired keypoints [m], shape [N, 2].

    Raises:
        ValueError: if the target is not an array of finite keypoints.
    """

    config: MPCConfig
    dynamics: Dynamics
    weights: Any
    target: Float[Array | np.ndarray, "N 2"]

    def __post_init__(self):
        check_target(self.target)

    def init(self, history: History) -> ControllerState:
        """State for a cable seen at rest or in motion.

        Raises:
            ValueError: if the history is not finite or has another number of keypoints than the target.
        """
        check_start(self.target, history)
        return initial_state(self.config, jax.tree.map(jnp.asarray, history))

    def step(
        self,
        state: ControllerState,
        keypoints: Float[Array | np.ndarray, "N 2"],
        gripper_pose: Float[Array | np.ndarray, "Q 3"],
    ) -> tuple[ControllerState, Float[Array, "Q 3"], ControlInfo]:
        """One control step, compiled at its first call: see `control`.

        Raises:
            ValueError: if the observation has another shape than the target's keypoints and two grippers.
        """
        check_observation(self.target, keypoints, gripper_pose)
        return _compiled_control(self.config, self.dynamics, self.weights, self.target, state, keypoints, gripper_pose)

    def vectorised(self):
        """`step` over a leading batch axis of all its arguments, compiled: one controller for many cables."""
        one = functools.partial(control, self.config, self.dynamics)
        return jax.jit(lambda *args: jax.vmap(functools.partial(one, self.weights, self.target))(*args))
