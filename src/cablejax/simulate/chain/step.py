"""The planar chain of `MjxEngine` with every effect built in, its step in closed form.

The same cable as the engine's, rigid links and hinges between two held ends, by the same linearly implicit Euler step.
A diagnosis replays a log thousands of times, so the step is written out for a chain instead of a tree: inertia and drag
of all links meet in sums over everything beyond a joint,

    A_ij = sum_{k >= max(i, j)} (x_k - a_i)' R' W_k R (x_k - a_j),    W_k = m_k + dt c_k + dt^2 K_k,

with x_k the nodes, a_i the joints, R a quarter turn, m mass, c drag and K the stiffness of a contact. The unknowns are
the velocities at the end of the step: of the first link's angle, of the joint angles, and of one uniform stretch of the
whole cable, which carries both elasticity along the cable and a slip through a gripper. Gripper 0 carries the root. The
grasps are five rows `G u = g` in the dual form of `cablejax.simulate.grasp`; a compliant grasp is a number on that
matrix's diagonal, so that zero compliance is the rigid grasp itself.

Stiffness is implicit too, by the trapezoidal rule: a cable that damps less than believed must not make the simulation
unstable, and the step must not damp for it.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cablejax.cable import Discretisation
from cablejax.effects.physics import Physics, normal_gravity
from cablejax.simulate.compile import full_precision
from cablejax.simulate.composite import link_lengths, node_offsets
from cablejax.simulate.grasp import solve_positive

LARGEST_STEP = 0.05
"""Longest time step of a fit [s]. What it is off for the nominal cable is known from one replay with `FINE_STEP`."""
FINE_STEP = 0.01
"""Longest time step of the nominal cable that a log is compared with [s]."""
_SETTLE_STEPS = 20
_SETTLE_STEP = 0.2
# Stiffness of a contact of one link's length [N/m]: a cable of 0.1 N presses 0.1 mm into an obstacle.
_CONTACT_STIFFNESS = 1000.0
_CONTACT_POINTS = 4
# Over which the onset of a contact is smoothed [m].
_CONTACT_EDGE = 0.0005
PATCH_EDGE = 0.005
"""Over which the edge of a friction patch is smoothed [m]."""
SLIP_DURATION = 0.1
"""Time scale of the sigmoid with which the cable slips through a gripper [s]."""
STRIBECK_SPEED = 0.004
"""Speed at which sliding has taken away most of the static excess [m/s]."""
_REGULARISATION = 1e-7


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ChainState:
    """State of one cable.

    Attributes:
        angles: theta of the first link, then the joint angles [rad], shape [n].
        stretch: relative change of the free length, shape [].
        velocity: of both, shape [n + 1].
        set_curvature: permanent part of the curvature of each joint [1/m], shape [J].
        friction_state: internal friction of each joint, -1 to 1, shape [J].
        root_velocity: of gripper 0 in the last step [m/s], shape [2].
    """

    angles: Float[Array, "n"]
    stretch: Float[Array, ""]
    velocity: Float[Array, "n1"]
    set_curvature: Float[Array, "J"]
    friction_state: Float[Array, "J"]
    root_velocity: Float[Array, "2"]


@dataclasses.dataclass(frozen=True)
class Chain:
    """Replays gripper poses. Pure, to be vmapped and jitted by the caller.

    Attributes:
        config: geometry and resolution; its time step and nominal values are not used.
        with_contact: whether the obstacle can be touched. Looking for contacts is a quarter of a step's work.
    """

    config: Discretisation
    with_contact: bool = True

    @full_precision
    def rollout(
        self,
        physics: Physics,
        angles: Float[Array, "n"],
        gripper_pose: Float[Array, "T Q 3"],
        interval: Float[Array, ""],
        *,
        n_substeps: int,
    ) -> Float[Array, "T N 2"]:
        """Keypoints on the centreline, as the physics has them: before any camera.

        The cable first settles, without friction, from `angles` at the first pose. Differentiable in forward mode in
        everything but `n_substeps`.

        Args:
            physics: of this cable.
            angles: theta of the first link and joint angles near the settled start [rad].
            gripper_pose: (x, y, theta) at every sample, theta continuous.
            interval: between two samples [s].
            n_substeps: time steps between two samples.
        """
        zeros = jnp.zeros(self.config.n_joints, angles.dtype)
        start = ChainState(
            angles=angles,
            stretch=jnp.zeros((), angles.dtype),
            velocity=jnp.zeros(self.config.n_links + 1, angles.dtype),
            set_curvature=zeros,
            friction_state=zeros,
            root_velocity=jnp.zeros(2, angles.dtype),
        )
        first = gripper_pose[0]
        calm = dataclasses.replace(
            physics,
            friction=jnp.zeros_like(physics.friction),
            patch_friction=jnp.zeros_like(physics.patch_friction),
            hysteresis_moment=jnp.zeros_like(physics.hysteresis_moment),
            yield_curvature=jnp.full_like(physics.yield_curvature, 1e3),
            drag=jnp.zeros_like(physics.drag),
        )
        start, _ = jax.lax.scan(
            lambda state, _: (self._step(calm, state, first, first, _SETTLE_STEP, -1e3), None),
            start,
            None,
            length=_SETTLE_STEPS,
        )
        start = dataclasses.replace(start, velocity=jnp.zeros_like(start.velocity), friction_state=zeros)
        dt = interval / n_substeps

        def sample(carry, target):
            state, pose, time = carry

            def substep(state, i):
                before = pose + (target - pose) * (i / n_substeps)
                after = pose + (target - pose) * ((i + 1) / n_substeps)
                return self._step(physics, state, before, after, dt, time + (i + 1) * dt), None

            state, _ = jax.lax.scan(substep, state, jnp.arange(n_substeps))
            time = time + interval
            return (state, target, time), self._keypoints(physics, state, target[0, :2], time)

        zero = jnp.zeros((), angles.dtype)
        _, moved = jax.lax.scan(sample, (start, first, zero), gripper_pose[1:])
        return jnp.concatenate([self._keypoints(physics, start, first[0, :2], zero)[None], moved])

    def _step(self, physics: Physics, state: ChainState, before, after, dt, time) -> ChainState:
        h, n = self.config.link_length, self.config.n_links
        dtype = state.angles.dtype
        lengths, offsets = (jnp.asarray(f(self.config), dtype) for f in (link_lengths, node_offsets))
        root, root_velocity = before[0, :2], (after[0, :2] - before[0, :2]) / dt

        # Kinematics: frames, joints, nodes, their velocities and centripetal accelerations.
        theta, rate = jnp.cumsum(state.angles), jnp.cumsum(state.velocity[:-1])
        scale = 1.0 + state.stretch
        along = scale * jnp.stack([jnp.cos(theta), jnp.sin(theta)], axis=1)
        joints = _chained(lengths[:, None] * along)  # relative to the root, as all positions here
        nodes = joints + offsets[:, None] * along
        turning, pulling = rate[:, None] * _turned(along), -(rate**2)[:, None] * along
        velocity = _chained(lengths[:, None] * turning) + offsets[:, None] * turning
        velocity = state.root_velocity + velocity + nodes * (state.velocity[-1] / scale)
        bias = _chained(lengths[:, None] * pulling) + offsets[:, None] * pulling

        # What acts on the nodes. The two held ones carry mass only.
        free = jnp.ones(n, dtype).at[jnp.array([0, -1])].set(0.0)
        mass = physics.density * lengths + physics.extra_mass
        where = root + nodes
        patch = jax.nn.sigmoid((physics.patch_radius - _length(where - physics.patch_centre)) / PATCH_EDGE)
        coefficient = physics.friction + physics.patch_friction * patch
        squared_speed = jnp.sum(velocity**2, axis=1)
        coefficient = coefficient * (1.0 + physics.static_excess * jnp.exp(-squared_speed / STRIBECK_SPEED**2))
        speed = jnp.sqrt(squared_speed + self.config.friction_speed**2)
        drag = free * (coefficient * mass * normal_gravity(physics) / speed + physics.drag * h)
        push, contact = self._contact(physics, where, h * along)
        force = mass[:, None] * physics.tilt + push

        # Joints: elastic, viscous, and internal friction (Dahl 1968), which saturates at its moment.
        curvature = state.angles[1:] / h
        elastic = curvature - physics.rest_curvature - state.set_curvature
        # Elastic moments as they are in the middle of the step: at its end, as implicit Euler has them, they would add
        # dt / 2 to the damping time. The internal friction takes its slope at zero, the same in both directions: a
        # sign would jump at rest.
        stiffness = (0.5 * physics.stiffness + physics.hysteresis_moment / physics.hysteresis_curvature) / h
        moment = physics.stiffness * elastic + physics.hysteresis_moment * state.friction_state
        joint_implicit = dt * (physics.damping_time * physics.stiffness / h) + dt**2 * stiffness

        # A u = b, lower triangle of A.
        weight = mass + dt * drag
        # R' W R: a quarter turn swaps the axes of the contact's stiffness
        xx = weight + dt**2 * contact[:, 2]
        xy = -(dt**2) * contact[:, 1]
        yy = weight + dt**2 * contact[:, 0]
        first_moment = jnp.stack([xx * nodes[:, 0] + xy * nodes[:, 1], xy * nodes[:, 0] + yy * nodes[:, 1]], axis=1)
        second_moment = jnp.sum(first_moment * nodes, axis=1)
        inertia = mass * lengths**2 / 12
        sums = jnp.stack([xx, xy, yy, *first_moment.T, second_moment + inertia], axis=1)
        sxx, sxy, syy, sx, sy, s2 = _beyond(sums).T
        ax, ay = joints.T
        left = jnp.stack([sxx * ax + sxy * ay - sx, sxy * ax + syy * ay - sy], axis=1)
        matrix = (s2 - ax * sx - ay * sy)[:, None] + left @ joints.T
        matrix = matrix + jnp.diag(jnp.concatenate([jnp.full(1, 1e-9, dtype), joint_implicit]))
        weighted = _beyond(weight[:, None] * nodes)
        coupling = -_cross(joints, weighted) / scale
        corner = jnp.sum(weight[:, None] * nodes**2) / scale**2 + 1e-9
        matrix = jnp.concatenate(
            [
                jnp.concatenate([matrix, jnp.zeros((n, 1), dtype)], axis=1),
                jnp.concatenate([coupling, corner[None]])[None],
            ]
        )
        impulse = (
            mass[:, None] * (velocity - root_velocity - dt * bias) + dt * force - dt * drag[:, None] * root_velocity
        )
        contact_drag = jnp.stack(
            [
                contact[:, 0] * root_velocity[0] + contact[:, 1] * root_velocity[1],
                contact[:, 1] * root_velocity[0] + contact[:, 2] * root_velocity[1],
            ],
            axis=1,
        )
        impulse = impulse - dt**2 * contact_drag
        total = _beyond(jnp.concatenate([impulse, _cross(nodes, impulse)[:, None] + (inertia * rate)[:, None]], axis=1))
        rhs = total[:, 2] - _cross(joints, total[:, :2])
        rhs = rhs.at[1:].add(-dt * moment)
        rhs = jnp.append(rhs, jnp.sum(nodes * impulse) / scale)

        # The grasps.
        tip = _turned(nodes[-1] - joints)
        tip_stretch = nodes[-1] / scale
        ones, none = jnp.ones(n, dtype), jnp.zeros(n, dtype)
        rows = jnp.stack(
            [
                jnp.append(none.at[0].set(1.0), 0.0),
                jnp.append(tip[:, 0], tip_stretch[0]),
                jnp.append(tip[:, 1], tip_stretch[1]),
                jnp.append(ones, 0.0),
                jnp.append(none, 1.0),
            ]
        )
        slipped = jnp.sum(physics.slip) * jax.nn.sigmoid((time - physics.slip_time) / SLIP_DURATION)
        wanted = (
            jnp.stack(
                [
                    after[0, 2] + physics.rotation_offset[0] - theta[0],
                    *(after[1, :2] - after[0, :2] - nodes[-1]),
                    after[1, 2] + physics.rotation_offset[1] - theta[-1],
                    slipped / self.config.cable.length - state.stretch,
                ]
            )
            / dt
        )
        yielding = jnp.stack(
            [
                physics.rotation_compliance[0],
                jnp.zeros((), dtype),
                jnp.zeros((), dtype),
                physics.rotation_compliance[1],
                physics.axial_compliance / self.config.cable.length,
            ]
        )
        solved = _solve_lower(matrix, jnp.concatenate([rhs[:, None], rows.T], axis=1))
        dual = rows @ solved[:, 1:] + jnp.diag(yielding) / dt**2
        size = jnp.sqrt(jnp.diagonal(dual))
        scaled = dual / (size[:, None] * size) + _REGULARISATION * jnp.eye(5, dtype=dtype)
        multiplier = solve_positive(scaled, ((wanted - rows @ solved[:, 0]) / size)[:, None])[:, 0] / size
        speeds = solved[:, 0] + solved[:, 1:] @ multiplier

        # Memory of the joints.
        angles = state.angles + dt * speeds[:-1]
        change = angles[1:] / h - curvature
        sign = jnp.where(change < 0, -1.0, 1.0)
        rubbed = sign + (state.friction_state - sign) * jnp.exp(-jnp.abs(change) / physics.hysteresis_curvature)
        # Return mapping of plasticity with linear kinematic hardening (Simo and Hughes 1998, 1.5).
        driven = angles[1:] / h - physics.rest_curvature - (1.0 + physics.hardening) * state.set_curvature
        beyond = driven - jnp.clip(driven, -physics.yield_curvature, physics.yield_curvature)
        return ChainState(
            angles=angles,
            stretch=state.stretch + dt * speeds[-1],
            velocity=speeds,
            set_curvature=state.set_curvature + beyond / (1.0 + physics.hardening),
            friction_state=rubbed,
            root_velocity=root_velocity,
        )

    def _contact(
        self, physics: Physics, nodes: Float[Array, "n 2"], slope: Float[Array, "n 2"]
    ) -> tuple[Float[Array, "n 2"], Float[Array, "n 3"]]:
        """Forces of the obstacle on the nodes [N] and their stiffness (xx, xy, yy) [N/m].

        The obstacle is narrower than a link is long, so the cable touches it by points between the nodes too, on the
        cubic through nodes and tangents; what acts on them is shared by the two nodes next to them.

        Args:
            physics: with the obstacle.
            nodes: positions [m].
            slope: derivative of the position over one link length [m].
        """
        force, stiffness = jnp.zeros_like(nodes), jnp.zeros((nodes.shape[0], 3), nodes.dtype)
        if not self.with_contact:
            return force, stiffness
        a, b, da, db = nodes[:-1], nodes[1:], slope[:-1], slope[1:]
        for i in range(_CONTACT_POINTS):
            t = i / _CONTACT_POINTS
            point = (1 - 3 * t**2 + 2 * t**3) * a + (3 * t**2 - 2 * t**3) * b
            point = point + (t - 2 * t**2 + t**3) * da + (t**3 - t**2) * db
            away = point - physics.obstacle_centre
            distance = _length(away)
            normal = away / distance[:, None]
            depth = physics.obstacle_radius - distance
            # a smooth ramp: nothing at all half a millimetre off
            overlap = jnp.clip(depth + _CONTACT_EDGE, 0.0)
            pressing = jnp.where(depth < _CONTACT_EDGE, overlap**2 / (4 * _CONTACT_EDGE), depth)
            rigidity = _CONTACT_STIFFNESS / _CONTACT_POINTS * jnp.clip(overlap / (2 * _CONTACT_EDGE), 0.0, 1.0)
            push = (_CONTACT_STIFFNESS / _CONTACT_POINTS * pressing)[:, None] * normal
            tensor = rigidity[:, None] * jnp.stack(
                [normal[:, 0] ** 2, normal[:, 0] * normal[:, 1], normal[:, 1] ** 2], axis=1
            )
            for end, share in ((slice(None, -1), 1 - t), (slice(1, None), t)):
                force = force.at[end].add(share * push)
                stiffness = stiffness.at[end].add(share * tensor)
        return force, stiffness

    def _keypoints(self, physics: Physics, state: ChainState, root, time) -> Float[Array, "N 2"]:
        """Points of the centreline where the keypoints are, by cubic Hermite interpolation between the nodes."""
        config, dtype = self.config, state.angles.dtype
        theta = jnp.cumsum(state.angles)
        unit = jnp.stack([jnp.cos(theta), jnp.sin(theta)], axis=1)
        along = (1.0 + state.stretch) * unit
        lengths, offsets = (jnp.asarray(f(config), dtype) for f in (link_lengths, node_offsets))
        nodes = root + _chained(lengths[:, None] * along) + offsets[:, None] * along
        # Keypoints are marks on the cable: where it slips through a gripper, they move away from that gripper.
        slipped = physics.slip * jax.nn.sigmoid((time - physics.slip_time) / SLIP_DURATION)
        marks = jnp.asarray(config.cable.keypoint_arclength, dtype) + physics.bias_along
        inner = (marks + slipped[0]) / (config.cable.length + jnp.sum(slipped))
        ends = np.zeros(config.cable.n_keypoints, bool)
        ends[[0, -1]] = True
        nominal = marks / config.cable.length
        s = jnp.clip(jnp.where(ends, nominal, inner), 0.0, 1.0) * (config.n_links - 1)
        segment = jnp.clip(jnp.floor(jax.lax.stop_gradient(s) + 1e-4).astype(int), 0, config.n_links - 2)
        t = (s - segment)[:, None]
        h = config.link_length
        a, b = nodes[segment], nodes[segment + 1]
        da, db = h * along[segment], h * along[segment + 1]
        points = (1 - 3 * t**2 + 2 * t**3) * a + (3 * t**2 - 2 * t**3) * b
        points = points + (t - 2 * t**2 + t**3) * da + (t**3 - t**2) * db
        tangent = (1 - t) * unit[segment] + t * unit[segment + 1]
        return points + physics.bias_across[:, None] * _turned(tangent)


def seen_by_camera(
    physics: Physics, keypoints: Float[Array, "T N 2"], interval: Float[Array, ""]
) -> Float[Array, "T N 2"]:
    """Keypoints as the camera reports them: late, then scaled, turned and moved. Differentiable in both arguments."""
    n = keypoints.shape[0]
    back = jnp.clip(jnp.arange(n) - physics.camera_lag / interval, 0.0, n - 1.0)
    before = jnp.clip(jnp.floor(back).astype(int), 0, n - 2)
    t = (back - before)[:, None, None]
    late = (1 - t) * keypoints[before] + t * keypoints[before + 1]
    cosine, sine = jnp.cos(physics.camera_angle), jnp.sin(physics.camera_angle)
    x, y = late[..., 0], late[..., 1]
    turned = jnp.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
    return jnp.asarray(physics.camera_scale * turned + physics.camera_offset)


def _chained(steps: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
    """Where each link begins if link k leads on by `steps[k]`."""
    return jnp.concatenate([jnp.zeros((1, 2), steps.dtype), jnp.cumsum(steps[:-1], axis=0)])


def _beyond(x: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Sums over this link and all that follow."""
    return jnp.cumsum(x[::-1], axis=0)[::-1]


def _turned(x: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
    """A quarter turn to the left."""
    return jnp.stack([-x[..., 1], x[..., 0]], axis=-1)


def _cross(a: Float[Array, "n 2"], b: Float[Array, "n 2"]) -> Float[Array, "n"]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _length(x: Float[Array, "n 2"]) -> Float[Array, "n"]:
    """Euclidean norm with a derivative at zero."""
    return jnp.sqrt(jnp.sum(x**2, axis=-1) + 1e-12)


def _solve_lower(matrix: Float[Array, "n n"], rhs: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Solves a positive definite system given by its lower triangle."""
    lower = jnp.tril(matrix)
    symmetric = lower + jnp.tril(matrix, -1).T
    factor = jax.lax.linalg.cholesky(jax.lax.stop_gradient(symmetric), symmetrize_input=False)

    def solve(_, b):
        half = jax.lax.linalg.triangular_solve(factor, b, left_side=True, lower=True)
        return jax.lax.linalg.triangular_solve(factor, half, left_side=True, lower=True, transpose_a=True)

    return jax.lax.custom_linear_solve(lambda x: symmetric @ x, rhs, solve, symmetric=True)
