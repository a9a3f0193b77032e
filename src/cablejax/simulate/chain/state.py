"""The state of the planar chain between two steps, and the positions of its links."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cablejax.arrays import quarter_turn
from cablejax.cable import Discretisation
from cablejax.simulate.chain.geometry import levers, summed


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ChainState:
    """State of one cable between two steps.

    Attributes:
        angles: theta of the first link, then the joint angles [rad], shape [n].
        stretch: relative change of the free length, shape [].
        velocity: of both, shape [n + 1].
        expected: the velocity halfway through the next step, as far as it is known before, shape [n + 1].
        set_curvature: permanent part of the curvature of each joint [1/m], shape [J].
        friction_state: internal friction of each joint, -1 to 1, shape [J].
        root_velocity: of gripper 0 in the last step [m/s], shape [2].
        expected_root: its velocity in the next step, as `expected` is, shape [2].
    """

    angles: Float[Array, "n"]
    stretch: Float[Array, ""]
    velocity: Float[Array, "n1"]
    expected: Float[Array, "n1"]
    set_curvature: Float[Array, "J"]
    friction_state: Float[Array, "J"]
    root_velocity: Float[Array, "2"]
    expected_root: Float[Array, "2"]


class Frame(NamedTuple):
    """Positions and velocities of the links, relative to gripper 0.

    Attributes:
        theta: angle of each link [rad], shape [n].
        rate: its velocity [rad/s], shape [n].
        scale: 1 + stretch, shape [].
        along: direction of each link times the scale, shape [n, 2].
        turning: how `along` turns with `theta`, shape [n, 2].
        nodes: [m], shape [n, 2].
        velocity: of the nodes in the world [m/s], shape [n, 2].
        bias: accelerations of the nodes at constant rates [m/s^2], shape [n, 2].
    """

    theta: Array
    rate: Array
    scale: Array
    along: Array
    turning: Array
    nodes: Array
    velocity: Array
    bias: Array


def chain_nodes(
    config: Discretisation, angles: Float[Array, "n"], stretch: Float[Array, ""]
) -> tuple[Float[Array, "n 2"], Float[Array, "n 2"]]:
    """Nodes relative to gripper 0 [m], and unit vectors along the links."""
    theta = summed(angles)
    unit = jnp.stack([jnp.cos(theta), jnp.sin(theta)], axis=1)
    return jnp.asarray(levers(config), angles.dtype) @ ((1.0 + stretch) * unit), unit


def expecting_no_change(state: ChainState) -> ChainState:
    """The state with known velocities and no expected change of these."""
    return dataclasses.replace(state, expected=state.velocity, expected_root=state.root_velocity)


def halfway_state(state: ChainState, dt) -> ChainState:
    """The state expected in the middle of the step.

    Gripper 0 is expected to move on as all else is, although its motion is known: else it would seem to drag along a
    cable that lies still.
    """
    return dataclasses.replace(
        state,
        angles=state.angles + 0.5 * dt * state.expected[:-1],
        stretch=state.stretch + 0.5 * dt * state.expected[-1],
        velocity=state.expected,
        root_velocity=state.expected_root,
    )


def frame_of(config: Discretisation, state: ChainState) -> Frame:
    """Positions and velocities of a state's links."""
    arms = jnp.asarray(levers(config), state.angles.dtype)
    theta, rate = summed(state.angles), summed(state.velocity[:-1])
    scale = 1.0 + state.stretch
    along = scale * jnp.stack([jnp.cos(theta), jnp.sin(theta)], axis=1)
    nodes, turning = arms @ along, quarter_turn(along)
    velocity = state.root_velocity + arms @ (rate[:, None] * turning) + nodes * (state.velocity[-1] / scale)
    bias = arms @ (-(rate**2)[:, None] * along)
    return Frame(theta, rate, scale, along, turning, nodes, velocity, bias)
