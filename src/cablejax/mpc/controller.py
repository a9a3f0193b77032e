"""The receding-horizon controller: observe, correct the model, plan, command; all of it one compiled call."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from cablejax.adaptation.belief import AdaptationConfig, CableBelief, prior_belief, update
from cablejax.mpc.edge import check_observation, check_start, check_target
from cablejax.mpc.feasible import FeasibleSet, feasible_from
from cablejax.mpc.goal import continued, goal_pose, straight_plan, way_to
from cablejax.mpc.plan import Outcome, Plan, Solver
from cablejax.mpc.problem import ObjectiveConfig, ShapingProblem
from cablejax.mpc.trust_region import TrustRegion
from cablejax.residual.corrected import Dynamics, corrected
from cablejax.residual.ridge import ResidualModel, RidgeConfig, apply, fit
from cablejax.types import History


@dataclasses.dataclass(frozen=True)
class MPCConfig:
    """Settings of the controller. The defaults are those of Wang et al., RA-L 2022, where it gives them.

    Attributes:
        horizon: h; a plan has h + 1 commands.
        cable_length: free length of the cable L [m].
        min_distance: least distance of the grippers, relative to L.
        max_distance: greatest distance of the grippers, relative to L: a taut cable cannot be shaped.
        workspace: lowest and highest corner (x, y) of where the grippers may be [m]; None = anywhere.
        max_change: greatest norm of the change of a gripper's motion from one step to the next [m]: it bounds the
            acceleration. Then holding means to brake, which may take steps. None = any.
        radius: initial trust-region size epsilon, the bound on one step's motion of each gripper [m].
        radius_min: it does not shrink below this [m].
        radius_max: nor grow above this [m]: the model has not been trained on faster motions.
        grow_above: eta+; the radius grows if actual over predicted error reduction is at least this.
        shrink_below: eta-; it shrinks if the ratio is at most this.
        grow: tau+.
        shrink: tau-.
        min_reduction: predicted changes of the error below this say nothing about the model: the radius stays [m].
        hold_improvement: the grippers hold still if the plan lowers the error over the horizon, as a root mean square
            distance, by less than this compared with holding still [m].
        travel_beyond: where no plan is better than holding, and the way to where the target's ends are held is longer
            than this [m], the grippers travel there by the straight way: the plans are in a valley of the objective.
        max_travels: how often that may happen; a valley that is fallen into again and again is the model's.
        objective: weights and units of the planning problem.
        residual: settings of the online residual; None = trust the offline model.
        adaptation: settings of the online estimate of the cable, for a conditioned model; None = no estimate.
        solver: any `Solver`.
    """

    horizon: int = 5
    cable_length: float = 1.0
    min_distance: float = 0.15
    max_distance: float = 0.99
    workspace: tuple[tuple[float, float], tuple[float, float]] | None = None
    max_change: float | None = None
    radius: float = 0.05
    radius_min: float = 0.002
    radius_max: float = 0.05
    grow_above: float = 0.8
    shrink_below: float = 0.4
    grow: float = 1.05
    shrink: float = 0.95
    min_reduction: float = 1e-4
    hold_improvement: float = 2e-5
    travel_beyond: float = 0.08
    max_travels: int = 3
    objective: ObjectiveConfig = ObjectiveConfig()
    residual: RidgeConfig | None = RidgeConfig(forgetting=0.5, outlier=0.02)
    adaptation: AdaptationConfig | None = None
    solver: Solver = TrustRegion()

    def __post_init__(self):
        if self.horizon < 0:
            raise ValueError(f"MPCConfig.horizon is {self.horizon}, expected at least 0 (plan one command).")
        if not (math.isfinite(self.cable_length) and self.cable_length > 0):
            raise ValueError(f"MPCConfig.cable_length is {self.cable_length}, expected a positive length [m].")
        if not 0 <= self.min_distance < self.max_distance <= 1:
            raise ValueError(
                f"MPCConfig distances {self.min_distance} to {self.max_distance}: expected 0 <= min_distance < "
                "max_distance <= 1, relative to the cable's length."
            )
        if self.workspace is not None:
            corners = np.asarray(self.workspace, float)
            if corners.shape != (2, 2) or not (corners[0] < corners[1]).all():
                raise ValueError(
                    f"MPCConfig.workspace is {self.workspace}, expected ((x, y) of the lowest, (x, y) of the highest "
                    "corner) [m]."
                )
        if self.max_change is not None and not self.max_change > 0:
            raise ValueError(f"MPCConfig.max_change is {self.max_change}, expected a positive length [m] or None.")
        if not 0 < self.radius_min <= self.radius <= self.radius_max:
            raise ValueError(
                f"MPCConfig radii {self.radius_min}, {self.radius}, {self.radius_max}: expected "
                "0 < radius_min <= radius <= radius_max."
            )
        if not (self.shrink_below < self.grow_above and 0 < self.shrink <= 1 <= self.grow):
            raise ValueError(
                f"MPCConfig trust region: thresholds {self.shrink_below}, {self.grow_above} must increase, and factors "
                f"{self.shrink}, {self.grow} lie on either side of 1."
            )
        if not (self.travel_beyond > 0 and self.max_travels >= 0):
            raise ValueError("MPCConfig.travel_beyond must be positive [m] and max_travels not negative.")
        if not (self.min_reduction > 0 and self.hold_improvement >= 0):
            raise ValueError("MPCConfig.min_reduction must be positive and hold_improvement not negative [m].")

    @property
    def n_commands(self) -> int:
        """Commands of a plan, T = h + 1."""
        return self.horizon + 1


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ControllerState:
    """What the controller remembers from one step to the next.

    Attributes:
        history: observations that the model sees, gaps filled.
        delta: errors of the offline model's last W displacements, oldest first [m], shape [W, N, 2].
        window_twist: commands of these steps, shape [W, Q, 3].
        valid: which of them were observed, shape [W, N].
        plan: the last plan, its first command executed [m], shape [T, Q, 3].
        twist: the last command, shape [Q, 3].
        model_displacement: what the offline model expected of it [m], shape [N, 2].
        predicted: keypoints that model and residual expect now [m], shape [N, 2].
        observed: keypoints seen at the last step, shape [N].
        shape_error: root mean square distance to the target at the last step [m], shape [].
        radius: trust-region size epsilon [m], shape [].
        travel: commands left of a way to the target's ends, shape []; 0 = planning.
        travels: how many such ways were begun, shape [].
        cable: what is believed of the cable, and the derivative of `model_displacement` by it [m], shape [N, 2, 2];
            None without adaptation.
        steps: control steps so far, shape [].
        held: keypoint observations missing so far, shape [].
    """

    history: History
    delta: Float[Array, "*batch W N 2"]
    window_twist: Float[Array, "*batch W Q 3"]
    valid: Bool[Array, "*batch W N"]
    plan: Float[Array, "*batch T Q 3"]
    twist: Float[Array, "*batch Q 3"]
    model_displacement: Float[Array, "*batch N 2"]
    predicted: Float[Array, "*batch N 2"]
    observed: Bool[Array, "*batch N"]
    shape_error: Float[Array, "*batch"]
    radius: Float[Array, "*batch"]
    travel: Int[Array, "*batch"]
    travels: Int[Array, "*batch"]
    cable: tuple[CableBelief, Float[Array, "*batch N 2 2"]] | None
    steps: Int[Array, "*batch"]
    held: Int[Array, "*batch"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ControlInfo:
    """What one control step reports; every field has shape [].

    Attributes:
        shape_error: root mean square distance to the target now [m].
        predicted_error: the same, expected after the command [m].
        rho: actual over predicted reduction of the error by the last command; 1 where it cannot be told.
        radius: trust-region size that the command was planned with [m].
        objective: value of the plan [m^2].
        objective_hold: value of holding still [m^2].
        evaluations: iterations of the solver.
        outcome: an `Outcome`.
        residual_share: |residual's displacement| / (|model's| + |residual's|) of the command, in [0, 1].
        condition: condition number of the ridge system.
        held: keypoints not observed now, replaced by their prediction.
        cable: what is believed of the cable now, None without adaptation.
    """

    shape_error: Float[Array, "*batch"]
    predicted_error: Float[Array, "*batch"]
    rho: Float[Array, "*batch"]
    radius: Float[Array, "*batch"]
    objective: Float[Array, "*batch"]
    objective_hold: Float[Array, "*batch"]
    evaluations: Int[Array, "*batch"]
    outcome: Int[Array, "*batch"]
    residual_share: Float[Array, "*batch"]
    condition: Float[Array, "*batch"]
    held: Int[Array, "*batch"]
    cable: CableBelief | None


def initial_state(config: MPCConfig, history: History) -> ControllerState:
    """The controller's state before its first step; pure, vmappable."""
    n_keypoints, n_grippers = history.keypoints.shape[1], history.gripper_pose.shape[0]
    window = 0 if config.residual is None else config.residual.window
    dtype = history.keypoints.dtype
    cable = None
    if config.adaptation is not None:
        cable = prior_belief(config.adaptation), jnp.zeros((n_keypoints, 2, 2), dtype)
        history = dataclasses.replace(history, cable=cable[0].mean)
    return ControllerState(
        history=history,
        delta=jnp.zeros((window, n_keypoints, 2), dtype),
        window_twist=jnp.zeros((window, n_grippers, 3), dtype),
        valid=jnp.zeros((window, n_keypoints), bool),
        plan=jnp.zeros((config.n_commands, n_grippers, 3), dtype),
        twist=jnp.zeros((n_grippers, 3), dtype),
        model_displacement=jnp.zeros((n_keypoints, 2), dtype),
        predicted=history.keypoints[-1],
        observed=jnp.ones(n_keypoints, bool),
        shape_error=jnp.zeros((), dtype),
        radius=jnp.asarray(config.radius, dtype),
        travel=jnp.zeros((), jnp.int32),
        travels=jnp.zeros((), jnp.int32),
        cable=cable,
        steps=jnp.zeros((), jnp.int32),
        held=jnp.zeros((), jnp.int32),
    )


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
        dynamics=dynamics if residual is None else corrected(dynamics),
        weights=weights if residual is None else (weights, residual),
        history=state.history,
        target=jnp.asarray(target),
        feasible=_feasible_set(config, state),
        objective=config.objective,
    )
    error = problem.shape_error(state.history.keypoints[-1])
    rho, radius = _update_radius(config, state, error, problem.shape_error(state.predicted))
    problem = dataclasses.replace(problem, feasible=dataclasses.replace(problem.feasible, radius=radius))
    way = _straight_way(config, problem)
    start = _starts(config, problem, state.plan, way)
    plan = _plan_or_hold(config, config.solver(problem, start.guess), start)
    plan, travel = _plan_or_travel(config, state, way, radius, plan, start.value_way)

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
        travel=travel,
        travels=state.travels + ((travel > 0) & (state.travel == 0)),
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


def _plan_or_hold(config: MPCConfig, plan: Plan, start: _Starts) -> Plan:
    """The solver's plan, or holding still where that is as good or nothing can be trusted."""
    value, hold = plan.value, start.value_still
    improvement = jnp.sqrt(2.0 * hold / config.n_commands) - jnp.sqrt(2.0 * value / config.n_commands)
    finite = jnp.isfinite(value) & jnp.isfinite(plan.motion).all()
    sound = finite & (plan.outcome != Outcome.NONFINITE) & (plan.outcome != Outcome.INFEASIBLE)
    worthwhile = sound & (improvement >= config.hold_improvement)
    outcome = jnp.where(finite, jnp.where(sound, Outcome.HELD, plan.outcome), Outcome.NONFINITE)
    outcome = jnp.where(worthwhile, plan.outcome, outcome)
    return dataclasses.replace(
        plan,
        motion=jnp.where(worthwhile, plan.motion, start.still),
        value=jnp.where(worthwhile, value, hold),
        outcome=outcome.astype(jnp.int32),
    )


def _plan_or_travel(
    config: MPCConfig,
    state: ControllerState,
    way: _StraightWay,
    radius: Float[Array, ""],
    plan: Plan,
    value_way: Float[Array, ""],
) -> tuple[Plan, Int[Array, ""]]:
    """The plan, or the next step of a straight way out of a valley; and how many steps of the way are left."""
    stuck = (plan.outcome == Outcome.HELD) & (way.length > config.travel_beyond) & (state.travels < config.max_travels)
    # half as many steps again as the way is long: the bounds on the grippers' distance may lead it round
    needed = jnp.ceil(1.5 * way.length / radius).astype(jnp.int32)
    left = jnp.where(state.travel > 0, state.travel - 1, jnp.where(stuck, needed, 0))
    left = jnp.where((way.length > radius) & (plan.outcome != Outcome.NONFINITE), left, 0)
    travelling = left > 0
    outcome = jnp.where(travelling, Outcome.TRAVELLING, plan.outcome).astype(jnp.int32)
    motion, value = jnp.where(travelling, way.motion, plan.motion), jnp.where(travelling, value_way, plan.value)
    return dataclasses.replace(plan, motion=motion, value=value, outcome=outcome), left


class _StraightWay(NamedTuple):
    """The straight way to where the target's ends are held.

    Attributes:
        motion: its first steps, feasible [m], shape [T, Q, 3].
        length: of the gripper that has farther to go, all the way [m], shape [].
    """

    motion: Float[Array, "T Q 3"]
    length: Float[Array, ""]


def _straight_way(config: MPCConfig, problem: ShapingProblem) -> _StraightWay:
    pose, goal = continued(problem.history.gripper_pose, problem.history.keypoints[-1]), goal_pose(problem.target)
    weight = config.objective.rotation_weight
    motion = straight_plan(pose, goal, problem.feasible.radius, weight, config.n_commands)
    length = jnp.linalg.norm(way_to(pose, goal, weight), axis=1).max()
    return _StraightWay(problem.feasible.project(motion), length)


class _Starts(NamedTuple):
    """What is known before a solver is asked.

    Attributes:
        guess: the better of two starts: the last plan, shifted by the command that was executed, and the straight way
            [m], shape [T, Q, 3].
        value_way: objective of the straight way [m^2], shape [].
        still: holding, or where motions may not change at once, braking [m], shape [T, Q, 3].
        value_still: its objective [m^2], shape [].
    """

    guess: Float[Array, "T Q 3"]
    value_way: Float[Array, ""]
    still: Float[Array, "T Q 3"]
    value_still: Float[Array, ""]


def _starts(config: MPCConfig, problem: ShapingProblem, last: Float[Array, "T Q 3"], way: _StraightWay) -> _Starts:
    still = jnp.zeros_like(last)
    if config.max_change is not None:
        # grippers that move brake first, as fast as they may
        still = problem.feasible.project(still)
    shifted = jnp.roll(last, -1, axis=0).at[-1].set(0.0)
    motions = jnp.stack([problem.feasible.project(shifted), way.motion, still])
    values = jax.vmap(problem.value)(motions)
    guesses = jnp.where(jnp.isfinite(values[:2]), values[:2], jnp.inf)
    return _Starts(motions[jnp.argmin(guesses)], values[1], still, values[2])


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
