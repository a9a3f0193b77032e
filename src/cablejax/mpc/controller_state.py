"""What the controller remembers from one step to the next, and what it reports of each."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from cablejax.adaptation.belief import CableBelief, prior_belief
from cablejax.mpc.config import MPCConfig
from cablejax.types import History


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
        best_error: lowest shape error since the last restart [m], shape [].
        since_best: commands since it fell by a hundredth or more, shape [].
        restarting: commands left for straightening the cable, shape []; 0 = planning.
        restarts: how often that was begun, shape [].
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
    best_error: Float[Array, "*batch"]
    since_best: Int[Array, "*batch"]
    restarting: Int[Array, "*batch"]
    restarts: Int[Array, "*batch"]
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
        evaluations: rollouts that the solver spent on trial plans.
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
        best_error=jnp.asarray(jnp.inf, dtype),
        since_best=jnp.zeros((), jnp.int32),
        restarting=jnp.zeros((), jnp.int32),
        restarts=jnp.zeros((), jnp.int32),
        cable=cable,
        steps=jnp.zeros((), jnp.int32),
        held=jnp.zeros((), jnp.int32),
    )
