"""One time step of BDF2 of variable length, solved to a tolerance, with an estimate of its local error."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cablejax.simulate.rod.constrained import (
    TOLERANCE,
    ElasticChain,
    bends_of,
    constrained,
    spread_bends,
    with_held,
)
from cablejax.simulate.rod.discrete import DiscreteRod
from cablejax.simulate.rod.material import forces_of_torques, spin_of_joints, transport, unit

# The turning of the material couples x, y and z in the damping force, which is therefore extrapolated. For stability,
# the damping of bends that do not turn is added implicitly, times this, and taken off extrapolated. BDF2 is then stable
# at any damping as long as no motion is damped by more than 4/3 of the implicit part, twice what it is without turning.
_IMPLICIT = 1.5


class Motion(NamedTuple):
    """State of a moving cable: its last two time steps.

    Attributes:
        nodes, nodes_before: [m].
        velocity, velocity_before: of the nodes [m/s].
        tension, tension_before: of the edges.
        directors, tangents: unit vectors across and along the edges.
        last: duration of the last step [s].
    """

    nodes: Float[Array, "n 3"]
    nodes_before: Float[Array, "n 3"]
    velocity: Float[Array, "n 3"]
    velocity_before: Float[Array, "n 3"]
    tension: Float[Array, "e"]
    tension_before: Float[Array, "e"]
    directors: Float[Array, "m 3"]
    tangents: Float[Array, "m 3"]
    last: Float[Array, ""]


def time_step(
    discrete: DiscreteRod,
    state: Motion,
    dt: Float[Array, ""],
    ends: Float[Array, "4 3"],
    side: Float[Array, "2 3"],
    roll_rate: Float[Array, "2"],
    markers: Float[Array, "N 3"] | None = None,
    *,
    twisting: bool,
) -> tuple[Motion, Bool[Array, ""], Float[Array, ""]]:
    """The motion after a step of `dt` [s], whether the step was solved, and its local error [m].

    The difference quotient over steps of unequal length is x' = (a x - known) with a = (1 + 2 w) / (1 + w) / dt and w
    the ratio of this step to the last one. What is stiff is implicit; quadratic drag, rest curvature, twist and how
    damping couples x, y and z are extrapolated from the last two steps.

    Args:
        discrete: the cable.
        state: before the step.
        dt: duration of the step.
        ends: the held nodes after the step [m].
        side: the held edges' directors after the step.
        roll_rate: of the held edges about themselves after the step [rad/s].
        markers: that pull the cable towards themselves [m], NaN = not observed; None = there are none.
        twisting: whether the material frame is followed.
    """
    physics, bending, mass = discrete.physics, discrete.bending, discrete.mass
    x, x_old, v, v_old, tension, tension_old, u, t, last = state
    w = dt / last
    lead, past = (1 + 2 * w) / (1 + w) / dt, w**2 / (1 + w)
    known = ((1 + w) * x - past * x_old) / dt
    x_next, v_next = x + w * (x - x_old), v + w * (v - v_old)
    edges = jnp.diff(x_next, axis=0)
    resistance, bends = (bending * physics.damping_time)[:, None], bends_of(x_next)

    # rate of change of the bends in the frame of the material, and the force that opposes it. That is the transpose of
    # the rate, so that damping dissipates in every motion
    spin = spin_of_joints(edges, jnp.diff(v_next, axis=0), roll_rate)
    resisted = resistance * (bends_of(v_next) - jnp.cross(spin, bends))
    coupled = forces_of_torques(edges, jnp.cross(bends, resisted))
    uncoupled = _IMPLICIT * resistance * (bends_of(known) + bends_of(v_next))
    speed = jnp.sqrt(jnp.sum(v_next**2, axis=1, keepdims=True) + 1e-12)
    inertia = lead * known + ((1 + w) * v - past * v_old) / dt + physics.gravity
    drag = physics.drag + physics.quadratic_drag * speed[2:-2]
    force = (
        mass * inertia[2:-2] + drag * known[2:-2] + spread_bends(uncoupled - resisted) + coupled[1:-2] - coupled[2:-1]
    )
    if twisting:
        force = force + discrete.forces(transport(u, t, unit(edges)), unit(edges))
    pins = jnp.zeros((0, discrete.n - 4))
    if markers is not None:
        offsets = discrete.marker_offsets(u, t) if twisting else 0.0
        pins, pull = discrete.following(markers - offsets, ends)
        force = force + pull
    chain = ElasticChain(
        weight=lead**2 * mass[:, 0] + lead * drag[:, 0],
        bending=(1.0 + _IMPLICIT * lead * physics.damping_time) * bending,
        edge=discrete.h,
        compliance=discrete.compliance,
        pins=pins,
    )
    guess = x + dt * v + 0.5 * dt * w * (v - v_old)
    free, pulled, error = constrained(
        False, chain, force, ends, *jax.lax.stop_gradient((guess[2:-2], tension + w * (tension - tension_old)))
    )
    new = with_held(free, ends)
    if twisting:
        u, t = discrete.followed(new, u, t, side)
    speeds = lead * new - known
    # of BDF2, by the velocity's distance from its extrapolation
    off = (1 + w) / (3 * (1 + 2 * w)) * dt * (speeds - v_next)[2:-2]
    local = jnp.sqrt(jnp.max(jnp.sum(off**2, axis=1)))
    return Motion(new, x, speeds, v, pulled, tension, u, t, dt), error <= TOLERANCE, local
