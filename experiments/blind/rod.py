"""Family A: a planar discrete elastic rod in absolute node coordinates, with every effect of the library and others.

The laws are this file's own: Stribeck friction, Bouc-Wen hysteresis, soft-edged patches, hardening plasticity with
partial return, a smooth penalty disc. See `rod_kernel` for the discretisation.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from . import rod_kernel as kernel
from .world import GRAVITY, World, bump

SETTLE_STEPS, SETTLE_STEP = 700, 0.01


@dataclasses.dataclass(frozen=True)
class RodConfig:
    """Discretisation.

    Attributes:
        segments: of equal length.
        timestep: [s].
        iterations: of the friction coefficient in a time step.
    """

    segments: int = 48
    timestep: float = 2e-3
    iterations: int = 2


@dataclasses.dataclass(frozen=True)
class Motion:
    """Points of the cable over time.

    Attributes:
        points: [m], shape [F, M, 2].
        arc: material arc length of every point [m], shape [F, M]; 0 and the length at grippers that do not slip.
    """

    points: np.ndarray
    arc: np.ndarray


def simulate(world: World, pose: np.ndarray, frame: float, config: RodConfig | None = None) -> Motion:
    """One episode from a settled cable without friction locked in.

    Args:
        pose: true gripper poses at every frame, shape [F, 2, 3].
        frame: time between frames [s].
    """
    config = config or RodConfig()
    substeps = round(frame / config.timestep)
    n = config.segments
    p = parameters(world, n)
    s = np.linspace(0.0, world.length, n + 1)
    h = world.length / n
    # The held nodes' cells are half segments, centred a quarter segment in.
    s_cell = s.copy()
    s_cell[0], s_cell[-1] = h / 4, world.length - h / 4
    stiffness = np.full(n + 1, world.stiffness)
    if world.stiffness_patch is not None:
        centre, width, ratio, edge = world.stiffness_patch
        stiffness *= 1.0 + (ratio - 1.0) * bump(s_cell, centre, width, edge)
    rest = np.zeros(n + 1)
    if world.curvature_patch is not None:
        centre, width, curvature, edge = world.curvature_patch
        rest += curvature * bump(s_cell, centre, width, edge)
    mass = np.full(n + 1, world.linear_density * h)
    if world.lump is not None:
        share = np.exp(-0.5 * ((s - world.lump[0]) / 0.012) ** 2)
        mass += world.lump[1] * share / share.sum()
    x = arch(pose[0] + np.array([[0, 0, world.grasp_offset[0]], [0, 0, world.grasp_offset[1]]]), world.length, n)
    v, state, grasp = np.zeros((n + 1, 2)), np.zeros((4, n + 1)), np.zeros(2)
    still = np.repeat(pose[:1], 2, axis=0)
    out, rest_out = np.empty((2, n + 1, 2)), np.empty(2)
    rate = 2.5 * np.sqrt(world.stiffness / world.linear_density) * 22.0 / world.length**2
    kernel.advance(
        x, v, mass, stiffness, rest, state, grasp, p, still, SETTLE_STEP, SETTLE_STEPS, rate, 1, 0.0, out, rest_out,
    )  # fmt: skip
    v[:] = 0.0
    kappa = _curvature(x, pose[0, :, 2] + np.array(world.grasp_offset) + grasp, h)
    state[3] = kappa
    if np.isfinite(world.yield_curvature):
        over = kappa - rest
        flowed = np.sign(over) * np.maximum(np.abs(over) - world.yield_curvature, 0.0) / (1 + world.hardening)
        if (flowed != 0).any():  # bent into the arch beyond its yield: settle once more with that set
            state[0] = flowed
            kernel.advance(
                x, v, mass, stiffness, rest, state, grasp, p, still, SETTLE_STEP, SETTLE_STEPS, rate, 1, 0.0, out,
                rest_out,
            )  # fmt: skip
            v[:] = 0.0
    out, rest_out = np.empty((len(pose), n + 1, 2)), np.empty(len(pose))
    kernel.advance(
        x, v, mass, stiffness, rest, state, grasp, p, np.ascontiguousarray(pose), frame / substeps, substeps, 0.0,
        config.iterations, 0.0, out, rest_out,
    )  # fmt: skip
    if not np.isfinite(out).all():
        raise FloatingPointError("The rod became unstable.")
    arc = rest_out[:, None] * np.arange(n + 1)
    if world.slip is not None and world.slip[0] == 0:
        arc += world.length - arc[:, -1:]
    return Motion(out, arc)


def parameters(world: World, n: int) -> np.ndarray:
    """The kernel's parameter vector."""
    p = np.zeros(kernel.N_PARAMETERS)
    p[kernel.LENGTH], p[kernel.DAMPING], p[kernel.AXIAL] = world.length, world.damping_time, world.axial_stiffness
    p[kernel.FRICTION], p[kernel.EXCESS], p[kernel.STRIBECK] = world.friction, world.static_excess, world.stribeck_speed
    p[kernel.DRAG], p[kernel.LOAD] = world.drag, GRAVITY * np.cos(world.tilt)
    p[kernel.PULL_X] = GRAVITY * np.sin(world.tilt) * np.cos(world.tilt_direction)
    p[kernel.PULL_Y] = GRAVITY * np.sin(world.tilt) * np.sin(world.tilt_direction)
    if world.friction_patch is not None:
        p[kernel.PATCH_X : kernel.PATCH_MU + 1] = world.friction_patch
    p[kernel.YIELD] = min(world.yield_curvature, 1e9)
    p[kernel.HARDENING], p[kernel.RETURNED], p[kernel.RETURN_TIME] = world.hardening, world.returned, world.return_time
    p[kernel.HYST_M], p[kernel.HYST_K] = world.hysteresis_moment, world.hysteresis_transition
    if world.slip is not None:
        p[kernel.SLIP_GRIPPER : kernel.SLIP_DISTANCE + 1] = world.slip
    p[kernel.OFFSET_0], p[kernel.OFFSET_1] = world.grasp_offset
    p[kernel.GRASP_0], p[kernel.GRASP_1] = (k if np.isfinite(k) else 0.0 for k in world.grasp_stiffness)
    if world.obstacle is not None:
        p[kernel.OBSTACLE_X : kernel.OBSTACLE_R + 1] = world.obstacle
    if world.magnet is not None:
        p[kernel.MAGNET_X : kernel.MAGNET_R + 1] = world.magnet
    p[kernel.DRIFT], p[kernel.DRIFT_TIME], p[kernel.ANISOTROPY] = world.drift, world.drift_time, world.anisotropy
    if world.tether is not None:
        centre, x, y, k, slack = world.tether
        p[kernel.TETHER_NODE] = np.clip(round(centre / world.length * n), 1, n - 1)
        p[kernel.TETHER_X : kernel.TETHER_SLACK + 1] = x, y, k, slack
    if world.shake is not None:
        amplitude, frequency, direction = world.shake
        p[kernel.SHAKE_X], p[kernel.SHAKE_Y] = amplitude * np.cos(direction), amplitude * np.sin(direction)
        p[kernel.SHAKE_W] = 2 * np.pi * frequency
    p[kernel.CREEP], p[kernel.CREEP_TIME], p[kernel.SIGNED] = world.creep, world.creep_time, world.signed_stiffness
    p[kernel.LUBRICATION] = world.lubrication if np.isfinite(world.lubrication) else 0.0
    return p


def arch(pose: np.ndarray, length: float, n: int) -> np.ndarray:
    """Nodes of a gentle arch of the cable's length between two grippers, to settle from, shape [n + 1, 2].

    The direction along the cable runs linearly from one gripper's angle to the other's, plus two sines that bring the
    end to where it belongs (Newton's method).
    """
    u = (np.arange(n) + 0.5) / n
    ends, goal = pose[:, 2], pose[1, :2] - pose[0, :2]
    side = 1.0 if ends[0] - ends[1] >= 0 else -1.0

    def reach(sines: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle = ends[0] + (ends[1] - ends[0]) * u + sines[0] * np.sin(2 * np.pi * u) + sines[1] * np.sin(np.pi * u)
        steps = length / n * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return steps, steps.sum(axis=0)

    for guess in (0.6, 1.0, 0.3, 1.5, 0.1, 2.0):
        sines = np.array([side * guess, 0.0])
        for _ in range(60):
            steps, end = reach(sines)
            turn = np.stack([-steps[:, 1], steps[:, 0]])  # derivative of every step by its angle
            jacobian = turn @ np.stack([np.sin(2 * np.pi * u), np.sin(np.pi * u)], axis=1)
            update = np.linalg.solve(jacobian + 1e-9 * np.eye(2), goal - end)
            sines = sines + np.clip(update, -0.3, 0.3)
            if np.abs(goal - end).max() < 1e-9:
                break
        # The gentle arch is the one to this side; its mirror image inside the clamps is an S-shaped detour.
        if np.abs(goal - end).max() < 1e-9 and sines[0] * side > -0.2 and np.abs(sines).max() < 3.0:
            return np.concatenate([pose[:1, :2], pose[0, :2] + np.cumsum(steps, axis=0)])
    raise ValueError(f"No gentle arch of {length} m fits between the grippers {pose.tolist()}.")


def _curvature(x: np.ndarray, theta: np.ndarray, h: float) -> np.ndarray:
    segments = np.diff(x, axis=0)
    angle = np.unwrap(np.concatenate([[theta[0]], np.arctan2(segments[:, 1], segments[:, 0]), [theta[1]]]))
    cells = np.full(len(x), h)
    cells[0] = cells[-1] = h / 2
    return np.diff(angle) / cells
