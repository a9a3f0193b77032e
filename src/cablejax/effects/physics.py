"""The physics of one cable: the nominal parameters and, at their null values, those of every effect."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cablejax.cable import GRAVITY, Discretisation

NEVER = 1e3
"""A curvature [1/m] that no cable yields at, a place [m] that none reaches; near enough for single precision."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Physics:
    """Everything that moves one planar cable, or how it is seen, apart from the grippers' motion.

    One pytree for all effects: the simulator is compiled once, and an effect is a function from one `Physics` to
    another. At its null value every field leaves the nominal rollout as it is, to the last bit.

    Attributes:
        stiffness: EI at each joint [N m^2], shape [J].
        rest_curvature: kappa_0 at each joint [1/m], shape [J]; in space [J, 3].
        damping_time: Kelvin-Voigt time constant [s].
        yield_curvature: elastic curvature beyond which a bend stays [1/m].
        hardening: h, kinematic: beyond yielding the moment grows with slope `EI h / (1 + h)`; 0 = perfectly plastic.
        hysteresis_moment: largest moment of the internal friction in bending [N m].
        hysteresis_curvature: curvature over which that moment builds up [1/m].
        axial_compliance: 1 / EA [1/N].
        friction: kinetic Coulomb coefficient of the table.
        static_excess: relative excess of the static coefficient over the kinetic one (Stribeck).
        patch_centre: middle of a round patch of the table [m], shape [2].
        patch_radius: [m].
        patch_friction: coefficient inside the patch less the one outside.
        drag: viscous drag per length and speed [N s/m^2].
        gravity: its magnitude [m/s^2].
        tilt: in-plane part of the gravity [m/s^2], shape [2].
        density: mass per length [kg/m].
        extra_mass: mass added at each node [kg], shape [n].
        grip_height: by which the grippers hold the cable's ends above where it lies on the table [m]; they carry its
            weight up to where it comes down, see `cablejax.simulate.friction`.
        slip: change of the free length at either gripper [m], shape [2].
        slip_time: when it happens [s], in each episode.
        rotation_offset: of the cable's clamp against either gripper's angle [rad], shape [2].
        rotation_compliance: of either clamp [rad/(N m)], shape [2].
        obstacle_centre: of a fixed disc [m], shape [2].
        obstacle_radius: to the cable's centreline [m]; 0 = none.
        bias_along: how far each keypoint sits beyond where it would be if all were uniform [m], shape [N].
        bias_across: how far each sits to the left of the centreline [m], shape [N].
        camera_scale: of the keypoints about the world's origin.
        camera_angle: rotation of the keypoints about the world's origin [rad].
        camera_offset: added after scale and rotation [m], shape [2].
        camera_lag: by which the keypoints' stamps are late [s].
        actuation_gain: motion of the grippers over the commanded one, from the first pose on.
        actuation_delay: pure delay between command and motion [s].
        actuation_time: time constant of a first-order lag after that [s].
    """

    stiffness: Float[Array, "*B J"]
    rest_curvature: Float[Array, "*B J"] | Float[Array, "*B J 3"]
    damping_time: Float[Array, "*B"]
    yield_curvature: Float[Array, "*B"]
    hardening: Float[Array, "*B"]
    hysteresis_moment: Float[Array, "*B"]
    hysteresis_curvature: Float[Array, "*B"]
    axial_compliance: Float[Array, "*B"]
    friction: Float[Array, "*B"]
    static_excess: Float[Array, "*B"]
    patch_centre: Float[Array, "*B 2"]
    patch_radius: Float[Array, "*B"]
    patch_friction: Float[Array, "*B"]
    drag: Float[Array, "*B"]
    gravity: Float[Array, "*B"]
    tilt: Float[Array, "*B 2"]
    density: Float[Array, "*B"]
    extra_mass: Float[Array, "*B n"]
    grip_height: Float[Array, "*B"]
    slip: Float[Array, "*B 2"]
    slip_time: Float[Array, "*B"]
    rotation_offset: Float[Array, "*B 2"]
    rotation_compliance: Float[Array, "*B 2"]
    obstacle_centre: Float[Array, "*B 2"]
    obstacle_radius: Float[Array, "*B"]
    bias_along: Float[Array, "*B N"]
    bias_across: Float[Array, "*B N"]
    camera_scale: Float[Array, "*B"]
    camera_angle: Float[Array, "*B"]
    camera_offset: Float[Array, "*B 2"]
    camera_lag: Float[Array, "*B"]
    actuation_gain: Float[Array, "*B"]
    actuation_delay: Float[Array, "*B"]
    actuation_time: Float[Array, "*B"]


def nominal_physics(
    config: Discretisation,
    dtype=jnp.float32,
    *,
    gravity: Sequence[float] | np.ndarray = (0.0, 0.0, -GRAVITY),
    arclength: Sequence[float] | np.ndarray | None = None,
) -> Physics:
    """The physics of the nominal cable, without any effect.

    Args:
        config: the cable.
        dtype: of every array.
        gravity: as it is believed to act, the table's normal being z [m/s^2], shape [3].
        arclength: where the keypoints are marked on the cable [m], shape [N]; None = uniform over its length.
    """
    joints, links = config.n_joints, config.n_links
    # in space about the joints' z axes, those of a cable on a table
    hinges = np.ones(joints) if config.dimension == 2 else np.tile([0.0, 0.0, 1.0], (joints, 1))
    marks = config.cable.keypoint_arclength if arclength is None else np.asarray(arclength, float)
    values = {
        "stiffness": np.full(joints, config.cable.bending_stiffness),
        "rest_curvature": config.cable.rest_curvature * hinges,
        "damping_time": config.cable.damping_time,
        "yield_curvature": NEVER,
        "hardening": 0.0,
        "hysteresis_moment": 0.0,
        "hysteresis_curvature": 1.0,
        "axial_compliance": 0.0,
        "friction": config.cable.friction_coefficient,
        "static_excess": 0.0,
        "patch_centre": np.zeros(2),
        "patch_radius": 0.1,
        "patch_friction": 0.0,
        "drag": 0.0,
        "gravity": float(np.linalg.norm(gravity)),
        "tilt": np.asarray(gravity, float)[:2],
        "density": config.cable.linear_density,
        "extra_mass": np.zeros(links),
        "grip_height": 0.0,
        "slip": np.zeros(2),
        "slip_time": 0.0,
        "rotation_offset": np.zeros(2),
        "rotation_compliance": np.zeros(2),
        "obstacle_centre": np.full(2, NEVER),
        "obstacle_radius": 0.0,
        "bias_along": marks - config.cable.keypoint_arclength,
        "bias_across": np.zeros(config.cable.n_keypoints),
        "camera_scale": 1.0,
        "camera_angle": 0.0,
        "camera_offset": np.zeros(2),
        "camera_lag": 0.0,
        "actuation_gain": 1.0,
        "actuation_delay": 0.0,
        "actuation_time": 0.0,
    }
    arrays: dict[str, Any] = {name: np.asarray(value, np.dtype(dtype)) for name, value in values.items()}
    return Physics(**arrays)


def normal_gravity(physics: Physics) -> Any:
    """Gravity across the table [m/s^2]; the part in its plane is `tilt`. NumPy in, NumPy out; JAX in, JAX out.

    Differentiable; where gravity lies in the table's plane as far as rounding goes, it is 0, and so is its derivative.
    """
    whole = physics.gravity**2
    square = whole - (physics.tilt**2).sum()
    xp = square.__array_namespace__()
    across = square > 16 * np.finfo(square.dtype).eps * whole
    return xp.where(across, xp.sqrt(xp.where(across, square, 1.0)), 0.0)


def mean_resistance(physics: Physics) -> tuple[float, float]:
    """Mean bending stiffness [N m^2] and friction per length on the table [N/m], see `types.cable_descriptor`."""
    return float(np.mean(physics.stiffness)), float(physics.friction * physics.density * GRAVITY)


def may_touch(physics: Physics) -> bool:
    """Whether a cable of this physics can touch an obstacle: false only where the radius is known to be zero.

    Inside `jit` the radius is known if it is a constant, see `without_obstacle`.
    """
    radius = physics.obstacle_radius
    return isinstance(radius, jax.core.Tracer) or bool(np.any(np.asarray(radius) > 0))


def without_obstacle(physics: Physics) -> Physics:
    """The physics with an obstacle that is known to be absent, even inside `jit`: no time is spent on contacts."""
    return dataclasses.replace(physics, obstacle_radius=np.zeros(np.shape(physics.obstacle_radius), np.float32))
