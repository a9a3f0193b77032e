"""Model predictive control of a cable's shape: observe, correct the model, plan, command; one compiled call."""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from cablejax.adaptation.belief import update
from cablejax.limits import LIMITS
from cablejax.mpc.config import MPCConfig
from cablejax.mpc.fallback import plan_or_hold, plan_or_recover, radius_after
from cablejax.mpc.feasible import FeasibleSet, feasible_from
from cablejax.mpc.problem import ShapingProblem
from cablejax.mpc.state import CableEstimate, LastCommand, MPCInfo, MPCState, initial_state
from cablejax.mpc.validation import (
    check_dynamics,
    check_history,
    check_measurement,
    check_reach,
    check_target,
)
from cablejax.mpc.warm_start import find_starts
from cablejax.residual.jacobian import Corrected, Dynamics, linearised
from cablejax.residual.learner import Sample, learned, observe
from cablejax.residual.learner import weights as weights_of
from cablejax.residual.ridge import ResidualModel, apply
from cablejax.types import History, Measurement


class MPC(eqx.Module):
    """Controller that plans with a learned model: `init` once, then `step` at every control interval.

    Both are pure and may be called inside compiled code. The object is a pytree: vmap over the states for many cables,
    over `target` or `weights` as well for one controller each.

    Attributes:
        config: see `MPCConfig`; static.
        dynamics: offline model `(weights, history, twist) -> displacement`, a pure function; static.
        weights: its arrays; traced, so that new weights do not compile again.
        target: desired keypoints [m], shape [N, 2]; likewise. A state is of one target: call `init` for another.

    Raises:
        ValueError: if the target is not an array of finite keypoints.
    """

    config: MPCConfig = eqx.field(static=True)
    dynamics: Dynamics = eqx.field(static=True)
    weights: Any
    target: Float[Array | np.ndarray, "*batch N 2"]

    def __check_init__(self):
        check_target(self.target)

    @property
    def interval(self) -> float:
        """Time between two steps [s]."""
        return self.config.objective.interval

    @property
    def history_length(self) -> int:
        """Samples of a history."""
        return self.config.history_length

    def init(self, history: History) -> MPCState:
        """State for a cable seen at rest or in motion.

        Raises:
            ValueError: if the history is empty, not finite or not of floating-point numbers, has another number of
                keypoints than the target, or grippers out of the cable's reach; or if the model does not take it.
        """
        check_history(self.target, history)
        check_reach(self.config.cable_length, history)
        state = initial_state(self.config, jax.tree.map(jnp.asarray, history))
        # with what the controller adds to the history for a conditioned model
        check_dynamics(self.dynamics, self.weights, state.history)
        return state

    def step(self, state: MPCState, measurement: Measurement) -> tuple[MPCState, Float[Array, "Q 3"], MPCInfo]:
        """One control step, compiled at its first call.

        Args:
            state: from the last step.
            measurement: keypoints and gripper poses now; a keypoint with a NaN counts as not observed, a pose that is
                NaN as not measured. With another twist than the last command, the model is judged by that twist; its
                entries that are NaN are the command's.

        Returns:
            The state for the next step, the twist to hold until then (finite and within all bounds) and the report.

        Raises:
            ValueError: if the measurement has another shape than the target's keypoints and two grippers.
        """
        check_measurement(self.target, measurement)
        return _step(self, state, measurement)


@jax.jit
def _step(mpc: MPC, state: MPCState, measurement: Measurement) -> tuple[MPCState, Float[Array, "Q 3"], MPCInfo]:
    """See `MPC.step`."""
    config, dynamics, weights = mpc.config, mpc.dynamics, mpc.weights
    if measurement.twist is not None:
        executed = jnp.asarray(measurement.twist, state.last.twist.dtype)
        state = _commanded(mpc, state, jnp.where(jnp.isfinite(executed), executed, state.last.twist))
    state, unobserved = _observe(config, state, measurement)
    model, residual = state.last.model, None
    if config.residual is not None and state.learner is not None:
        model = linearised(dynamics, weights, state.history, with_gain=config.residual.needs_gain)
        residual = learned(config.residual, state.learner, model)
    problem = ShapingProblem(
        dynamics=dynamics if residual is None else Corrected(dynamics),
        weights=weights if residual is None else (weights, residual),
        history=state.history,
        target=jnp.asarray(mpc.target, state.last.predicted.dtype),
        feasible=_feasible_set(config, state),
        objective=config.objective,
    )
    error = problem.shape_error(state.history.keypoints[-1])
    # what is not observed is as predicted, which says nothing of the model
    seen = 2 * state.observed.sum() >= len(state.observed)
    rho, radius = _update_radius(config, state, error, problem.shape_error(state.last.predicted), seen)
    problem = dataclasses.replace(problem, feasible=dataclasses.replace(problem.feasible, radius=radius))
    start = find_starts(config, problem, state.last.plan, state.progress.best_pose)
    decision = plan_or_hold(config, config.solver(problem, start.guess), start)
    decision, progress = plan_or_recover(config, state.progress, problem, error, decision, start, seen)
    next_radius = radius_after(config, state.progress, progress, radius)
    plan = decision.plan

    twist = config.objective.to_twist(plan.motion[0])
    offline, online, predicted, estimate = _prediction(mpc, state, residual, twist)
    size_offline, size_online = jnp.linalg.norm(offline), jnp.linalg.norm(online)
    info = MPCInfo(
        shape_error=error,
        rho=rho,
        radius=radius,
        objective=plan.value,
        evaluations=plan.evaluations,
        result=plan.result,
        action=decision.action,
        residual_share=jnp.nan_to_num(size_online / jnp.maximum(size_offline + size_online, 1e-12)),
        unobserved=unobserved,
        weights=_beliefs(config, state),
        belief=None if estimate is None else estimate.belief,
    )
    state = dataclasses.replace(
        state,
        last=LastCommand(plan.motion, twist, offline, model, predicted, error),
        progress=progress,
        estimate=estimate,
        radius=next_radius,
        steps=state.steps + 1,
        unobserved=state.unobserved + unobserved,
    )
    return state, twist, info


def _commanded(mpc: MPC, state: MPCState, twist: Float[Array, "Q 3"]) -> MPCState:
    """The state as if this had been the last command: its prediction is then that of what was executed."""
    config, last, residual = mpc.config, state.last, None
    if config.residual is not None and state.learner is not None:
        residual = learned(config.residual, state.learner, last.model)
    offline, _, predicted, estimate = _prediction(mpc, state, residual, twist)
    changed = last._replace(twist=twist, displacement=offline, predicted=predicted)
    changed = dataclasses.replace(state, last=changed, estimate=estimate)
    # before the first step there was no command
    return jax.tree.map(lambda new, old: jnp.where(state.steps > 0, new, old), changed, state)


def _prediction(
    mpc: MPC, state: MPCState, residual: ResidualModel | None, twist: Float[Array, "Q 3"]
) -> tuple[Float[Array, "N 2"], Float[Array, "N 2"], Float[Array, "N 2"], CableEstimate | None]:
    """Displacements [m] of the offline model and of the residual, keypoints after both, and see `_displacement`."""
    offline, estimate = _displacement(mpc.dynamics, mpc.weights, state, twist)
    online = jnp.zeros_like(offline) if residual is None else apply(residual, twist)
    newest = state.history.keypoints[-1]
    moved = newest + offline + online
    return offline, online, jnp.where(jnp.isfinite(moved), moved, newest), estimate


def _beliefs(config: MPCConfig, state: MPCState) -> Float[Array, " K"] | None:
    """How far each of the learner's candidates is believed; None without a learner."""
    if config.residual is None or state.learner is None:
        return None
    return weights_of(config.residual, state.learner)


def _displacement(
    dynamics: Dynamics, weights: Any, state: MPCState, twist: Float[Array, "Q 3"]
) -> tuple[Float[Array, "N 2"], CableEstimate | None]:
    """The offline model's displacement under a command [m], and the estimate with its derivative by the cable."""
    if state.estimate is None:
        return dynamics(weights, state.history, twist), None

    def of_cable(cable: Float[Array, "2"]):
        displacement = dynamics(weights, dataclasses.replace(state.history, cable=cable), twist)
        return displacement, displacement

    belief = state.estimate.belief
    sensitivity, displacement = jax.jacfwd(of_cable, has_aux=True)(belief.mean)
    return displacement, CableEstimate(belief, sensitivity)


def _observe(config: MPCConfig, state: MPCState, measurement: Measurement) -> tuple[MPCState, Int[Array, ""]]:
    """The state with the measurement in its history and window, and how many keypoints had to be filled in.

    What was not observed is taken from the prediction, and its error is not learned from: neither that of the step
    which led here nor that of the next, which starts from a position not seen.
    """
    keypoints, gripper_pose = jnp.asarray(measurement.keypoints), jnp.asarray(measurement.gripper_pose)
    last, dtype = state.last, state.last.predicted.dtype
    largest = LIMITS["coordinate"].high
    observed = (jnp.abs(keypoints) <= largest).all(axis=-1)
    keypoints = jnp.where(observed[:, None], keypoints, last.predicted).astype(dtype)
    expected_pose = state.history.gripper_pose + config.objective.interval * last.twist
    gripper_pose = jnp.where(jnp.abs(gripper_pose) <= largest, gripper_pose, expected_pose).astype(dtype)

    first = state.steps == 0
    past = state.history.keypoints
    # The first observation is the history's own newest sample, seen again.
    past = jnp.where(first, past, jnp.roll(past, -1, axis=0)).at[-1].set(keypoints)
    error = keypoints - state.history.keypoints[-1] - last.displacement
    valid = observed & state.observed & jnp.isfinite(error).all(axis=-1) & ~first
    learner = state.learner
    if config.residual is not None and learner is not None:
        learner = observe(config.residual, learner, Sample(error, last.twist, valid, last.model))
    estimate, cable = state.estimate, state.history.cable
    if config.adaptation is not None and estimate is not None:
        belief = update(config.adaptation, estimate.belief, estimate.sensitivity, error, valid)
        estimate, cable = estimate._replace(belief=belief), belief.mean
    state = dataclasses.replace(
        state,
        history=History(keypoints=past, gripper_pose=gripper_pose, cable=cable),
        observed=observed,
        learner=learner,
        estimate=estimate,
    )
    return state, jnp.sum(~observed, dtype=jnp.int32)


def _feasible_set(config: MPCConfig, state: MPCState) -> FeasibleSet:
    limits = config.min_distance * config.cable_length, config.max_distance * config.cable_length
    return feasible_from(
        state.history.gripper_pose,
        state.radius,
        limits,
        workspace=config.workspace,
        change=config.max_change,
        previous=config.objective.to_motion(state.last.twist),
    )


def _update_radius(
    config: MPCConfig,
    state: MPCState,
    error: Float[Array, ""],
    predicted_error: Float[Array, ""],
    seen: Bool[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Rho and the new bound on a step's motion, adapted as a trust region (Wang et al., RA-L 2022, algorithm 1).

    A plan may accept a larger error now for a smaller one later. Then `rho = actual / predicted` would be large where
    the plant did worse than predicted, so it is written `1 + (actual - predicted) / |predicted|`: the same for a
    predicted reduction, and still above 1 exactly where the plant did better.
    """
    before = state.last.shape_error
    actual, predicted = before - error, before - predicted_error
    telling = (state.steps > 0) & seen & (jnp.abs(predicted) >= config.min_reduction)
    rho = jnp.where(telling, 1.0 + (actual - predicted) / jnp.where(telling, jnp.abs(predicted), 1.0), 1.0)
    factor = jnp.where(rho >= config.grow_above, config.grow, jnp.where(rho <= config.shrink_below, config.shrink, 1.0))
    radius = state.radius * jnp.where(telling, factor, 1.0)
    return rho, jnp.clip(radius, config.radius_min, config.radius_max)
