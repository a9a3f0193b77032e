"""Fallbacks where no plan is better than holding still, or nothing gets better: hold, straighten, go back and rest."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from cablejax.bounded.results import Result
from cablejax.mpc.config import MPCConfig
from cablejax.mpc.plan import Plan
from cablejax.mpc.problem import ShapingProblem
from cablejax.mpc.state import Action, Progress
from cablejax.mpc.warm_start import Starts


class Decision(NamedTuple):
    """The decision on a command.

    Attributes:
        plan: to carry out the first command of; its `result` is the solver's.
        action: an `Action`, shape [].
    """

    plan: Plan
    action: Int[Array, ""]


def plan_or_hold(config: MPCConfig, plan: Plan, start: Starts) -> Decision:
    """The solver's plan, or holding still where that is as good or nothing can be trusted."""
    value, hold = plan.value, start.value_still
    improvement = jnp.sqrt(2.0 * hold / config.n_commands) - jnp.sqrt(2.0 * value / config.n_commands)
    finite = jnp.isfinite(value) & jnp.isfinite(plan.motion).all()
    result = jnp.where(finite, plan.result, Result.NONFINITE).astype(jnp.int32)
    worthwhile = _sound(result) & (improvement >= config.hold_improvement)
    plan = dataclasses.replace(
        plan,
        motion=jnp.where(worthwhile, plan.motion, start.still),
        value=jnp.where(worthwhile, value, hold),
        result=result,
    )
    return Decision(plan, jnp.where(worthwhile, Action.FOLLOW, Action.HOLD).astype(jnp.int32))


def plan_or_recover(
    config: MPCConfig,
    progress: Progress,
    problem: ShapingProblem,
    error: Float[Array, ""],
    decision: Decision,
    start: Starts,
) -> tuple[Decision, Progress]:
    """The decision, or the next step of a way to poses that are known to be good; and the progress.

    Where no command has lowered the error for a while, none that the model can find will. There are two cases:

    - Far from the target. A cable has several shapes between the same grippers, and near another one than the target's
      every plan of a few steps makes the error worse before it makes it better. From the straight cable the target can
      be reached, so it is straightened.
    - Near it. Stick and slip are of the size of what the model promises. The grippers go back to where the cable was
      nearest to the target, and rest there until the error rises, as after a disturbance.
    """
    plan, sound = decision.plan, _sound(decision.plan.result)
    held = decision.action == Action.HOLD
    progress = _followed(config, progress, problem.history.gripper_pose, error, start, sound=sound, held=held)
    mode = jnp.where(sound, progress.mode, Action.FOLLOW)
    motion = jnp.select(
        [mode == Action.STRAIGHTEN, mode == Action.RETURN, mode == Action.HOLD],
        [start.straightening.motion, start.back.motion, start.still],
        plan.motion,
    )
    # a rollout that is needed in few calls
    value = jax.lax.cond(mode == Action.FOLLOW, lambda motion: plan.value, problem.value, motion)
    action = jnp.where(mode == Action.FOLLOW, decision.action, mode).astype(jnp.int32)
    return Decision(dataclasses.replace(plan, motion=motion, value=value), action), progress


def _followed(
    config: MPCConfig,
    before: Progress,
    pose: Float[Array, "Q 3"],
    error: Float[Array, ""],
    start: Starts,
    *,
    sound: Bool[Array, ""],
    held: Bool[Array, ""],
) -> Progress:
    """The progress after one more observation; `sound`: the plan may be carried out; `held`: it is to hold."""
    resting = before.mode == Action.HOLD
    woken = resting & (error > before.rest_error + config.wake)
    planning = (before.mode == Action.FOLLOW) | woken
    best = jnp.where(woken, jnp.inf, before.best_error)
    better = planning & (error < 0.99 * best)
    since = jnp.where(planning & ~better & ~woken, before.since_best + 1, 0)

    far = error > config.restart_above
    tired = planning & sound & ((far & held) | (since >= jnp.where(far, config.restart_after, config.settle_after)))
    far_to_go = start.straightening.length > config.radius_max
    straighten = tired & far & far_to_go & (before.restarts < config.max_restarts)
    straightening = straighten | (before.mode == Action.STRAIGHTEN)
    returning = (tired & ~far) | (before.mode == Action.RETURN)
    length = jnp.where(straightening, start.straightening.length, start.back.length)
    # half as many steps again as the way is long: the bounds on the grippers' distance may lead it round
    needed = jnp.ceil(1.5 * length / config.radius_max).astype(jnp.int32)
    left = jnp.where(tired, needed, before.way_left - 1)
    # from within a step of straight the planner goes on by itself
    on_way = (left > 0) & (length > jnp.where(straightening, config.radius_max, config.arrived))
    mode = jnp.where(straightening & on_way, Action.STRAIGHTEN, Action.FOLLOW)
    mode = jnp.where(returning, jnp.where(on_way, Action.RETURN, Action.HOLD), mode)
    mode = jnp.where(resting & ~woken, Action.HOLD, mode)
    return Progress(
        best_error=jnp.where(straightening, jnp.inf, jnp.where(better, error, best)).astype(error.dtype),
        best_pose=jnp.where(better, pose, before.best_pose),
        since_best=jnp.where(straightening, 0, since),
        mode=mode.astype(jnp.int32),
        way_left=left,
        restarts=before.restarts + straighten,
        rest_error=jnp.where(resting & ~woken, before.rest_error, error),
    )


def _sound(result: Int[Array, ""]) -> Bool[Array, ""]:
    """Whether a plan of this result may be carried out."""
    return (result != Result.NONFINITE) & (result != Result.EMPTY_SET)
