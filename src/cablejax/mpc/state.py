"""State of the controller between steps, and its report of each step."""

from __future__ import annotations

import dataclasses
import enum
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from cablejax.adaptation.belief import CableBelief, prior_belief
from cablejax.mpc.config import MPCConfig
from cablejax.residual.jacobian import Linearised
from cablejax.residual.learner import LearnerState, initial_learner
from cablejax.types import History


class Action(enum.IntEnum):
    """Kind of a command. Inside compiled code it is an int32."""

    FOLLOW = 0
    """It is the first one of the solver's plan."""
    HOLD = 1
    """No plan is better, or none can be trusted (see the result): the grippers hold, brake as fast as they may, or come
    back from outside of their bounds."""
    STRAIGHTEN = 2
    """The error stayed where it is, as in another shape between the same grippers: the cable is straightened first."""
    RETURN = 3
    """The error has risen near the target: the grippers go back to where it was lowest."""


class LastCommand(NamedTuple):
    """The last command and its predicted effect; replaced at the end of every step.

    Attributes:
        plan: the plan whose first command it is [m], shape [T, Q, 3].
        twist: the command, shape [Q, 3].
        displacement: the offline model's, of this command [m], shape [N, 2].
        model: the offline model about no command, when it was given; zero without a learner.
        predicted: keypoints that model and residual expect after it [m], shape [N, 2].
        shape_error: root mean square distance to the target before it [m], shape [].
    """

    plan: Float[Array, "*batch T Q 3"]
    twist: Float[Array, "*batch Q 3"]
    displacement: Float[Array, "*batch N 2"]
    model: Linearised
    predicted: Float[Array, "*batch N 2"]
    shape_error: Float[Array, "*batch"]


class Progress(NamedTuple):
    """Progress of a run, to decide when to straighten, go back or rest; every field but `best_pose` has shape [].

    Attributes:
        best_error: lowest shape error since the last restart or rest [m].
        best_pose: gripper poses at which it was seen, shape [Q, 3].
        since: commands since it fell by a hundredth or more, or since the rest began.
        mode: an `Action`: plans are followed, the cable is straightened, the grippers go back, or rest (`HOLD`).
        way_left: commands left for the way there or back.
        restarts: how often straightening was begun.
        returns: how often the grippers went back since the last restart or rest.
        rest_error: shape error at which the cable came to rest [m].
    """

    best_error: Float[Array, "*batch"]
    best_pose: Float[Array, "*batch Q 3"]
    since: Int[Array, "*batch"]
    mode: Int[Array, "*batch"]
    way_left: Int[Array, "*batch"]
    restarts: Int[Array, "*batch"]
    returns: Int[Array, "*batch"]
    rest_error: Float[Array, "*batch"]


class CableEstimate(NamedTuple):
    """The online estimate of the cable.

    Attributes:
        belief: after the observations so far.
        sensitivity: derivative of `LastCommand.displacement` with respect to its mean [m], shape [N, 2, 2].
    """

    belief: CableBelief
    sensitivity: Float[Array, "*batch N 2 2"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class MPCState:
    """State of the controller between two steps, its arrays grouped by when they change.

    Attributes:
        history: what the model sees; gaps are filled.
        observed: keypoints that were observed at the last step, shape [N].
        learner: what is learned from the offline model's errors; None without.
        last: the last command.
        progress: counts for restarts.
        estimate: the cable; None without adaptation.
        radius: bound on one step's motion of each gripper [m], shape [].
        steps: control steps so far, shape [].
        unobserved: keypoint observations missing so far, shape [].
    """

    history: History
    observed: Bool[Array, "*batch N"]
    learner: LearnerState | None
    last: LastCommand
    progress: Progress
    estimate: CableEstimate | None
    radius: Float[Array, "*batch"]
    steps: Int[Array, "*batch"]
    unobserved: Int[Array, "*batch"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class MPCInfo:
    """Report of one control step; every field but the last two has shape [].

    Attributes:
        shape_error: root mean square distance to the target now [m].
        rho: actual over predicted reduction of the error by the last command; 1 where it is not known, as where more
            than half of the keypoints were not observed.
        radius: bound on one step's motion of the plan [m]. Ways back and to the straight cable have `radius_max`.
        objective: value of the plan, or of rest where the plan promised no more, also where the command goes back or
            straightens the cable instead [m^2].
        evaluations: rollouts that the solver spent on trial plans.
        result: a `bounded.Result`: how the solve ended; `NONFINITE` also where its plan is not finite.
        action: an `Action`.
        residual_share: |residual's displacement| / (|model's| + |residual's|) of the command, in [0, 1].
        unobserved: keypoints not observed now, replaced by their prediction.
        weights: weight of each of the learner's candidates, shape [K]; None without a learner.
        belief: current estimate of the cable; None without adaptation.
    """

    shape_error: Float[Array, "*batch"]
    rho: Float[Array, "*batch"]
    radius: Float[Array, "*batch"]
    objective: Float[Array, "*batch"]
    evaluations: Int[Array, "*batch"]
    result: Int[Array, "*batch"]
    action: Int[Array, "*batch"]
    residual_share: Float[Array, "*batch"]
    unobserved: Int[Array, "*batch"]
    weights: Float[Array, "*batch K"] | None
    belief: CableBelief | None


def initial_state(config: MPCConfig, history: History) -> MPCState:
    """The controller's state before its first step; pure, vmappable."""
    n_keypoints, n_grippers = history.keypoints.shape[1], history.gripper_pose.shape[0]
    dtype, zero = history.keypoints.dtype, jnp.zeros((), jnp.int32)
    estimate = None
    if config.adaptation is not None:
        estimate = CableEstimate(prior_belief(config.adaptation, dtype), jnp.zeros((n_keypoints, 2, 2), dtype))
        history = dataclasses.replace(history, cable=estimate.belief.mean)
    return MPCState(
        history=history,
        observed=jnp.ones(n_keypoints, bool),
        learner=config.residual and initial_learner(config.residual, n_keypoints, n_grippers, dtype),
        last=LastCommand(
            plan=jnp.zeros((config.n_commands, n_grippers, 3), dtype),
            twist=jnp.zeros((n_grippers, 3), dtype),
            displacement=jnp.zeros((n_keypoints, 2), dtype),
            model=Linearised(jnp.zeros((n_keypoints, 2), dtype), jnp.zeros((n_keypoints, 2, n_grippers, 3), dtype)),
            predicted=history.keypoints[-1],
            shape_error=jnp.zeros((), dtype),
        ),
        progress=Progress(
            best_error=jnp.asarray(jnp.inf, dtype),
            best_pose=jnp.asarray(history.gripper_pose, dtype),
            since=zero,
            mode=zero,
            way_left=zero,
            restarts=zero,
            returns=zero,
            rest_error=jnp.zeros((), dtype),
        ),
        estimate=estimate,
        radius=jnp.asarray(config.radius, dtype),
        steps=zero,
        unobserved=zero,
    )
