"""The 22 effects of the specification as interventions on a world, its arms and its camera.

An effect draws what is not its strength (places, signs, softness of edges) once, and then is a function of one
strength, which the severity search moves. Parameters are reported in the specification's words; those that begin with
`_` are details of the law outside it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from .motions import Commands
from .observe import KEYPOINTS, Camera
from .rod import Motion
from .world import World


@dataclasses.dataclass(frozen=True)
class Arm:
    """What the grippers make of a command.

    Attributes:
        gain: of every component of the motion.
        lag, lag_share: see `Camera`.
        play: of the rotation, between the encoder's angle and the grasp's [rad].
    """

    gain: float = 1.0
    lag: float = 0.0
    lag_share: float = 0.5
    play: float = 0.0


@dataclasses.dataclass(frozen=True)
class Setup:
    """Everything that acts in one log."""

    world: World
    arm: Arm = dataclasses.field(default_factory=Arm)
    camera: Camera = dataclasses.field(default_factory=Camera)


@dataclasses.dataclass(frozen=True)
class Context:
    """What an effect may look at to place itself: the same log without it.

    Attributes:
        world: without effects.
        commands: of every episode.
        motions: of every episode without effects, at the log's samples.
    """

    world: World
    commands: list[Commands]
    motions: list[Motion]


@dataclasses.dataclass(frozen=True)
class Effect:
    """One kind of effect.

    Attributes:
        name: the specification's, or one of `unknown.py`.
        side: "world", "arm" or "camera".
        strengths: smallest and largest strength.
        draw: everything but the strength.
        apply: the setup with the effect of a strength, and its parameters in the specification's words.
        helpful: motions that show the effect, used where the ones drawn first do not.
    """

    name: str
    side: str
    strengths: tuple[float, float]
    draw: Callable[[np.random.Generator, Context], dict[str, Any]]
    apply: Callable[[Setup, dict[str, Any], float], tuple[Setup, dict[str, Any]]]
    helpful: tuple[str, ...] = ()


EFFECTS: dict[str, Effect] = {}


def effect(name: str, side: str, strengths: tuple[float, float], draw, helpful: tuple[str, ...] = ()):
    """Registers the decorated `apply` under a name."""

    def register(apply):
        EFFECTS[name] = Effect(name, side, strengths, draw, apply, helpful)
        return apply

    return register


def on_world(setup: Setup, **changes) -> Setup:
    return dataclasses.replace(setup, world=dataclasses.replace(setup.world, **changes))


def on_camera(setup: Setup, **changes) -> Setup:
    return dataclasses.replace(setup, camera=dataclasses.replace(setup.camera, **changes))


def on_arm(setup: Setup, **changes) -> Setup:
    return dataclasses.replace(setup, arm=dataclasses.replace(setup.arm, **changes))


def sign(rng: np.random.Generator, positive: float = 0.5) -> float:
    return 1.0 if rng.random() < positive else -1.0


def section(rng: np.random.Generator, context: Context) -> dict[str, Any]:
    """A part of the cable, with edges of one of two shapes."""
    length = context.world.length
    return {
        "centre": rng.uniform(0.2, 0.8) * length, "width": rng.uniform(0.12, 0.35) * length,
        "edge": int(rng.integers(2)), "sign": sign(rng),
    }  # fmt: skip


def swept_place(rng: np.random.Generator, context: Context) -> tuple[float, float]:
    """A place on the table that the inner part of the cable lies on at some time."""
    motion = context.motions[rng.integers(len(context.motions))]
    n = motion.points.shape[1]
    point = motion.points[rng.integers(len(motion.points)), rng.integers(n // 4, 3 * n // 4)]
    return float(point[0]), float(point[1])


def steepest_bend(context: Context) -> float:
    """Largest curvature without effects [1/m]."""
    largest = 0.0
    for motion in context.motions:
        steps = np.diff(motion.points, axis=1)
        one, two = steps[:, :-1], steps[:, 1:]
        cross = one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0]
        turn = cross / np.einsum("fni,fni->fn", one, two)
        largest = max(largest, float(np.abs(np.arctan(turn)).max() / np.median(np.linalg.norm(steps, axis=2))))
    return largest


def signed(rng, context):
    return {"sign": sign(rng)}


@effect("bending_stiffness", "world", (0.02, 2.2), lambda rng, c: {"sign": sign(rng, 0.35)})
def _(setup, fixed, x):
    ratio = float(np.exp(fixed["sign"] * x))
    return on_world(setup, stiffness=setup.world.stiffness * ratio), {"ratio": ratio}


@effect("stiffness_profile", "world", (0.02, 2.4), section)
def _(setup, fixed, x):
    ratio = float(np.exp(fixed["sign"] * x))
    patch = (fixed["centre"], fixed["width"], ratio, fixed["edge"])
    return on_world(setup, stiffness_patch=patch), {
        "centre_m": fixed["centre"], "width_m": fixed["width"], "ratio": ratio, "_edge": fixed["edge"],
    }  # fmt: skip


@effect("intrinsic_curvature", "world", (0.02, 10.0), section)
def _(setup, fixed, x):
    patch = (fixed["centre"], fixed["width"], fixed["sign"] * x, fixed["edge"])
    return on_world(setup, curvature_patch=patch), {
        "centre_m": fixed["centre"], "width_m": fixed["width"], "curvature_per_m": fixed["sign"] * x,
        "_edge": fixed["edge"],
    }  # fmt: skip


@effect(
    "plasticity", "world", (0.01, 2.0),
    lambda rng, c: {
        "steepest": steepest_bend(c), "hardening": rng.uniform(0.05, 0.3), "returned": rng.uniform(0.05, 0.3),
        "return_time": rng.uniform(5.0, 12.0),
    },
    ("overload_return", "overload_return"),
)  # fmt: skip
def _(setup, fixed, x):
    curvature = float(fixed["steepest"] * np.exp(-x))
    law = {name: fixed[name] for name in ("hardening", "returned", "return_time")}
    return on_world(setup, yield_curvature=curvature, **law), {
        "yield_curvature_per_m": curvature, "_hardening": law["hardening"], "_returned": law["returned"],
        "_return_time_s": law["return_time"],
    }  # fmt: skip


@effect(
    "bending_hysteresis", "world", (0.02, 6.0),
    lambda rng, c: {"transition": rng.uniform(0.3, 1.5)}, ("overload_return", "ramp_hold"),
)  # fmt: skip
def _(setup, fixed, x):
    moment = x * setup.world.stiffness
    return on_world(setup, hysteresis_moment=moment, hysteresis_transition=fixed["transition"]), {
        "moment_n_m": moment, "transition_curvature_per_m": fixed["transition"],
    }  # fmt: skip


@effect("bending_damping", "world", (0.05, 4.7), lambda rng, c: {}, ("ramp_hold", "overload_return"))
def _(setup, fixed, x):
    time = float(setup.world.damping_time * np.exp(x))
    return on_world(setup, damping_time=time), {"time_s": time}


@effect("axial_stretch", "world", (1.0, 10.0), lambda rng, c: {}, ("taut", "taut", "overload_return"))
def _(setup, fixed, x):
    stiffness = float(setup.world.axial_stiffness * np.exp(-x))
    return on_world(setup, axial_stiffness=stiffness), {"stiffness_n": stiffness}


@effect(
    "table_friction", "world", (0.02, 3.0),
    lambda rng, c: {"sign": sign(rng, 0.75), "excess": rng.uniform(0.1, 0.35), "speed": rng.uniform(0.002, 0.008)},
    ("translation", "translation"),
)  # fmt: skip
def _(setup, fixed, x):
    coefficient = float(setup.world.friction * np.exp(fixed["sign"] * x))
    return on_world(setup, friction=coefficient, static_excess=fixed["excess"], stribeck_speed=fixed["speed"]), {
        "coefficient": coefficient, "_stribeck_static_excess": fixed["excess"], "_stribeck_speed": fixed["speed"],
    }  # fmt: skip


def _friction_patch(rng, context):
    return {"place": swept_place(rng, context), "radius": rng.uniform(0.07, 0.16)}


@effect("friction_patch", "world", (0.05, 3.5), _friction_patch, ("translation", "ramp_hold"))
def _(setup, fixed, x):
    (px, py), radius = fixed["place"], fixed["radius"]
    coefficient = float(setup.world.friction * np.exp(x))
    return on_world(setup, friction_patch=(px, py, radius, coefficient)), {
        "x_m": px, "y_m": py, "radius_m": radius, "coefficient": coefficient,
    }  # fmt: skip


@effect("viscous_drag", "world", (0.05, 200.0), lambda rng, c: {}, ("translation", "translation"))
def _(setup, fixed, x):
    return on_world(setup, drag=x), {"coefficient_n_s_per_m2": x}


@effect("gravity_tilt", "world", (0.003, 0.7), lambda rng, c: {"direction": rng.uniform(-np.pi, np.pi)})
def _(setup, fixed, x):
    return on_world(setup, tilt=x, tilt_direction=fixed["direction"]), {
        "angle_rad": x, "direction_rad": fixed["direction"],
    }  # fmt: skip


@effect(
    "linear_density", "world", (0.02, 3.0), lambda rng, c: {"sign": sign(rng, 0.75)}, ("translation", "translation")
)
def _(setup, fixed, x):
    ratio = float(np.exp(fixed["sign"] * x))
    return on_world(setup, linear_density=setup.world.linear_density * ratio), {"ratio": ratio}


@effect(
    "lumped_mass", "world", (0.001, 1.0),
    lambda rng, c: {"centre": rng.uniform(0.2, 0.8) * c.world.length}, ("translation", "ramp_hold"),
)  # fmt: skip
def _(setup, fixed, x):
    return on_world(setup, lump=(fixed["centre"], x)), {"centre_m": fixed["centre"], "mass_kg": x}


@effect(
    "gripper_slip", "world", (0.0005, 0.08),
    lambda rng, c: {"gripper": int(rng.integers(2)), "time": rng.uniform(5.0, 12.0), "sign": sign(rng)},
)  # fmt: skip
def _(setup, fixed, x):
    slip = (fixed["gripper"], fixed["time"], fixed["sign"] * x)
    return on_world(setup, slip=slip), {"gripper": slip[0], "time_s": slip[1], "distance_m": slip[2]}


@effect(
    "gripper_rotation_offset", "world", (0.003, 0.7),
    lambda rng, c: {"gripper": int(rng.integers(2)), "sign": sign(rng)},
)  # fmt: skip
def _(setup, fixed, x):
    angle = fixed["sign"] * x
    offset = (angle, 0.0) if fixed["gripper"] == 0 else (0.0, angle)
    return on_world(setup, grasp_offset=offset), {"gripper": fixed["gripper"], "angle_rad": angle}


@effect("gripper_compliance", "world", (0.01, 8.0), lambda rng, c: {"gripper": int(rng.integers(2))})
def _(setup, fixed, x):
    # Stiffest where the grasp is as stiff as 2 mm of the cable.
    stiffness = float(500.0 * setup.world.stiffness * np.exp(-x))
    both = (stiffness, np.inf) if fixed["gripper"] == 0 else (np.inf, stiffness)
    return on_world(setup, grasp_stiffness=both), {
        "gripper": fixed["gripper"], "stiffness_n_m_per_rad": stiffness,
    }  # fmt: skip


@effect("actuation_gain", "arm", (0.003, 0.5), signed)
def _(setup, fixed, x):
    gain = 1.0 + fixed["sign"] * x
    return on_arm(setup, gain=gain), {"gain": gain}


@effect("actuation_lag", "arm", (0.01, 2.5), lambda rng, c: {"share": rng.uniform(0.3, 0.8)})
def _(setup, fixed, x):
    return on_arm(setup, lag=x, lag_share=fixed["share"]), {"time_s": x, "_delay_share": fixed["share"]}


def _similarity(rng, context):
    parts = rng.normal(size=4)
    return {"parts": (parts / np.linalg.norm(parts)).tolist()}


@effect("camera_similarity", "camera", (0.02, 8.0), _similarity)
def _(setup, fixed, x):
    scale, angle, dx, dy = (x * 0.02 * part for part in fixed["parts"])
    dx, dy = 0.5 * dx, 0.5 * dy
    return on_camera(setup, scale=1.0 + scale, angle=angle, offset=(dx, dy)), {
        "scale": 1.0 + scale, "angle_rad": angle, "x_m": dx, "y_m": dy,
    }  # fmt: skip


def _keypoint_bias(rng, context):
    index = sorted(rng.choice(np.arange(1, KEYPOINTS - 1), size=int(rng.integers(1, 4)), replace=False).tolist())
    return {"index": index, "sign": sign(rng), "direction": str(rng.choice(["along", "across"]))}


@effect("keypoint_bias", "camera", (0.001, 0.08), _keypoint_bias)
def _(setup, fixed, x):
    offset = fixed["sign"] * x
    shift = tuple(offset if k in fixed["index"] else 0.0 for k in range(KEYPOINTS))
    return on_camera(setup, **{f"shift_{fixed['direction']}": shift}), {
        "index": fixed["index"], "offset_m": [offset] * len(fixed["index"]), "_direction": fixed["direction"],
    }  # fmt: skip


@effect("camera_lag", "camera", (0.01, 2.5), lambda rng, c: {"share": rng.uniform(0.4, 1.0)})
def _(setup, fixed, x):
    return on_camera(setup, lag=x, lag_share=fixed["share"]), {"time_s": x, "_delay_share": fixed["share"]}


def _obstacle(rng, context):
    """A disc in the way of one material point, touched at no episode's start."""
    for _ in range(500):
        radius = rng.uniform(0.015, 0.04)
        motion = context.motions[rng.integers(len(context.motions))]
        n = motion.points.shape[1]
        i = int(rng.integers(n // 5, 4 * n // 5))
        way = motion.points[:, i] - motion.points[0, i]
        far = int(np.argmax(np.linalg.norm(way, axis=1)))
        length = float(np.linalg.norm(way[far]))
        if length < 0.04:
            continue
        tangent = motion.points[far, i + 1] - motion.points[far, i - 1]
        normal = np.array([-tangent[1], tangent[0]]) / np.linalg.norm(tangent)
        normal *= np.sign(normal @ way[far])
        if normal @ way[far] < 0.7 * length:
            continue
        deepest = 0.9 * float(normal @ way[far]) - 0.005
        beginning = np.concatenate([m.points[0] for m in context.motions])
        while deepest > 0.004:
            centre = motion.points[far, i] + normal * (radius - deepest)
            if np.linalg.norm(beginning - centre, axis=1).min() > radius + 0.004:
                break
            deepest -= 0.004
        if deepest > 0.02:
            return {
                "edge": motion.points[far, i].tolist(),
                "normal": normal.tolist(),
                "radius": radius,
                "deepest": deepest,
            }
    raise ValueError("No place for an obstacle next to these motions.")


@effect("obstacle", "world", (0.02, 1.0), _obstacle, ("ramp_hold", "approach_u"))
def _(setup, fixed, x):
    depth = x * fixed["deepest"]
    centre = np.array(fixed["edge"]) + np.array(fixed["normal"]) * (fixed["radius"] - depth)
    return on_world(setup, obstacle=(float(centre[0]), float(centre[1]), fixed["radius"])), {
        "x_m": float(centre[0]), "y_m": float(centre[1]), "radius_m": fixed["radius"],
    }  # fmt: skip


SPECIFIED = tuple(EFFECTS)
