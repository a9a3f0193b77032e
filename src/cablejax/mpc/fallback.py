"""What is done where a solver's plan is no better than holding still."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from cablejax.mpc.config import MPCConfig
from cablejax.mpc.controller_state import ControllerState
from cablejax.mpc.plan import Outcome, Plan
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


def plan_or_travel(
    config: MPCConfig,
    state: ControllerState,
    way: StraightWay,
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
