"""The engine for data on CPU: C MuJoCo in threads, one cable per thread, without Python inside the loop."""

from __future__ import annotations

import concurrent.futures
import copy
import ctypes
import dataclasses
import functools
import os
import pathlib
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numba
import numpy as np

from cablejax.cable import Discretisation
from cablejax.effects.arms import executed_twist
from cablejax.effects.base import Hook
from cablejax.effects.camera import seen_by_camera
from cablejax.effects.physics import Physics
from cablejax.simulate.composite import build_grasped_chain
from cablejax.simulate.engine import Engine, finely_sampled
from cablejax.simulate.equilibrium import equilibrium_state
from cablejax.simulate.friction import PATCH_EDGE, STRIBECK_SPEED
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
    hooks: ClassVar[frozenset[Hook]] = frozenset(
        ("bending", "table", "mass", "grasp", "input", "observation", "obstacle")
    )

    @functools.cached_property
    def mj_model(self) -> mujoco.MjModel:
        """The MuJoCo model: the chain welded to two mocap bodies."""
        return build_grasped_chain(self.config)

    def initial_state(self, gripper_pose, *, guess=None) -> CableState:
        return equilibrium_state(self.config, gripper_pose, guess=guess)

    def rollout(self, physics, state, twist, interval=1.0):
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
        workers = max(min(self.n_threads or os.cpu_count() or 1, size), 1)

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
        self.bare = self.model = copy.copy(model)
        self.data = mujoco.MjData(self.model)
        self.nominal_mass = self.model.body_mass.copy()
        self.nominal_inertia = self.model.body_inertia.copy()
        self.links = np.array([i for i in range(self.model.nbody) if self.model.body(i).name.startswith("cable")])

    def run(self, physics: Physics, state: CableState, twist, count: int, interval: float, keypoints, poses) -> None:
        """Simulates in place; writes samples into `keypoints` [T + 1, N, D] and `poses` [T + 1, Q, P]."""
        config, planar = self.config, self.config.dimension == 2
        if planar:
            self._place_obstacle(physics)
            twist = executed_twist(physics, state.gripper_pose, twist, interval)
        model, data = self.model, self.data
        self._write(physics)
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = state.qpos, state.qvel
        addresses = np.array([model._address, data._address], np.uint64)
        nodes = np.empty((len(twist) + 1, len(self.links), 3))
        tangents = np.empty_like(nodes)
        _advance(
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
            config.friction_speed,
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

    def _place_obstacle(self, physics: Physics) -> None:
        """Takes the model with this obstacle, which C MuJoCo must know when it builds its collision trees."""
        radius = float(physics.obstacle_radius)
        model = self.bare if radius == 0 else _model_with(self.config, (*map(float, physics.obstacle_centre), radius))
        if (radius > 0) == (self.model is self.bare) or radius > 0:
            self.model = model if radius == 0 else copy.copy(model)
            self.data = mujoco.MjData(self.model)

    def _table(self, physics: Physics) -> np.ndarray:
        """Arguments of `_drag`: seven values for the whole table, then the weight of each free node [N], shape [7 + n]."""
        h = self.config.link_length
        if self.config.dimension == 3:
            return np.zeros(7)
        normal = np.sqrt(max(float(physics.gravity) ** 2 - float(np.sum(physics.tilt**2)), 0.0))
        weight = (float(physics.density) * h + np.asarray(physics.extra_mass)[1:-1]) * normal
        whole = (physics.friction, physics.static_excess, *physics.patch_centre, physics.patch_radius)
        return np.array([*map(float, whole), float(physics.patch_friction), float(physics.drag) * h, *weight])

    def _write(self, physics: Physics) -> None:
        """Puts the parameters into the model."""
        model, h = self.model, self.config.link_length
        stiffness = np.asarray(physics.stiffness) / h
        damping = float(physics.damping_time) * stiffness
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
            normal = np.sqrt(max(float(physics.gravity) ** 2 - float(np.sum(physics.tilt**2)), 0.0))
            model.opt.gravity[:] = [*physics.tilt, -normal]


@functools.lru_cache(maxsize=64)
def _model_with(config: Discretisation, obstacle: tuple[float, float, float]) -> mujoco.MjModel:
    return build_grasped_chain(config, obstacle)


def _c_function(name: str):
    """A C function `void f(const mjModel*, mjData*)` of the very library that the Python bindings have loaded."""
    folder = pathlib.Path(mujoco.__file__).parent
    library = next(path for path in sorted(folder.iterdir()) if path.name.startswith(("libmujoco.", "mujoco.dll")))
    function = getattr(ctypes.CDLL(str(library)), name)
    function.argtypes, function.restype = (ctypes.c_void_p, ctypes.c_void_p), None
    return function


_step1, _step2, _kinematics = (_c_function(name) for name in ("mj_step1", "mj_step2", "mj_kinematics"))


@numba.njit(nogil=True, cache=False)
def _advance(
    addresses,
    mocap_pos,
    mocap_quat,
    actuator_velocity,
    actuator_biasprm,
    xipos,
    xmat,
    links,
    pose,
    rotation_offset,
    twist,
    count,
    dt,
    table,
    friction_speed,
    nodes,
    tangents,
    poses,
):
    """All time steps of one cable. `pose` [Q, P] is advanced in place; samples go to nodes, tangents and poses."""
    model, data = addresses[0], addresses[1]
    n_free = actuator_velocity.shape[0] // 2
    _sample(model, data, xipos, xmat, links, nodes[0], tangents[0])
    poses[0] = pose
    for t in range(twist.shape[0]):
        start = pose.copy()
        for i in range(count):
            _integrate(start, twist[t], (i + 1) * dt, pose)
            _set_mocap(pose, rotation_offset, mocap_pos, mocap_quat)
            _step1(model, data)
            for k in range(n_free):
                vx, vy = actuator_velocity[2 * k], actuator_velocity[2 * k + 1]
                node = xipos[links[k + 1]]
                drag = _drag(table, table[7 + k], node[0], node[1], vx * vx + vy * vy, friction_speed)
                actuator_biasprm[2 * k, 2] = -drag
                actuator_biasprm[2 * k + 1, 2] = -drag
            _step2(model, data)
        _sample(model, data, xipos, xmat, links, nodes[t + 1], tangents[t + 1])
        poses[t + 1] = pose


@numba.njit(nogil=True, cache=False)
def _drag(table, weight, x, y, squared_speed, friction_speed):
    """`friction.drag_coefficient` of one node."""
    coefficient = table[0]
    if table[5] != 0.0:
        distance = np.sqrt((x - table[2]) ** 2 + (y - table[3]) ** 2)
        coefficient += table[5] / (1.0 + np.exp(-(table[4] - distance) / PATCH_EDGE))
    if table[1] != 0.0:
        coefficient *= 1.0 + table[1] * np.exp(-squared_speed / STRIBECK_SPEED**2)
    return coefficient * weight / np.sqrt(squared_speed + friction_speed * friction_speed) + table[6]


@numba.njit(nogil=True, cache=False)
def _sample(model, data, xipos, xmat, links, nodes, tangents):
    _kinematics(model, data)
    for k in range(links.shape[0]):
        for axis in range(3):
            nodes[k, axis] = xipos[links[k], axis]
            tangents[k, axis] = xmat[links[k], 3 * axis]


@numba.njit(nogil=True, cache=False)
def _integrate(start, twist, duration, pose):
    """`pose.integrate_pose` in place."""
    if start.shape[1] == 3:
        pose[:] = start + duration * twist
        return
    for q in range(start.shape[0]):
        pose[q, :3] = start[q, :3] + duration * twist[q, :3]
        rotation = duration * twist[q, 3:]
        angle = np.sqrt(np.sum(rotation**2))
        w, sinc = np.cos(angle / 2), (np.sin(angle / 2) / angle if angle > 0 else 0.5)
        x, y, z = sinc * rotation[0], sinc * rotation[1], sinc * rotation[2]
        a, b, c, d = start[q, 3], start[q, 4], start[q, 5], start[q, 6]
        pose[q, 3] = w * a - x * b - y * c - z * d
        pose[q, 4] = w * b + x * a + y * d - z * c
        pose[q, 5] = w * c - x * d + y * a + z * b
        pose[q, 6] = w * d + x * c - y * b + z * a


@numba.njit(nogil=True, cache=False)
def _set_mocap(pose, rotation_offset, mocap_pos, mocap_quat):
    for q in range(pose.shape[0]):
        if pose.shape[1] == 3:
            half = (pose[q, 2] + rotation_offset[q]) / 2
            mocap_pos[q, 0], mocap_pos[q, 1], mocap_pos[q, 2] = pose[q, 0], pose[q, 1], 0.0
            mocap_quat[q, 0], mocap_quat[q, 1] = np.cos(half), 0.0
            mocap_quat[q, 2], mocap_quat[q, 3] = 0.0, np.sin(half)
        else:
            mocap_pos[q] = pose[q, :3]
            mocap_quat[q] = pose[q, 3:]
