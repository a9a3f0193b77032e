"""One time step of the planar chain with every effect built in, in closed form.

The same cable as `MjxEngine`'s, rigid links and hinges between two held ends, by the same linearly implicit Euler step.
The step is written out for a chain instead of a tree,

    A_ij = sum_k c_ki c_kj t_i' W_k t_j,    W_k = m_k + dt c_k + dt^2 K_k,

with c_ki how far link i carries node k, t_i the direction in which it turns, m mass, c drag and K the stiffness of a
contact. The unknowns are the velocities at the end of the step: of the links' angles, and of one uniform stretch of the
whole cable, which carries both elasticity along the cable and a slip through a gripper. In the joints' angles instead,
the condition number would grow with the fourth power of the number of links instead of the second, and float32 would
not do for soft cables. Gripper 0 carries the root. The grasps are five rows `G u = g` in the dual form of
`cablejax.simulate.grasp`; a compliant grasp is a number on that matrix's diagonal, so that zero compliance is the rigid
grasp itself.

Stiffness is implicit too, by the trapezoidal rule: a cable that damps less than believed must not make the simulation
unstable, and the step must not damp for it.

Where the links are and how fast they rub on the table is taken halfway through the step, from the velocities that the
last steps lead one to expect. Taken at its start, it made motions at 50 ms ten times less accurate. Only contacts,
which are stiff, are taken at the start of the step and solved for its end. Centrifugal forces, quadratic in an expected
velocity, fade where the links turn so fast that the expectation is worth little: they made the links of a soft rope
that buckles swing ever more from step to step.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cablejax.cable import Discretisation
from cablejax.effects.physics import Physics
from cablejax.simulate.chain.geometry import levers, solve_lower
from cablejax.simulate.chain.state import ChainState, Frame, frame_of, halfway_state
from cablejax.simulate.composite import link_lengths
from cablejax.simulate.contact import obstacle_contact
from cablejax.simulate.friction import drag_coefficient, on_table
from cablejax.simulate.grasp import solve_held

SLIP_DURATION = 0.1
"""Time constant of a slip [s]."""

_FAST_TURN = 0.2
"""Root mean square turn of the links in half a step [rad] at which centrifugal forces count half."""


class Load(NamedTuple):
    """Forces on the nodes, and what resists them.

    Attributes:
        mass: [kg], shape [n].
        inertia: of each link about its middle [kg m^2], shape [n].
        drag: force over velocity [N s/m], shape [n]; zero at the two held nodes.
        force: [N], shape [n, 2].
        contact: stiffness of contacts (xx, xy, yy) [N/m], shape [n, 3].
    """

    mass: Array
    inertia: Array
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
    rates = solve_held(solved, rows, wanted, yielding / dt**2)
    speeds = jnp.concatenate([rates[:1], jnp.diff(rates[:-1]), rates[-1:]])
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
    lengths = jnp.asarray(link_lengths(config), dtype)
    own = physics.density * lengths
    # what is added is a point on its node, which a turn of the link does not move
    mass, inertia = own + physics.extra_mass, own * lengths**2 / 12
    rubbed = root + moved + halfway.nodes
    drag = free * drag_coefficient(
        physics, rubbed, halfway.velocity, on_table(physics, mass, h), h, config.friction_speed
    )
    force, contact = jnp.zeros_like(rubbed), jnp.zeros((n, 3), dtype)
    if with_contact:
        force, contact = obstacle_contact(physics, root + start.nodes, h * start.along)
    return Load(mass, inertia, drag, mass[:, None] * physics.tilt + force, contact)


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
    """Lower triangle of A, in units of mass; the last row is the stretch's."""
    n, arms, turning = config.n_links, levers(config), frame.turning
    weight, contact = load.mass + dt * load.drag, load.contact
    resisting = jnp.stack(
        [weight + dt**2 * contact[:, 0], dt**2 * contact[:, 1], weight + dt**2 * contact[:, 2]], axis=1
    )

    def pressed(sums):
        xx, xy, yy = sums.T
        return jnp.stack([xx * turning[:, 0] + xy * turning[:, 1], xy * turning[:, 0] + yy * turning[:, 1]], axis=1)

    # of the later of two links, all that it moves; of the earlier its whole length
    later = pressed(jnp.asarray(arms.T, weight.dtype) @ resisting)
    earlier = jnp.asarray(link_lengths(config), weight.dtype)[:, None] * turning
    own = jnp.sum(pressed(jnp.asarray(arms.T**2, weight.dtype) @ resisting) * turning, axis=1)
    coupling = _turned(config, frame, weight[:, None] * frame.nodes) / frame.scale
    corner = jnp.sum(weight[:, None] * frame.nodes**2) / frame.scale**2 + 1e-9
    # a joint resists the difference of two links' angles
    between = jnp.pad(joint_implicit, 1)
    diagonal = jnp.append(own + load.inertia + between[1:] + between[:-1], corner)
    neighbours = jnp.append(-joint_implicit, jnp.zeros(2, weight.dtype))
    # entry by entry, in one loop
    later_x, later_y, earlier_x, earlier_y = jnp.pad(jnp.concatenate([later, earlier], axis=1).T, [(0, 0), (0, 1)])
    row, column = jnp.arange(n + 1)[:, None], jnp.arange(n + 1)
    matrix = later_x[:, None] * earlier_x + later_y[:, None] * earlier_y
    matrix = matrix + jnp.where(row == column + 1, neighbours, 0.0)
    matrix = jnp.where(row == n, jnp.append(coupling, 0.0), matrix)
    return jnp.where(row == column, diagonal, matrix)


def _impulses(
    start: Frame, halfway: Frame, load: Load, config: Discretisation, moment, root_velocity, dt
) -> Float[Array, "n1"]:
    """Right-hand side: momentum at the start of the step and impulses during it."""
    contact = load.contact
    fading = 1.0 + jnp.mean((0.5 * dt * halfway.rate) ** 2) / _FAST_TURN**2
    # at its end, the step's velocities act where the links are halfway: only half of the bias is left to come
    impulse = (
        load.mass[:, None] * (start.velocity - root_velocity - 0.5 * dt * halfway.bias / fading)
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
    spin = load.inertia * start.rate
    rhs = _turned(config, halfway, impulse) + spin + dt * jnp.diff(jnp.pad(moment, 1))
    return jnp.append(rhs, jnp.sum(halfway.nodes * impulse) / halfway.scale)


def _turned(config: Discretisation, frame: Frame, along: Float[Array, "n 2"]) -> Float[Array, "n"]:
    """Of vectors at the nodes: their components in what each link's angle moves, weighted with its lever."""
    return jnp.sum(frame.turning * (jnp.asarray(levers(config).T, along.dtype) @ along), axis=1)


def _grasps(config: Discretisation, physics: Physics, frame: Frame) -> tuple[Float[Array, "5 n1"], Float[Array, "5"]]:
    """Rows G of the grasps and of the stretch, and their compliances."""
    n, dtype = config.n_links, frame.theta.dtype
    tip = jnp.asarray(levers(config)[-1], dtype)[:, None] * frame.turning
    unit = jnp.eye(n + 1, dtype=dtype)
    across, zero = jnp.append(tip, frame.nodes[-1:] / frame.scale, axis=0).T, jnp.zeros((), dtype)
    rows = jnp.concatenate([unit[:1], across, unit[n - 1 :]])
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
    bends, rubbed = kept_bends(physics, angles[1:] / h, change, state.set_curvature, state.friction_state)
    return ChainState(
        angles=angles,
        stretch=state.stretch + dt * speeds[-1],
        velocity=speeds,
        expected=2.0 * speeds - state.velocity,
        set_curvature=bends,
        friction_state=rubbed,
        root_velocity=root_velocity,
        expected_root=2.0 * root_velocity - state.root_velocity,
    )


def kept_bends(physics: Physics, curvature: Any, change: Any, bends: Any, rubbed: Any) -> tuple[Any, Any]:
    """Plastic bend [1/m] and internal friction of joints at this curvature, after this change. NumPy or JAX arrays.

    Dahl's law (Dahl 1968) is exact for a constant direction; plasticity is the return mapping with linear kinematic
    hardening (Simo and Hughes 1998, 1.5).
    """
    xp = curvature.__array_namespace__()
    driven = curvature - physics.rest_curvature - (1.0 + physics.hardening) * bends
    excess = driven - xp.clip(driven, -physics.yield_curvature, physics.yield_curvature)
    sign, worn = xp.where(change < 0, -1.0, 1.0), xp.exp(-xp.abs(change) / physics.hysteresis_curvature)
    return bends + excess / (1.0 + physics.hardening), sign + (rubbed - sign) * worn
