"""The differentiable engine: the chain's kinematics and inertia by MJX, its grasps in closed form."""

from __future__ import annotations

import dataclasses
import functools
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from cablejax.arrays import quaternion_product
from cablejax.cable import Discretisation
from cablejax.effects.arms import executed_twist
from cablejax.effects.base import Hook
from cablejax.effects.camera import seen_by_camera
from cablejax.effects.physics import Physics, may_touch, nominal_physics, normal_gravity
from cablejax.simulate.compile import full_precision
from cablejax.simulate.composite import build_chain, stable_damping_time
from cablejax.simulate.contact import obstacle_contact
from cablejax.simulate.engine import Engine, finely_sampled, rolled_out
from cablejax.simulate.friction import drag_coefficient, implicit_drag, on_table
from cablejax.simulate.grasp import constrained_acceleration
from cablejax.simulate.keypoints import hermite_weights, marked_keypoints
from cablejax.simulate.kinematics import chain_kinematics
from cablejax.simulate.mjx import mjx
from cablejax.simulate.pose import integrate_pose, pose_velocity, quaternion_of
from cablejax.types import CableState, Trajectory


@dataclasses.dataclass(frozen=True)
class MjxEngine(Engine):
    """A cable in MJX: vmapped, jitted, differentiable in forward and reverse mode.

    `rollout` is the entry for whole batches and compiles itself. `unroll` is the same for one cable as a pure function,
    to be composed with `jax.grad`, `jax.vmap` and `jax.jit`. On CPU pass `cablejax.simulate.compiler_options()` to the
    outermost `jax.jit`.

    Attributes:
        config: the cable, its resolution and time step.
    """

    config: Discretisation = Discretisation()

    name: ClassVar[str] = "mjx"
    hooks: ClassVar[frozenset[Hook]] = frozenset(
        ("bending", "table", "mass", "grasp", "compliance", "input", "observation", "obstacle")
    )

    @functools.cached_property
    def mj_model(self) -> mujoco.MjModel:
        """The MuJoCo model of the bare chain."""
        return build_chain(self.config)

    @full_precision
    def keypoints(self, state: CableState) -> Float[Array, "N D"]:
        """Keypoints of one cable [m]. Differentiable in `state.qpos`."""
        model = mjx.put_model(self.mj_model)
        data = chain_kinematics(self.config, mjx.make_data(model).replace(qpos=state.qpos))
        return self._observe(data, nominal_physics(self.config))

    def rollout(self, physics, state, twist, interval=1.0):
        """See `Engine`. Compiles on the first call for a shape and interval."""
        twist = jnp.asarray(twist)
        self.check_twist(twist)
        return finely_sampled(functools.partial(rolled_out, self), self, physics, state, twist, interval)

    @full_precision
    def unroll(
        self, physics: Physics, state: CableState, twist: Float[Array, "T Q V"], interval: float = 1.0
    ) -> tuple[CableState, Trajectory]:
        """`rollout` of one cable, uncompiled. Differentiable in `physics`, `state` and `twist`."""
        count, planar, contact = self.substeps(interval), self.config.dimension == 2, may_touch(physics)
        model = self._with_physics(mjx.put_model(self.mj_model), physics)
        template = mjx.make_data(model)

        def interval_step(state: CableState, twist):
            start = state.gripper_pose

            def substep(carry, i):
                qpos, qvel = carry
                target = integrate_pose(start, twist, (i + 1) * self.config.timestep)
                return self._step(model, template, physics, qpos, qvel, target, contact), None

            # Remember the start of each interval only: reverse mode recomputes the inside.
            (qpos, qvel), _ = jax.lax.scan(substep, (state.qpos, state.qvel), jnp.arange(count))
            state = CableState(qpos=qpos, qvel=qvel, gripper_pose=integrate_pose(start, twist, interval))
            return state, (qpos, state.gripper_pose)

        driven = executed_twist(physics, state.gripper_pose, twist, interval) if planar else twist
        state = CableState(qpos=state.qpos, qvel=state.qvel, gripper_pose=state.gripper_pose)
        final, (qpos, poses) = jax.lax.scan(jax.checkpoint(interval_step), state, driven)
        qpos = jnp.concatenate([state.qpos[None], qpos])
        keypoints = jax.vmap(lambda q: self._observe(chain_kinematics(self.config, template.replace(qpos=q)), physics))(
            qpos
        )
        trajectory = Trajectory(
            keypoints=seen_by_camera(physics, keypoints, interval) if planar else keypoints,
            gripper_pose=jnp.concatenate([state.gripper_pose[None], poses]),
            gripper_twist=twist,
        )
        return final, trajectory

    def _with_physics(self, model: mjx.Model, physics: Physics) -> mjx.Model:
        """The model with every differentiable parameter put in."""
        h = self.config.link_length
        stiffness = physics.stiffness / h
        damping = stable_damping_time(jnp.asarray(physics.damping_time), self.config.timestep) * stiffness
        density_ratio = physics.density / self.config.cable.linear_density
        mass, gravity = model.body_mass * density_ratio, model.opt.gravity
        if self.config.dimension == 2:
            mass = mass.at[1:].add(physics.extra_mass)
            gravity = jnp.append(jnp.asarray(physics.tilt), -normal_gravity(physics))
            zeros = jnp.zeros(3, stiffness.dtype)
            springref = jnp.concatenate([zeros, physics.rest_curvature * h])
            jnt_stiffness = jnp.concatenate([zeros, stiffness])
            dof_damping = jnp.concatenate([zeros, damping])
        else:
            rest = quaternion_of(jnp.asarray(physics.rest_curvature * h))
            springref = jnp.concatenate([model.qpos_spring[:7], rest.reshape(-1)])
            jnt_stiffness = jnp.concatenate([jnp.zeros(1, stiffness.dtype), stiffness])
            dof_damping = jnp.concatenate([jnp.zeros(6, damping.dtype), jnp.repeat(damping, 3)])
        return model.replace(
            jnt_stiffness=jnt_stiffness,
            dof_damping=dof_damping,
            qpos_spring=springref,
            body_mass=mass,
            body_inertia=model.body_inertia * density_ratio,
            opt=model.opt.replace(gravity=gravity),
        )

    def _step(self, model, template, physics, qpos, qvel, target, contact):
        """One linearly implicit Euler step that ends with the grippers at `target`."""
        dt = self.config.timestep
        planar = self.config.dimension == 2
        data = chain_kinematics(self.config, template.replace(qpos=qpos, qvel=qvel))
        data = mjx.com_vel(model, mjx.crb(model, mjx.com_pos(model, data)))
        data = mjx.rne(model, mjx.passive(model, data))
        jacobian, rotation = self._node_jacobians(model, data)

        inertia = mjx.full_m(model, data) + dt * jnp.diag(model.dof_damping)
        force = data.qfrc_passive - data.qfrc_bias
        if planar:
            damping, table_force = self._table(data, physics, jacobian[1:-1, :, :2], qvel)
            inertia, force = inertia + dt * damping, force + table_force
            if contact:
                stiffness, push = self._obstacle(data, physics, jacobian[:, :, :2], qvel)
                inertia, force = inertia + dt**2 * stiffness, force + push

        held = jnp.array([0, -1])
        linear, angular = jacobian[held], rotation[held]
        if planar:
            rows = jnp.concatenate([linear[:, :, :2], angular[:, :, 2:]], axis=2)
            target = target.at[:, 2].add(physics.rotation_offset)
            yielding = jnp.zeros_like(target).at[:, 2].set(physics.rotation_compliance).reshape(-1)
        else:
            rows, yielding = jnp.concatenate([linear, angular], axis=2), 0.0
        rows = rows.transpose(0, 2, 1).reshape(-1, qvel.shape[0])
        wanted = pose_velocity(self._held_pose(data), target, dt).reshape(-1)
        qacc = constrained_acceleration(inertia, force, rows, (wanted - rows @ qvel) / dt, yielding / dt**2)
        qvel = qvel + dt * qacc
        return self._integrate(qpos, qvel, dt), qvel

    def _table(self, data, physics, jacobian, qvel):
        """Velocity derivative and generalised force of the table on the free links."""
        config = self.config
        velocity = jnp.einsum("kid,i->kd", jacobian, qvel)
        h = config.link_length
        mass = on_table(physics, physics.density * h + physics.extra_mass, h)[1:-1]
        drag = drag_coefficient(physics, data.xipos[2:-1, :2], velocity, mass, h, config.friction_speed)
        return implicit_drag(jacobian, drag, velocity)

    def _obstacle(self, data, physics, jacobian, qvel):
        """Generalised stiffness of the obstacle's contacts, and their force after a step at the present velocity."""
        force, k = obstacle_contact(physics, data.xipos[1:, :2], self.config.link_length * data.xmat[1:, :2, 0])
        tensor = jnp.stack([jnp.stack([k[:, 0], k[:, 1]], axis=1), jnp.stack([k[:, 1], k[:, 2]], axis=1)], axis=1)
        stiffness = jnp.einsum("kid,kde,kje->ij", jacobian, tensor, jacobian)
        push = jnp.einsum("kid,kd->i", jacobian, force)
        return stiffness, push - self.config.timestep * stiffness @ qvel

    def _node_jacobians(self, model, data) -> tuple[Float[Array, "n nv 3"], Float[Array, "n nv 3"]]:
        """Jacobians of every node's position and every link's orientation, in the world's frame."""
        nodes = data.xipos[1:]
        # a joint moves all links beyond it; the tree is a chain, so the mask is a staircase known before tracing
        mask = jnp.asarray(np.asarray(model.dof_bodyid)[None] <= np.arange(1, nodes.shape[0] + 1)[:, None], nodes.dtype)
        angular, linear = data.cdof[:, :3], data.cdof[:, 3:]
        offset = nodes - data.subtree_com[1]
        jacobian = linear[None] + jnp.cross(angular[None], offset[:, None])
        return jacobian * mask[..., None], angular[None] * mask[..., None]

    def _held_pose(self, data) -> Float[Array, "Q P"]:
        """Poses of the grasped ends: (x, y, theta) or (position, quaternion)."""
        ends = data.xipos[jnp.array([1, -1])]
        if self.config.dimension == 3:
            return jnp.concatenate([ends, data.xquat[jnp.array([1, -1])]], axis=1)
        # the sum of the hinge angles, not an arctangent: theta is not wrapped
        theta = jnp.stack([data.qpos[2], jnp.sum(data.qpos[2:])])
        return jnp.concatenate([ends[:, :2], theta[:, None]], axis=1)

    def _integrate(self, qpos, qvel, dt):
        if self.config.dimension == 2:
            return qpos + dt * qvel
        position = qpos[:3] + dt * qvel[:3]
        quaternions = jnp.concatenate([qpos[3:7][None], qpos[7:].reshape(-1, 4)])
        # angular velocities of joints are in the child's own frame, hence the product from the right
        turned = quaternion_product(quaternions, quaternion_of(dt * qvel[3:].reshape(-1, 3)))
        return jnp.concatenate([position, turned.reshape(-1)])

    def _observe(self, data, physics) -> Float[Array, "N D"]:
        dimension = self.config.dimension
        nodes = data.xipos[1:, :dimension]
        tangents = data.xmat[1:, :dimension, 0]
        if dimension == 2:
            return marked_keypoints(self.config, physics, nodes, tangents)
        positions_w, tangents_w = hermite_weights(self.config)
        return jnp.asarray(positions_w, nodes.dtype) @ nodes + jnp.asarray(tangents_w, nodes.dtype) @ tangents
