"""The engine for data on CPU: C MuJoCo in threads, one cable per thread, without Python inside the loop."""

from __future__ import annotations

import concurrent.futures
import copy
import dataclasses
import functools
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from cablejax.cable import Discretisation
from cablejax.cores import available_cores
from cablejax.effects.arms import executed_twist, follows_exactly
from cablejax.effects.base import Hook
from cablejax.effects.camera import seen_by_camera
from cablejax.effects.physics import Physics, normal_gravity
from cablejax.simulate.compiled_steps import advance
from cablejax.simulate.composite import build_grasped_chain, link_bodies, stable_damping_time
from cablejax.simulate.engine import Engine, finely_sampled
from cablejax.simulate.friction import PATCH_EDGE, STRIBECK_SPEED, on_table
from cablejax.simulate.keypoints import hermite_weights, marked_keypoints
from cablejax.types import CableState, Trajectory


@dataclasses.dataclass(frozen=True)
class ThreadedEngine(Engine):
    """C MuJoCo stepped by `mj_step1` and `mj_step2`, its grasps by MuJoCo's own constraint solver. Not differentiable.

    The loop over time steps is compiled by numba and calls MuJoCo's C functions directly: friction depends on the
    velocity, which `mujoco.rollout` cannot feed back, and a Python callback would hold the interpreter's lock.

    Attributes:
        config: the cable, its resolution and time step.
        n_threads: threads to use; None = one per core.
    """

    config: Discretisation = Discretisation()
    n_threads: int | None = None

    name: ClassVar[str] = "threaded"
    hooks: ClassVar[frozenset[Hook]] = frozenset(("bending", "table", "mass", "grasp", "input", "observation"))

    @functools.cached_property
    def mj_model(self) -> mujoco.MjModel:
        """The MuJoCo model: the chain welded to two mocap bodies."""
        return build_grasped_chain(self.config)

    def rollout(self, physics, state, twist, interval=1.0):
        """See `Engine`. Runs one cable per thread; not differentiable."""
        twist = np.asarray(twist, np.float64)
        self.check_twist(twist)
        return finely_sampled(self._run, self, physics, state, twist, interval)

    def _run(self, physics, state, twist, interval):
        count = self.substeps(interval)
        batch = twist.shape[:-3]
        size = int(np.prod(batch))

        def flatten(leaf):
            return np.asarray(leaf, np.float64).reshape(size, *np.shape(leaf)[len(batch) :])

        def restore(leaf):
            return jnp.asarray(leaf.reshape(*batch, *leaf.shape[1:]), float)

        state = CableState(state.qpos, state.qvel, state.gripper_pose)
        physics, state, commands = jax.tree.map(flatten, (physics, state, twist))
        samples = twist.shape[-3] + 1
        keypoints = np.empty((size, samples, self.config.cable.n_keypoints, self.config.dimension))
        poses = np.empty((size, samples, *state.gripper_pose.shape[1:]))
        qpos, qvel = np.empty_like(state.qpos), np.empty_like(state.qvel)
        workers = max(min(self.n_threads or available_cores(), size), 1)

        def run(worker: int) -> None:
            simulation = _Simulation(self.config, self.mj_model)
            for i in range(worker, size, workers):
                one, start = jax.tree.map(lambda leaf: leaf[i], (physics, state))  # noqa: B023, used at once
                simulation.run(one, start, commands[i], count, interval, keypoints[i], poses[i])
                qpos[i], qvel[i] = simulation.data.qpos, simulation.data.qvel

        if workers == 1:
            run(0)
        else:
            with concurrent.futures.ThreadPoolExecutor(workers) as pool:
                list(pool.map(run, range(workers)))
        final = CableState(restore(qpos), restore(qvel), restore(poses[:, -1]))
        return final, Trajectory(restore(keypoints), restore(poses), restore(commands))


class _Simulation:
    """One thread's own model and data: parameters are written into the model."""

    def __init__(self, config: Discretisation, model: mujoco.MjModel):
        self.config = config
        self.model = copy.copy(model)
        self.data = mujoco.MjData(self.model)
        self.nominal_mass = self.model.body_mass.copy()
        self.nominal_inertia = self.model.body_inertia.copy()
        self.links = link_bodies(self.model)

    def run(self, physics: Physics, state: CableState, twist, count: int, interval: float, keypoints, poses) -> None:
        """Simulates in place; writes samples into `keypoints` [T + 1, N, D] and `poses` [T + 1, Q, P]."""
        config, planar = self.config, self.config.dimension == 2
        if planar and not follows_exactly(physics):
            twist = executed_twist(physics, state.gripper_pose, twist, interval)
        model, data = self.model, self.data
        self._write(physics)
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = state.qpos, state.qvel
        addresses = np.array([model._address, data._address], np.uint64)
        nodes = np.empty((len(twist) + 1, len(self.links), 3))
        tangents = np.empty_like(nodes)
        advance(
            addresses,
            data.mocap_pos,
            data.mocap_quat,
            data.actuator_velocity,
            model.actuator_biasprm,
            data.xipos,
            data.xmat,
            self.links,
            np.array(state.gripper_pose),
            np.asarray(physics.rotation_offset),
            twist,
            count,
            config.timestep,
            self._table(physics),
            nodes,
            tangents,
            poses,
        )
        if planar:
            points = marked_keypoints(config, physics, nodes[..., :2], tangents[..., :2])
            keypoints[:] = seen_by_camera(physics, points, interval)
        else:
            positions_w, tangents_w = hermite_weights(config)
            keypoints[:] = positions_w @ nodes + tangents_w @ tangents

    def _table(self, physics: Physics) -> np.ndarray:
        """The table of `compiled_steps.advance`: ten values, then the weight of each free node [N]."""
        h = self.config.link_length
        if self.config.dimension == 3:
            return np.zeros(10)
        mass = on_table(physics, float(physics.density) * h + np.asarray(physics.extra_mass), h)[1:-1]
        friction = (physics.friction, physics.static_excess, *physics.patch_centre, physics.patch_radius)
        widths = (self.config.friction_speed, PATCH_EDGE, STRIBECK_SPEED)
        whole = [*map(float, friction), float(physics.patch_friction), float(physics.drag) * h, *widths]
        return np.array([*whole, *(mass * normal_gravity(physics))])

    def _write(self, physics: Physics) -> None:
        """Puts the parameters into the model."""
        model, h = self.model, self.config.link_length
        stiffness = np.asarray(physics.stiffness) / h
        damping = stable_damping_time(np.float64(physics.damping_time), self.config.timestep) * stiffness
        rest = np.asarray(physics.rest_curvature) * h
        if self.config.dimension == 2:
            model.jnt_stiffness[3:] = stiffness
            model.dof_damping[3:] = damping
            model.qpos_spring[3:] = rest
        else:
            model.jnt_stiffness[1:] = stiffness
            model.dof_damping[6:] = np.repeat(damping, 3)
            quaternion = model.qpos_spring[7:].reshape(-1, 4)
            for i, rotation in enumerate(rest):
                angle = np.linalg.norm(rotation)
                mujoco.mju_axisAngle2Quat(quaternion[i], rotation / angle if angle > 0 else np.eye(3)[0], angle)
        free = self.links[1:-1]
        ratio = float(physics.density) / self.config.cable.linear_density
        model.body_mass[free] = self.nominal_mass[free] * ratio
        model.body_inertia[free] = self.nominal_inertia[free] * ratio
        if self.config.dimension == 2:
            model.body_mass[free] += physics.extra_mass[1:-1]
            model.opt.gravity[:] = [*physics.tilt, -normal_gravity(physics)]
