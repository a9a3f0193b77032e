"""A Cosserat rod of PyElastica, and the loop over its time steps, compiled around PyElastica's kernels.

A file of its own because it cannot be imported without PyElastica, and because compiled code is kept on disk only for
functions at the top level of a file.

One step is PyElastica's position Verlet: half a step of positions and directors, forces and torques there, a whole
step of the velocities, half a step of positions and directors. The velocities' step is split: elastic force, filter,
friction impulse, implicit bending damper.
"""

from __future__ import annotations

import numba
import numpy as np
from elastica.dissipation import nb_filter_rate
from elastica.rod.cosserat_rod import (
    CosseratRod,
    _compute_internal_forces,
    _compute_internal_torques,
    _update_accelerations,
)
from elastica.rod.data_structures import overload_operator_kinematic_numba

FILTER_ORDER = 3
"""Of PyElastica's filter of velocities that alternate from node to node; it hardly touches long wavelengths. Axial
waves have no other damping, and friction that falls with the speed feeds them."""


def straight_rod(length: float, diameter: float, density: float, lengths: np.ndarray, axial: float) -> CosseratRod:
    """A rod along x, at rest and without a bending stiffness.

    Directors are the table's normal, the in-plane normal and the tangent; bending in the plane is about the first.

    Args:
        length: of the cable [m].
        diameter: [m].
        density: mass per length [kg/m].
        lengths: of the elements [m]; the held ones are half as long as the others.
        axial: EA [N].
    """
    position = np.zeros((3, len(lengths) + 1))
    position[0, 1:] = np.cumsum(lengths)
    rod = CosseratRod.straight_rod(
        len(lengths), np.zeros(3), np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), length, diameter / 2,
        density / (np.pi * diameter**2 / 4), youngs_modulus=1.0, shear_modulus=1.0, position=position,
    )  # fmt: skip
    # Shear at half the axial stiffness, and inertia of rotation with the gyration radius h / 2: then the fastest shear
    # mode is as fast as the fastest axial one, and nothing visible depends on either.
    rod.shear_matrix[:] = np.diag([0.5 * axial, 0.5 * axial, axial])[:, :, None]
    inertia = density * lengths * (length / (len(lengths) - 1) / 2) ** 2
    rod.mass_second_moment_of_inertia[:] = np.eye(3)[:, :, None] * inertia
    rod.inv_mass_second_moment_of_inertia[:] = np.eye(3)[:, :, None] / inertia
    return rod


def lay(rod: CosseratRod, nodes: np.ndarray, angle: np.ndarray) -> None:
    """Puts the rod's nodes to these places in the plane [m], and turns its elements to these angles [rad]."""
    rod.position_collection[:2] = nodes.T
    cos, sin, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    rod.director_collection[0] = np.stack([zero, zero, zero + 1.0])
    rod.director_collection[1] = np.stack([sin, -cos, zero])
    rod.director_collection[2] = np.stack([cos, sin, zero])


def arrays(rod: CosseratRod) -> tuple:
    """The first arguments of `advance`."""
    return (
        rod.position_collection, rod.velocity_collection, rod.acceleration_collection, rod.director_collection,
        rod.omega_collection, rod.alpha_collection, rod.mass, rod.mass_second_moment_of_inertia,
        rod.inv_mass_second_moment_of_inertia,
        (rod.shear_matrix, rod.bend_matrix, rod.rest_sigma, rod.rest_kappa),
        (rod.volume, rod.lengths, rod.rest_lengths, rod.rest_voronoi_lengths, rod.tangents, rod.radius),
        (rod.dilatation, rod.voronoi_dilatation, rod.dilatation_rate, rod.sigma, rod.kappa),
        (rod.internal_stress, rod.internal_couple, rod.internal_forces, rod.internal_torques),
        (rod.external_forces, rod.external_torques),
        rod.ghost_elems_idx,
    )  # fmt: skip


@numba.njit(cache=True)
def advance(
    x, v, a, q, omega, alpha, mass, inertia, inverse_inertia, stiffness, geometry, strain, stress, external,
    ghosts, pose, twist, steps, dt, damper, friction, static_ratio, stribeck_speed, damping,
):  # fmt: skip
    """Advances a rod by `steps` time steps in place; the arrays are those of `elastica.CosseratRod`.

    Args:
        x: positions of the nodes [m], shape [3, n + 1].
        v: their velocities [m/s], shape [3, n + 1].
        a: their accelerations [m/s^2], shape [3, n + 1].
        q: directors of the elements, shape [3, 3, n].
        omega: their angular velocities [rad/s], shape [3, n].
        alpha: their angular accelerations [rad/s^2], shape [3, n].
        mass: of the nodes [kg], shape [n + 1].
        inertia: of the elements' rotation [kg m^2], shape [3, 3, n].
        inverse_inertia: its inverse, shape [3, 3, n].
        stiffness: shear and bend matrices, sigma and kappa at rest.
        geometry: volume, lengths, lengths at rest, Voronoi lengths at rest, tangents, radius.
        strain: dilatation, Voronoi dilatation, dilatation rate, sigma, kappa.
        stress: internal stress, couple, force and torque.
        external: force and torque; the force becomes the table's friction in the last step.
        ghosts: PyElastica's indices between rods that share memory; empty.
        pose: of the grippers at the beginning [m, rad], shape [2, 3].
        twist: of the grippers [m/s, rad/s], shape [2, 3].
        steps: number of time steps.
        dt: time step [s].
        damper: couple between neighbours per difference of their angular velocities [N m s], shape [n - 1].
        friction: mu_k g [m/s^2].
        static_ratio: mu_s / mu_k.
        stribeck_speed: v_s [m/s].
        damping: rate at which all motion dies [1/s].
    """
    rest_lengths, dilatation, rubbing, external_torque = geometry[2], strain[0], external[0], external[1]
    n_nodes = x.shape[1]
    n_elements = n_nodes - 1
    upper, rough = np.zeros(n_elements), np.zeros_like(v)
    keep, resistance = np.exp(-damping * dt), dt * damper
    for step in range(steps):
        hold(x, v, q, omega, rest_lengths, pose + step * dt * twist, twist)
        overload_operator_kinematic_numba(0.5 * dt, x, q, v, omega)
        force, torque = internal_loads(x, v, q, omega, inertia, stiffness, geometry, strain, stress, ghosts)
        _update_accelerations(a, force, rubbing, mass, alpha, inverse_inertia, torque, external_torque, dilatation)
        for node in range(2, n_nodes - 2):
            v[0, node] = keep * (v[0, node] + dt * a[0, node])
            v[1, node] = keep * (v[1, node] + dt * a[1, node])
        # With the last step's friction in it a cable that slides steadily has nothing to be filtered.
        nb_filter_rate(v, rough, FILTER_ORDER)
        for node in range(2, n_nodes - 2):
            vx = v[0, node] - keep * dt * rubbing[0, node] / mass[node]
            vy = v[1, node] - keep * dt * rubbing[1, node] / mass[node]
            speed = np.sqrt(vx * vx + vy * vy)
            loss = friction * dt * (1.0 + (static_ratio - 1.0) * np.exp(-((speed / stribeck_speed) ** 2)))
            left = 1.0 - loss / speed if speed > loss else 0.0
            v[0, node], v[1, node], v[2, node] = left * vx, left * vy, 0.0
            rubbing[0, node] = (left - 1.0) * vx * mass[node] / dt
            rubbing[1, node] = (left - 1.0) * vy * mass[node] / dt
        for element in range(1, n_elements - 1):
            omega[0, element] = keep * (omega[0, element] + dt * alpha[0, element])
            omega[1, element], omega[2, element] = 0.0, 0.0
        _damp_bending(omega[0], inertia[0, 0], resistance, upper)
        overload_operator_kinematic_numba(0.5 * dt, x, q, v, omega)
    hold(x, v, q, omega, rest_lengths, pose + steps * dt * twist, twist)


@numba.njit(cache=True)
def internal_loads(x, v, q, omega, inertia, stiffness, geometry, strain, stress, ghosts):
    """Elastic forces on the nodes and couples on the elements; arguments as those of `advance`."""
    shear_matrix, bend_matrix, rest_sigma, rest_kappa = stiffness
    volume, lengths, rest_lengths, rest_voronoi, tangents, radius = geometry
    dilatation, voronoi_dilatation, dilatation_rate, sigma, kappa = strain
    internal_stress, internal_couple, force, torque = stress
    _compute_internal_forces(
        x, volume, lengths, tangents, radius, rest_lengths, rest_voronoi, dilatation, voronoi_dilatation, q, sigma,
        rest_sigma, shear_matrix, internal_stress, force, ghosts,
    )  # fmt: skip
    _compute_internal_torques(
        x, v, tangents, lengths, rest_lengths, q, rest_voronoi, bend_matrix, rest_kappa, kappa, voronoi_dilatation,
        inertia, omega, internal_stress, internal_couple, dilatation, dilatation_rate, torque, ghosts,
    )  # fmt: skip
    return force, torque


@numba.njit(cache=True)
def hold(x, v, q, omega, rest_lengths, pose, rate):
    """Puts the two end elements where the grippers are, with their velocities."""
    last = x.shape[1] - 1
    for g in range(2):
        cos, sin, turn = np.cos(pose[g, 2]), np.sin(pose[g, 2]), rate[g, 2]
        end, inner, e = (0, 1, 0) if g == 0 else (last, last - 1, last - 1)
        long = rest_lengths[0] if g == 0 else -rest_lengths[last - 1]
        x[0, end], x[1, end] = pose[g, 0], pose[g, 1]
        v[0, end], v[1, end] = rate[g, 0], rate[g, 1]
        x[0, inner], x[1, inner] = pose[g, 0] + long * cos, pose[g, 1] + long * sin
        v[0, inner], v[1, inner] = rate[g, 0] - long * turn * sin, rate[g, 1] + long * turn * cos
        q[1, 0, e], q[1, 1, e], q[2, 0, e], q[2, 1, e] = sin, -cos, cos, sin
        omega[0, e], omega[1, e], omega[2, e] = turn, 0.0, 0.0


@numba.njit(cache=True)
def _damp_bending(omega, inertia, damper, upper):
    """The implicit step `(J + dt D) omega = J omega*` of dampers between neighbouring elements, the ends held."""
    n = omega.shape[0]
    upper[0] = 0.0
    for i in range(1, n - 1):
        pivot = inertia[i] + (damper[i - 1] + damper[i]) - damper[i - 1] * upper[i - 1]
        upper[i] = damper[i] / pivot
        omega[i] = (inertia[i] * omega[i] + damper[i - 1] * omega[i - 1]) / pivot
    for i in range(n - 2, 0, -1):
        omega[i] += upper[i] * omega[i + 1]
