"""Fallbacks where a plan is no better than holding still, or stays in another shape: hold, or straighten."""

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
from cablejax.mpc.warm_start import Starts, StraightWay


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


def plan_or_restart(
    config: MPCConfig,
    progress: Progress,
    problem: ShapingProblem,
    error: Float[Array, ""],
    decision: Decision,
    straight: StraightWay,
) -> tuple[Decision, Progress]:
    """The decision, or the next step of straightening the cable; and the progress with what is counted for that.

    A cable has several shapes between the same grippers, and near another one than the target's every plan of a few
    steps makes the error worse before it makes it better. From the straight cable the target can be reached.
    """
    plan, radius, sound = decision.plan, problem.feasible.radius, _sound(decision.plan.result)
    better = error < 0.99 * progress.best_error
    since = jnp.where(better, 0, progress.since_best + 1)
    staying = (sound & (decision.action == Action.HOLD)) | (since >= config.restart_after)
    stuck = staying & (error > config.restart_above) & (progress.restarts < config.max_restarts)
    # half as many steps again as the way is long: the bounds on the grippers' distance may lead it round
    needed = jnp.ceil(1.5 * straight.length / radius).astype(jnp.int32)
    left = jnp.where(progress.straightening > 0, progress.straightening - 1, jnp.where(stuck, needed, 0))
    left = jnp.where((straight.length > radius) & sound, left, 0)
    restarting = left > 0
    progress = Progress(
        best_error=jnp.where(restarting, jnp.inf, jnp.where(better, error, progress.best_error)).astype(error.dtype),
        since_best=jnp.where(restarting, 0, since),
        straightening=left,
        restarts=progress.restarts + (restarting & (progress.straightening == 0)),
    )
    motion = jnp.where(restarting, straight.motion, plan.motion)
    # a rollout that is needed in few calls
    value = jax.lax.cond(restarting, problem.value, lambda motion: plan.value, straight.motion)
    action = jnp.where(restarting, Action.STRAIGHTEN, decision.action).astype(jnp.int32)
    return Decision(dataclasses.replace(plan, motion=motion, value=value), action), progress


def _sound(result: Int[Array, ""]) -> Bool[Array, ""]:
    """Whether a plan of this result may be carried out."""
    return (result != Result.NONFINITE) & (result != Result.EMPTY_SET)
