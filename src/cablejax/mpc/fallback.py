"""What is done where a solver's plan is no better than holding still, or leads nowhere."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cablejax.mpc.config import MPCConfig
from cablejax.mpc.controller_state import ControllerState
from cablejax.mpc.plan import Outcome, Plan
from cablejax.mpc.problem import ShapingProblem
from cablejax.mpc.start import Starts, StraightWay


def plan_or_hold(config: MPCConfig, plan: Plan, start: Starts) -> Plan:
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


def plan_or_restart(
    config: MPCConfig,
    state: ControllerState,
    problem: ShapingProblem,
    error: Float[Array, ""],
    plan: Plan,
    straight: StraightWay,
) -> tuple[Plan, ControllerState]:
    """The plan, or the next step of straightening the cable; and the state with what is counted for that.

    A cable has several shapes between the same grippers, and near another one than the target's every plan of a few
    steps makes the error worse before it makes it better. From the straight cable the target can be reached.
    """
    radius = problem.feasible.radius
    better = error < 0.99 * state.best_error
    since = jnp.where(better, 0, state.since_best + 1)
    staying = (plan.outcome == Outcome.HELD) | (since >= config.restart_after)
    stuck = staying & (error > config.restart_above) & (state.restarts < config.max_restarts)
    # half as many steps again as the way is long: the bounds on the grippers' distance may lead it round
    needed = jnp.ceil(1.5 * straight.length / radius).astype(jnp.int32)
    left = jnp.where(state.restarting > 0, state.restarting - 1, jnp.where(stuck, needed, 0))
    sound = (plan.outcome != Outcome.NONFINITE) & (plan.outcome != Outcome.INFEASIBLE)
    left = jnp.where((straight.length > radius) & sound, left, 0)
    restarting = left > 0
    state = dataclasses.replace(
        state,
        best_error=jnp.where(restarting, jnp.inf, jnp.where(better, error, state.best_error)).astype(error.dtype),
        since_best=jnp.where(restarting, 0, since),
        restarting=left,
        restarts=state.restarts + (restarting & (state.restarting == 0)),
    )
    motion = jnp.where(restarting, straight.motion, plan.motion)
    # a rollout that is needed in few calls
    value = jax.lax.cond(restarting, problem.value, lambda motion: plan.value, straight.motion)
    outcome = jnp.where(restarting, Outcome.RESTARTING, plan.outcome).astype(jnp.int32)
    return dataclasses.replace(plan, motion=motion, value=value, outcome=outcome), state
