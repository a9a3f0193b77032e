"""Fallbacks if no plan is better than holding still, or the error does not fall: hold, straighten, go back, rest."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from cablejax.bounded.results import Result
from cablejax.mpc.config import MPCConfig
from cablejax.mpc.plan import Plan
from cablejax.mpc.problem import ShapingProblem
from cablejax.mpc.state import Action, Progress
from cablejax.mpc.warm_start import Starts

RELAXES = 2
"""Commands of a rest in which the error may change by itself, to at most `RELAXED` times what it was in each."""
RELAXED = 2.0
"""Above that ratio something else has moved the cable."""
ABOUT = 1.25
"""An error of at most this ratio to the lowest counts as about as low."""
WORSE_AFTER = 2
"""Commands without a lower error after which an error that is not about as low is taken back."""
RETURNS = 4
"""How often commands are taken back, before the grippers rest where they are back."""


class Decision(NamedTuple):
    """The decision on a command.

    Attributes:
        plan: to carry out the first command of; its `result` is the solver's, and its `value` that of the solver's plan
            or of rest, also where the motion is another.
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
    seen: Bool[Array, ""],
) -> tuple[Decision, Progress]:
    """The decision, a step back to known good poses, or rest; and the progress.

    Where no command has lowered the error for a while, none that the model can find will. There are two cases:

    - Far from the target. A cable has several shapes between the same grippers, and near another one than the target's
      every plan of a few steps makes the error worse before it makes it better. From the straight cable the target can
      be reached, so it is straightened.
    - Near it. Stick and slip are of the size of what the model promises. The grippers rest as soon as the error is
      about as low as it has been, until it rises, as after a disturbance, or turns out to be far. Where the cable gets
      worse instead, they go back to where it was best before friction holds it in another shape, and plan again with
      half the bound on their motion (`radius_after`): a trust region's rejected step. They rest there after `RETURNS`
      ways back.

    Where the shape was not observed (`seen` false), the error is that of a prediction: it is not taken for the lowest
    so far, and the command does not count as one that failed to lower it.
    """
    plan, sound = decision.plan, _sound(decision.plan.result)
    held = decision.action == Action.HOLD
    ways = start.straightening.length, start.back.length
    progress = _followed(config, progress, problem.pose, error, ways, seen=seen, sound=sound, held=held)
    mode = jnp.where(sound, progress.mode, Action.FOLLOW)
    motion = jnp.select(
        [mode == Action.STRAIGHTEN, mode == Action.RETURN, mode == Action.HOLD],
        [start.straightening.motion, start.back.motion, start.still],
        plan.motion,
    )
    action = jnp.where(mode == Action.FOLLOW, decision.action, mode).astype(jnp.int32)
    return Decision(dataclasses.replace(plan, motion=motion), action), progress


def _followed(
    config: MPCConfig,
    before: Progress,
    pose: Float[Array, "Q 3"],
    error: Float[Array, ""],
    ways: tuple[Float[Array, ""], Float[Array, ""]],
    *,
    seen: Bool[Array, ""],
    sound: Bool[Array, ""],
    held: Bool[Array, ""],
) -> Progress:
    """The progress after one more observation.

    Args:
        config: settings.
        before: the progress so far.
        pose: of the grippers now, `continued` along the cable.
        error: the shape error now [m].
        ways: lengths of those to where the cable is straight, and to where its shape was best [m].
        seen: whether the shape now was observed.
        sound: whether the plan may be carried out.
        held: whether it is to hold.
    """
    resting = before.mode == Action.HOLD
    # what moved fast comes to rest a while after its grippers
    relaxed = (before.since < RELAXES) & (error <= RELAXED * before.rest_error + config.wake)
    calming = resting & (before.since < RELAXES)
    # of a camera that lags, the cable is seen to relax far away only once its grippers rest
    risen = (error > before.rest_error + config.wake) | (error > config.restart_above)
    woken = resting & ~calming & risen
    planning = (before.mode == Action.FOLLOW) | woken
    best = jnp.where(woken, jnp.inf, before.best_error)
    better = planning & seen & (error < 0.99 * best)
    # commands whose outcome was not observed did not fail
    since = jnp.where(better | woken, 0, before.since + (seen | ~planning))

    far = error > config.restart_above
    tired = planning & sound & ((far & held) | (since >= jnp.where(far, config.restart_after, config.settle_after)))
    far_to_go = ways[0] > config.radius_max
    straighten = tired & far & far_to_go & (before.restarts < config.max_restarts)
    straightening = straighten | (before.mode == Action.STRAIGHTEN)
    # a tenth of a millimetre is no change for the worse
    worse = (since >= WORSE_AFTER) & (error > ABOUT * best + config.min_reduction)
    go_back = planning & sound & ~far & worse
    returning = go_back | (before.mode == Action.RETURN)
    length = jnp.where(straightening, *ways)
    # half as many steps again as the way is long: the bounds on the grippers' distance may lead it round
    needed = jnp.ceil(1.5 * length / config.radius_max).astype(jnp.int32)
    left = jnp.where(straighten | go_back, needed, before.way_left - sound)
    # from within a step of straight the planner goes on by itself
    on_way = (left > 0) & (length > jnp.where(straightening, config.radius_max, config.arrived))
    arrived = returning & ~on_way
    again = arrived & (before.returns + go_back < RETURNS)
    rest = (tired & ~far & ~go_back) | (arrived & ~again)
    mode = jnp.where(on_way & returning, Action.RETURN, Action.FOLLOW)
    mode = jnp.where(on_way & straightening, Action.STRAIGHTEN, mode)
    mode = jnp.where(rest | (resting & ~woken), Action.HOLD, mode)
    return Progress(
        # the cable may lie otherwise than it did, where the grippers are back
        best_error=jnp.where(straightening, jnp.inf, jnp.where(better | again, error, best)).astype(error.dtype),
        best_pose=jnp.where(better, pose, before.best_pose),
        since=jnp.where(straightening | rest | again, 0, since),
        mode=mode.astype(jnp.int32),
        way_left=left,
        restarts=before.restarts + straighten,
        returns=jnp.where(woken | straightening, 0, before.returns + go_back).astype(jnp.int32),
        rest_error=jnp.where(resting & ~relaxed & ~woken, before.rest_error, error),
    )


def radius_after(config: MPCConfig, before: Progress, after: Progress, radius: Float[Array, ""]) -> Float[Array, ""]:
    """The bound on the next motion [m]: halved when commands are taken back, reset after a disturbance."""
    began = after.returns > before.returns
    woken = (before.mode == Action.HOLD) & (after.mode != Action.HOLD)
    radius = jnp.where(began, jnp.maximum(radius / 2.0, config.radius_min), radius)
    return jnp.where(woken, jnp.asarray(config.radius, radius.dtype), radius)


def _sound(result: Int[Array, ""]) -> Bool[Array, ""]:
    """Whether a plan of this result may be carried out."""
    return (result != Result.NONFINITE) & (result != Result.EMPTY_SET)
