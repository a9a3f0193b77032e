"""Families B and D: a Cosserat rod of PyElastica on a table, with laws of its own for a part of the effects.

PyElastica's compiled kernels give the internal forces of a rod that stretches, shears and bends; this file's compiled
loop adds the table (Stribeck friction as an impulse that takes away speed, at most all of it), the grippers, an
implicit bending damper and what is unmodelled. The two end elements are held and half as long as the others, so that
the middles of the elements are evenly spread along the cable. A log of 6 episodes costs about seven seconds of one
core.

In family B the rod lies in the table's plane, and every point presses on it with its own weight. In family D the
grippers hold the ends `RAISED` above where the cable lies: it sags, they carry a part of the weight, and it moves in
space. The table stops whatever would go through it within a time step (an inelastic impulse), and friction takes away
speed up to the coefficient times that impulse: Coulomb's law without any regularisation.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from elastica.rod.cosserat_rod import CosseratRod, _update_accelerations
from elastica.rod.data_structures import overload_operator_kinematic_numba

from closed_loop.rod_loop import arrays, hold, internal_loads, lay, straight_rod

from .rod import Motion, arch
from .world import GRAVITY, World, bump

ELEMENTS = 26
AXIAL_RATIO = 6e4
"""EA / EI [1/m^2]: at the usual loads of 10 to 20 EI / m^2 the cable stretches by less than 0.05 %."""
SETTLE_TIME, SETTLE_RATE = 2.0, 15.0
RAISED = 5e-4
"""Height of the grippers in family D [m]. A cable of EI 0.02 N m^2 and 0.08 kg/m touches down 17 cm from them."""
OBSTACLE_STIFFNESS, OBSTACLE_FRICTION = 1500.0, 0.15
UNDERSTOOD = {
    "stiffness_patch", "curvature_patch", "static_excess", "stribeck_speed", "friction_patch", "drag", "tilt",
    "tilt_direction", "lump", "grasp_offset", "obstacle",
}  # fmt: skip

(
    FRICTION, EXCESS, STRIBECK, PATCH_X, PATCH_Y, PATCH_R, PATCH_MU, DRAG, PULL_X, PULL_Y, LOAD,
    OFFSET_0, OFFSET_1, OBSTACLE_X, OBSTACLE_Y, OBSTACLE_R, AXIAL_DASHPOT, HEIGHT,
) = range(18)  # fmt: skip


def simulate_in_space(world: World, pose: np.ndarray, frame: float) -> Motion:
    """One episode of family D; raises as `simulate`."""
    return simulate(world, pose, frame, height=RAISED)


def simulate(world: World, pose: np.ndarray, frame: float, *, height: float = 0.0) -> Motion:
    """One episode; see `rod.simulate`.

    Args:
        world: what is simulated.
        pose: of the grippers at every frame.
        frame: time between two [s].
        height: of the grippers above where the cable lies [m]; 0 = all in the table's plane.

    Raises:
        ValueError: the world has something this family has no law for.
        FloatingPointError: the rod became unstable.
    """
    unknown = world.unlike_nominal() - UNDERSTOOD
    if unknown:
        raise ValueError(f"PyElastica's families have no law for {sorted(unknown)}.")
    rod, h = _rod(world), world.length / (ELEMENTS - 1)
    wave = np.sqrt(AXIAL_RATIO * world.stiffness * 2.5 / world.linear_density)  # stiffest joint included
    substeps = int(np.ceil(frame / (0.7 * h / wave)))
    dt = frame / substeps
    joints = (np.arange(ELEMENTS - 1) + 0.5) * h
    stiffness = np.full(ELEMENTS - 1, world.stiffness)
    if world.stiffness_patch is not None:
        centre, width, ratio, edge = world.stiffness_patch
        stiffness *= 1.0 + (ratio - 1.0) * bump(joints, centre, width, edge)
    rod.bend_matrix[:] = np.eye(3)[:, :, None] * (stiffness * rod.rest_voronoi_lengths / h)
    if world.curvature_patch is not None:
        centre, width, curvature, edge = world.curvature_patch
        rod.rest_kappa[0] = curvature * bump(joints, centre, width, edge) * h / rod.rest_voronoi_lengths
    p = np.zeros(18)
    p[HEIGHT] = height
    p[FRICTION], p[EXCESS], p[STRIBECK] = world.friction, world.static_excess, world.stribeck_speed
    if world.friction_patch is not None:
        p[PATCH_X : PATCH_MU + 1] = world.friction_patch
    p[DRAG], p[LOAD] = world.drag * h, GRAVITY * np.cos(world.tilt)
    p[PULL_X] = GRAVITY * np.sin(world.tilt) * np.cos(world.tilt_direction)
    p[PULL_Y] = GRAVITY * np.sin(world.tilt) * np.sin(world.tilt_direction)
    p[OFFSET_0], p[OFFSET_1] = world.grasp_offset
    if world.obstacle is not None:
        p[OBSTACLE_X : OBSTACLE_R + 1] = world.obstacle
    p[AXIAL_DASHPOT] = 0.1 * np.sqrt(AXIAL_RATIO * world.stiffness * world.linear_density)
    held = pose + np.stack([np.zeros(2), np.zeros(2), np.array(world.grasp_offset)], axis=1)
    _lay(rod, held[0], world.length)
    rod.position_collection[2] = height
    damper = stiffness * world.damping_time / h
    out = np.empty((len(pose), ELEMENTS, 2))
    still = np.repeat(held[:1], 2, axis=0)
    settling = np.empty((2, ELEMENTS, 2))
    settle_steps = int(SETTLE_TIME / dt)
    march: Any = _march  # its first arguments come as one tuple
    march(*arrays(rod), still, settle_steps, dt, damper, p, SETTLE_RATE, settling)
    rod.velocity_collection[:], rod.omega_collection[:] = 0.0, 0.0
    march(*arrays(rod), held, substeps, dt, damper, p, 0.0, out)
    if not np.isfinite(out).all() or np.abs(rod.dilatation - 1).max() > 0.1:
        raise FloatingPointError("The Cosserat rod became unstable.")
    arc = np.repeat(np.linspace(0.0, world.length, ELEMENTS)[None], len(out), axis=0)
    return Motion(out, arc)


def _rod(world: World) -> CosseratRod:
    """A straight rod at rest along x."""
    lengths = np.full(ELEMENTS, world.length / (ELEMENTS - 1))
    lengths[[0, -1]] /= 2
    rod = straight_rod(world.length, world.diameter, world.linear_density, lengths, AXIAL_RATIO * world.stiffness)
    if world.lump is not None:
        s = np.append(0.0, np.cumsum(lengths))
        share = np.exp(-0.5 * ((s - world.lump[0]) / 0.02) ** 2)
        rod.mass[:] = rod.mass + world.lump[1] * share / share.sum()
    return rod


def _lay(rod: CosseratRod, pose: np.ndarray, length: float) -> None:
    """The rod as a gentle arch between two grippers."""
    middle = arch(pose, length, ELEMENTS - 1)
    joints = 0.5 * (middle[1:] + middle[:-1])
    nodes = np.concatenate([middle[:1], joints, middle[-1:]])
    angle = np.arctan2(*np.diff(nodes, axis=0).T[::-1])
    angle[0], angle[-1] = pose[0, 2], pose[1, 2]
    lay(rod, nodes, angle)


@numba.njit(cache=True)
def _march(
    x, v, a, q, omega, alpha, mass, inertia, inverse_inertia, stiffness, geometry, strain, stress, external,
    ghosts, pose, substeps, dt, damper, p, settling, out,
):  # fmt: skip
    """Steps the rod along gripper poses [F + 1, 2, 3]; the elements' middles at every frame go to `out`."""
    rest_lengths, tangents, dilatation, outer, couple = geometry[2], geometry[4], strain[0], external[0], external[1]
    n = x.shape[1]
    elements = n - 1
    lower = np.zeros(elements)
    keep = np.exp(-settling * dt)
    for f in range(pose.shape[0] - 1):
        if f == 0:
            _middles(x, out[0])
        rate = (pose[f + 1] - pose[f]) / (substeps * dt)
        for sub in range(substeps):
            hold(x, v, q, omega, rest_lengths, pose[f] + sub * dt * rate, rate)
            overload_operator_kinematic_numba(0.5 * dt, x, q, v, omega)
            force, torque = internal_loads(x, v, q, omega, inertia, stiffness, geometry, strain, stress, ghosts)
            # Outer forces: downhill pull, a dashpot along the elements against axial waves, an obstacle.
            for i in range(n):
                outer[0, i], outer[1, i] = mass[i] * p[PULL_X], mass[i] * p[PULL_Y]
                outer[2, i] = -mass[i] * p[LOAD] if p[HEIGHT] > 0.0 else 0.0
            for e in range(elements):
                tx, ty = tangents[0, e], tangents[1, e]
                pull = p[AXIAL_DASHPOT] * ((v[0, e + 1] - v[0, e]) * tx + (v[1, e + 1] - v[1, e]) * ty)
                outer[0, e] += pull * tx
                outer[1, e] += pull * ty
                outer[0, e + 1] -= pull * tx
                outer[1, e + 1] -= pull * ty
                if p[OBSTACLE_R] > 0.0 and settling == 0.0:
                    for part in range(3):
                        share = (part + 0.5) / 3
                        dx = (1 - share) * x[0, e] + share * x[0, e + 1] - p[OBSTACLE_X]
                        dy = (1 - share) * x[1, e] + share * x[1, e + 1] - p[OBSTACLE_Y]
                        far = np.sqrt(dx * dx + dy * dy)
                        depth = p[OBSTACLE_R] - far
                        if depth > 0.0:
                            nx, ny = dx / far, dy / far
                            normal = OBSTACLE_STIFFNESS / 3 * depth
                            sx = (1 - share) * v[0, e] + share * v[0, e + 1]
                            sy = (1 - share) * v[1, e] + share * v[1, e + 1]
                            slide = -sx * ny + sy * nx
                            rub = OBSTACLE_FRICTION * normal * slide / np.sqrt(slide * slide + 1e-6)
                            fx, fy = normal * nx + rub * ny, normal * ny - rub * nx
                            outer[0, e] += (1 - share) * fx
                            outer[1, e] += (1 - share) * fy
                            outer[0, e + 1] += share * fx
                            outer[1, e + 1] += share * fy
            _update_accelerations(a, force, outer, mass, alpha, inverse_inertia, torque, couple, dilatation)
            for i in range(2, n - 2):
                vx, vy = keep * (v[0, i] + dt * a[0, i]), keep * (v[1, i] + dt * a[1, i])
                vz, pressed = 0.0, dt * p[LOAD]
                if p[HEIGHT] > 0.0:
                    free = keep * (v[2, i] + dt * a[2, i])
                    vz = max(free, -x[2, i] / dt)
                    pressed = vz - free
                if settling == 0.0:
                    speed = np.sqrt(vx * vx + vy * vy)
                    mu = p[FRICTION]
                    if p[PATCH_R] > 0.0:
                        far = np.sqrt((x[0, i] - p[PATCH_X]) ** 2 + (x[1, i] - p[PATCH_Y]) ** 2)
                        mu += (p[PATCH_MU] - mu) * 0.5 * (1.0 - np.tanh((far - p[PATCH_R]) / (p[PATCH_R] / 6)))
                    loss = mu * pressed * (1.0 + p[EXCESS] * np.exp(-((speed / p[STRIBECK]) ** 2)))
                    left = 1.0 - loss / speed if speed > loss else 0.0
                    left /= 1.0 + dt * p[DRAG] / mass[i]
                    vx *= left
                    vy *= left
                v[0, i], v[1, i], v[2, i] = vx, vy, vz
            for e in range(1, elements - 1):
                omega[0, e] = keep * (omega[0, e] + dt * alpha[0, e])
                for k in range(1, 3):
                    omega[k, e] = keep * (omega[k, e] + dt * alpha[k, e]) if p[HEIGHT] > 0.0 else 0.0
            # Dampers between neighbouring elements, implicitly; the ends are held.
            lower[0] = 0.0
            for e in range(1, elements - 1):
                left_d, right_d = dt * damper[e - 1], dt * damper[e]
                pivot = inertia[0, 0, e] + left_d + right_d - left_d * lower[e - 1]
                lower[e] = right_d / pivot
                for k in range(3):
                    omega[k, e] = (inertia[0, 0, e] * omega[k, e] + left_d * omega[k, e - 1]) / pivot
            for e in range(elements - 2, 0, -1):
                for k in range(3):
                    omega[k, e] += lower[e] * omega[k, e + 1]
            overload_operator_kinematic_numba(0.5 * dt, x, q, v, omega)
        hold(x, v, q, omega, rest_lengths, pose[f + 1], rate)
        _middles(x, out[f + 1])


@numba.njit(cache=True)
def _middles(x, out):
    """Middles of the elements, for the two held ones the grasped end."""
    last = x.shape[1] - 1
    for e in range(last):
        out[e, 0], out[e, 1] = 0.5 * (x[0, e] + x[0, e + 1]), 0.5 * (x[1, e] + x[1, e + 1])
    out[0, 0], out[0, 1] = x[0, 0], x[1, 0]
    out[last - 1, 0], out[last - 1, 1] = x[0, last], x[1, last]
