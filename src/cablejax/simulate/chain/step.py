"""One time step of the planar chain with every effect built in, in closed form.

The same cable as `MjxEngine`'s, rigid links and hinges between two held ends, by the same linearly implicit Euler step.
The step is written out for a chain instead of a tree: inertia and drag of all links meet in sums over everything beyond
a joint,

    A_ij = sum_{k >= max(i, j)} (x_k - a_i)' R' W_k R (x_k - a_j),    W_k = m_k + dt c_k + dt^2 K_k,

with x_k the nodes, a_i the joints, R a quarter turn, m mass, c drag and K the stiffness of a contact. The unknowns are
the velocities at the end of the step: of the first link's angle, of the joint angles, and of one uniform stretch of the
whole cable, which carries both elasticity along the cable and a slip through a gripper. Gripper 0 carries the root. The
grasps are five rows `G u = g` in the dual form of `cablejax.simulate.grasp`; a compliant grasp is a number on that
matrix's diagonal, so that zero compliance is the rigid grasp itself.

Stiffness is implicit too, by the trapezoidal rule: a cable that damps less than believed must not make the simulation
unstable, and the step must not damp for it.

Where the links are and how fast they rub on the table is taken halfway through the step, from the velocities that the
last steps lead one to expect. Taken at its start, it made motions at 50 ms ten times less accurate. Only contacts,
which are stiff, are taken at the start of the step and solved for its end.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cablejax.arrays import quarter_turn
from cablejax.cable import Discretisation
from cablejax.effects.physics import Physics
from cablejax.simulate.chain.geometry import beyond, cross, solve_lower
from cablejax.simulate.chain.state import ChainState, Frame, frame_of, halfway_state
from cablejax.simulate.composite import link_lengths
from cablejax.simulate.contact import obstacle_contact
from cablejax.simulate.friction import drag_coefficient, on_table
from cablejax.simulate.grasp import solve_held

SLIP_DURATION = 0.1
"""Time constant of a slip [s]."""


class Load(NamedTuple):
    """Forces on the nodes.

    Attributes:
        mass: [kg], shape [n].
        drag: force over velocity [N s/m], shape [n]; zero at the two held nodes.
        force: [N], shape [n, 2].
        contact: stiffness of contacts (xx, xy, yy) [N/m], shape [n, 3].
    """

    mass: Array
    drag: Array
    force: Array
    contact: Array


def advance(
    config: Discretisation,
    physics: Physics,
    state: ChainState,
    before: Float[Array, "Q 3"],
    after: Float[Array, "Q 3"],
    dt: Float[Array, ""] | float,
    time: Float[Array, ""] | float,
    *,
    with_contact: bool,
) -> ChainState:
    """The state one time step later. Differentiable in everything, in forward and reverse mode.

    Args:
        config: geometry and resolution; its time step and nominal values are not used.
        physics: of this cable.
        state: at the start of the step.
        before: gripper poses at its start [m, rad].
        after: gripper poses at its end.
        dt: duration of the step [s].
        time: at its end, since the start of the episode [s].
        with_contact: whether the obstacle can be touched. Looking for contacts is a quarter of a step's work.
    """
    root_velocity = (after[0, :2] - before[0, :2]) / dt
    start, halfway = frame_of(config, state), frame_of(config, halfway_state(state, dt))
    load = _load(config, physics, start, halfway, before[0, :2], 0.5 * dt * root_velocity, with_contact)
    moment, joint_implicit = _joints(config, physics, state, dt)
    matrix = _matrix(halfway, load, config, joint_implicit, dt)
    rhs = _impulses(start, halfway, load, config, moment, root_velocity, dt)
    rows, yielding = _grasps(config, physics, halfway)
    wanted = _wanted(config, physics, state, start, after, dt, time)
    solved = solve_lower(matrix, jnp.concatenate([rhs[:, None], rows.T], axis=1))
    speeds = solve_held(solved, rows, wanted, yielding / dt**2)
    return _remembered(config, physics, state, speeds, root_velocity, dt)


def slipped(physics: Physics, time: Float[Array, ""]) -> Float[Array, "2"]:
    """Length of cable that has come through either gripper [m]."""
    return physics.slip * jax.nn.sigmoid((time - physics.slip_time) / SLIP_DURATION)


def _load(
    config: Discretisation, physics: Physics, start: Frame, halfway: Frame, root, moved, with_contact: bool
) -> Load:
    """The two held nodes carry mass only. Gripper 0 is at `root` as the step starts, and has `moved` by its middle."""
    h, n, dtype = config.link_length, config.n_links, start.theta.dtype
    free = jnp.ones(n, dtype).at[jnp.array([0, -1])].set(0.0)
    mass = physics.density * jnp.asarray(link_lengths(config), dtype) + physics.extra_mass
    rubbed = root + moved + halfway.nodes
    drag = free * drag_coefficient(
        physics, rubbed, halfway.velocity, on_table(physics, mass, h), h, config.friction_speed
    )
    force, contact = jnp.zeros_like(rubbed), jnp.zeros((n, 3), dtype)
    if with_contact:
        force, contact = obstacle_contact(physics, root + start.nodes, h * start.along)
    return Load(mass, drag, mass[:, None] * physics.tilt + force, contact)


def _joints(config: Discretisation, physics: Physics, state: ChainState, dt) -> tuple[Array, Array]:
    """Moments of the joints [N m], and what they add to the matrix.

    Elastic, viscous, and internal friction (Dahl 1968), which saturates at its moment.
    """
    h = config.link_length
    elastic = state.angles[1:] / h - physics.rest_curvature - state.set_curvature
    # Elastic moments as they are in the middle of the step: at its end, as implicit Euler has them, they would add
    # dt / 2 to the damping time. The internal friction takes its slope at zero, the same in both directions: a
    # sign would jump at rest.
    stiffness = (0.5 * physics.stiffness + physics.hysteresis_moment / physics.hysteresis_curvature) / h
    moment = physics.stiffness * elastic + physics.hysteresis_moment * state.friction_state
    return moment, dt * (physics.damping_time * physics.stiffness / h) + dt**2 * stiffness


def _matrix(frame: Frame, load: Load, config: Discretisation, joint_implicit, dt) -> Float[Array, "n1 n1"]:
    """Lower triangle of A, in units of mass."""
    nodes, joints, n, dtype = frame.nodes, frame.joints, config.n_links, frame.theta.dtype
    weight, contact = load.mass + dt * load.drag, load.contact
    # R' W R: a quarter turn swaps the axes of the contact's stiffness
    xx = weight + dt**2 * contact[:, 2]
    xy = -(dt**2) * contact[:, 1]
    yy = weight + dt**2 * contact[:, 0]
    first_moment = jnp.stack([xx * nodes[:, 0] + xy * nodes[:, 1], xy * nodes[:, 0] + yy * nodes[:, 1]], axis=1)
    second_moment = jnp.sum(first_moment * nodes, axis=1)
    sums = jnp.stack([xx, xy, yy, *first_moment.T, second_moment + _inertia(config, load.mass)], axis=1)
    sxx, sxy, syy, sx, sy, s2 = beyond(sums).T
    ax, ay = joints.T
    weighted = beyond(weight[:, None] * nodes)
    coupling = -cross(joints, weighted) / frame.scale
    corner = jnp.sum(weight[:, None] * nodes**2) / frame.scale**2 + 1e-9
    # entry by entry, in one loop; the last row is the stretch's
    column, across_x, across_y, ax, ay = jnp.pad(
        jnp.stack([s2 - ax * sx - ay * sy, sxx * ax + sxy * ay - sx, sxy * ax + syy * ay - sy, ax, ay]),
        [(0, 0), (0, 1)],
    )
    row = jnp.arange(n + 1)[:, None]
    matrix = column[:, None] + across_x[:, None] * ax + across_y[:, None] * ay
    matrix = jnp.where(row == n, jnp.append(coupling, corner), matrix)
    diagonal = jnp.concatenate([jnp.full(1, 1e-9, dtype), joint_implicit, jnp.zeros(1, dtype)])
    return matrix + jnp.where(row == jnp.arange(n + 1), diagonal, 0.0)


def _impulses(
    start: Frame, halfway: Frame, load: Load, config: Discretisation, moment, root_velocity, dt
) -> Float[Array, "n1"]:
    """Right-hand side: momentum at the start of the step and impulses during it."""
    nodes, contact = halfway.nodes, load.contact
    impulse = (
        load.mass[:, None] * (start.velocity - root_velocity - dt * halfway.bias)
        + dt * load.force
        - dt * load.drag[:, None] * root_velocity
    )
    contact_drag = jnp.stack(
        [
            contact[:, 0] * root_velocity[0] + contact[:, 1] * root_velocity[1],
            contact[:, 1] * root_velocity[0] + contact[:, 2] * root_velocity[1],
        ],
        axis=1,
    )
    impulse = impulse - dt**2 * contact_drag
    spin = (_inertia(config, load.mass) * start.rate)[:, None]
    total = beyond(jnp.concatenate([impulse, cross(nodes, impulse)[:, None] + spin], axis=1))
    rhs = total[:, 2] - cross(halfway.joints, total[:, :2])
    rhs = rhs.at[1:].add(-dt * moment)
    return jnp.append(rhs, jnp.sum(nodes * impulse) / halfway.scale)


def _inertia(config: Discretisation, mass: Float[Array, "n"]) -> Float[Array, "n"]:
    """Of each link about its middle [kg m^2]."""
    return mass * jnp.asarray(link_lengths(config), mass.dtype) ** 2 / 12


def _grasps(config: Discretisation, physics: Physics, frame: Frame) -> tuple[Float[Array, "5 n1"], Float[Array, "5"]]:
    """Rows G of the grasps and of the stretch, and their compliances."""
    nodes, n, dtype = frame.nodes, config.n_links, frame.theta.dtype
    tip = quarter_turn(nodes[-1] - frame.joints)
    tip_stretch = nodes[-1] / frame.scale
    ones, none, zero = jnp.ones(n, dtype), jnp.zeros(n, dtype), jnp.zeros((), dtype)
    rows = jnp.stack(
        [
            jnp.append(none.at[0].set(1.0), 0.0),
            jnp.append(tip[:, 0], tip_stretch[0]),
            jnp.append(tip[:, 1], tip_stretch[1]),
            jnp.append(ones, 0.0),
            jnp.append(none, 1.0),
        ]
    )
    c = physics.rotation_compliance
    return rows, jnp.stack([c[0], zero, zero, c[1], physics.axial_compliance / config.cable.length])


def _wanted(
    config: Discretisation, physics: Physics, state: ChainState, start: Frame, after, dt, time
) -> Float[Array, "5"]:
    """The velocities of the rows that carry both ends to where the grippers are at the end of the step."""
    return (
        jnp.stack(
            [
                after[0, 2] + physics.rotation_offset[0] - start.theta[0],
                *(after[1, :2] - after[0, :2] - start.nodes[-1]),
                after[1, 2] + physics.rotation_offset[1] - start.theta[-1],
                jnp.sum(slipped(physics, time)) / config.cable.length - state.stretch,
            ]
        )
        / dt
    )


def _remembered(
    config: Discretisation, physics: Physics, state: ChainState, speeds: Float[Array, "n1"], root_velocity, dt
) -> ChainState:
    """The state at the end of the step, with what the joints keep of their bends."""
    h = config.link_length
    angles = state.angles + dt * speeds[:-1]
    change = angles[1:] / h - state.angles[1:] / h
    sign = jnp.where(change < 0, -1.0, 1.0)
    rubbed = sign + (state.friction_state - sign) * jnp.exp(-jnp.abs(change) / physics.hysteresis_curvature)
    # Return mapping of plasticity with linear kinematic hardening (Simo and Hughes 1998, 1.5).
    driven = angles[1:] / h - physics.rest_curvature - (1.0 + physics.hardening) * state.set_curvature
    excess = driven - jnp.clip(driven, -physics.yield_curvature, physics.yield_curvature)
    return ChainState(
        angles=angles,
        stretch=state.stretch + dt * speeds[-1],
        velocity=speeds,
        expected=2.0 * speeds - state.velocity,
        set_curvature=state.set_curvature + excess / (1.0 + physics.hardening),
        friction_state=rubbed,
        root_velocity=root_velocity,
        expected_root=2.0 * root_velocity - state.root_velocity,
    )
