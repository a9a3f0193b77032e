"""The loop over time steps of C MuJoCo, compiled by numba: it calls MuJoCo's C functions without Python in between.

Compiled code is kept on disk as long as this file stays as it is, so that nothing here may depend on another file's
constants: they are arguments.
"""

from __future__ import annotations

import pathlib

import llvmlite.binding
import mujoco
import numpy as np
from numba.core import types

from cablejax.compiled_programs import kept_on_disk

# The very library that the Python bindings have loaded: from here on its functions are found by their names.
llvmlite.binding.load_library_permanently(
    str(
        next(
            path
            for path in sorted(pathlib.Path(mujoco.__file__).parent.iterdir())
            if path.name.startswith(("libmujoco.", "mujoco.dll"))
        )
    )
)
# `void f(const mjModel*, mjData*)`, by their names, so that numba can keep what it compiled on disk
_step1, _step2, _kinematics = (
    types.ExternalFunction(name, types.void(types.uint64, types.uint64))
    for name in ("mj_step1", "mj_step2", "mj_kinematics")
)


@kept_on_disk
def advance(
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
    nodes,
    tangents,
    poses,
):
    """All time steps of one cable. `pose` [Q, P] is advanced in place; samples go to nodes, tangents and poses."""
    model, data = addresses[0], addresses[1]
    n_free = actuator_velocity.shape[0] // 2
    uneven = table[1] != 0.0 or table[5] != 0.0
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
                squared = vx * vx + vy * vy
                coefficient = table[0]
                if uneven:
                    link = links[k + 1]
                    coefficient = friction_there(table, xipos[link, 0], xipos[link, 1], squared)
                drag = coefficient * table[10 + k] / np.sqrt(squared + table[7] * table[7]) + table[6]
                actuator_biasprm[2 * k, 2] = -drag
                actuator_biasprm[2 * k + 1, 2] = -drag
            _step2(model, data)
        _sample(model, data, xipos, xmat, links, nodes[t + 1], tangents[t + 1])
        poses[t + 1] = pose


@kept_on_disk
def friction_there(table, x, y, squared_speed):
    """Coefficient of friction at one place and speed, see `friction.drag_coefficient`."""
    distance = np.sqrt((x - table[2]) ** 2 + (y - table[3]) ** 2)
    coefficient = table[0] + table[5] / (1.0 + np.exp(-(table[4] - distance) / table[8]))
    return coefficient * (1.0 + table[1] * np.exp(-squared_speed / table[9] ** 2))


@kept_on_disk
def _sample(model, data, xipos, xmat, links, nodes, tangents):
    _kinematics(model, data)
    for k in range(links.shape[0]):
        for axis in range(3):
            nodes[k, axis] = xipos[links[k], axis]
            tangents[k, axis] = xmat[links[k], 3 * axis]


@kept_on_disk
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


@kept_on_disk
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
