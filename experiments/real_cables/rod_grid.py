"""Motions of cables in space over wide ranges of stiffness, length and damping, to try the rod's time step on."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq

from cablejax.simulate.compile import compiler_options
from cablejax.simulate.rod import Rod, RodPhysics
from cablejax.simulate.rod.clamps import frames_along
from cablejax.simulate.rod.rod import Rollout

INTERVAL, SECONDS, MARKERS = 0.01, 5.0, 9
STIFFNESS = (0.0003, 0.003, 0.03, 0.3)
LENGTH = (0.3, 1.0, 3.0)
DAMPING = (0.0, 0.03, 1.0)
MOTIONS = ("hand", "jerk", "loop", "taut")
_CHORD = 0.6
# Of the jerks: clamp acceleration [m/s^2], and samples during which it acts, then acts backwards.
_ACCELERATION, _SAMPLES = 300.0, 2


@dataclasses.dataclass(frozen=True)
class Case:
    """A cable and how its second clamp is moved.

    Attributes:
        stiffness: EI / rho [m^4/s^2].
        length: between the clamps [m].
        damping_time: Kelvin-Voigt time constant of bending [s].
        motion: one of `MOTIONS`: "hand" waves the clamp about; "jerk" accelerates it by 300 m/s^2 once a second; "loop"
            carries it past the other clamp, so that the cable lies in a loop; "taut" pulls until the cable is straight.
    """

    stiffness: float
    length: float
    damping_time: float
    motion: str


def every_case() -> list[Case]:
    """All combinations."""
    return [Case(*values) for values in itertools.product(STIFFNESS, LENGTH, DAMPING, MOTIONS)]


def physics_of(case: Case) -> RodPhysics:
    """Parameters of the simulator, with a little drag."""
    arclength = np.linspace(0, case.length, MARKERS + 2)[1:-1]
    values: dict[str, Any] = {
        "length": case.length, "stiffness": np.full(1, case.stiffness), "rest_curvature": np.zeros((1, 2)),
        "damping_time": case.damping_time, "drag": 0.1, "quadratic_drag": 0.0, "twist_stiffness": 0.7 * case.stiffness,
        "stretch": 5e4, "marker_mass": 0.0, "clamp_rotation": np.zeros((2, 2)), "arclength": arclength,
        "offset": np.zeros((MARKERS, 2)), "gravity": np.array([0.0, 0.0, -9.81]),
    }  # fmt: skip
    # arrays of numpy keep double precision until they are simulated
    fields: dict[str, Any] = {name: np.asarray(value, float) for name, value in values.items()}
    return RodPhysics(**fields)


def inputs_of(case: Case, seconds: float = SECONDS) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Clamp positions [T, 2, 3], gripper frames [T, 2, 3, 3], and the markers at the beginning [2, N, 3]."""
    time = INTERVAL * np.arange(round(seconds / INTERVAL))
    second = case.length * (np.array([_CHORD, 0.0, 0.0]) + _moved(case.motion, time))
    if case.motion == "jerk":
        second = second + _jerks(time)[:, None] * np.array([0.0, 0.8, 0.6])
    position = np.stack([np.zeros_like(second), second], axis=1)
    direction = np.broadcast_to(np.array([[0.3, 0, -1.0], [0.3, 0, 1.0]]) / np.hypot(1.0, 0.3), position.shape)
    frames = np.stack([frames_along(direction[:, q]) for q in range(2)], axis=1)
    markers = case.length * _hanging()
    return position, frames, np.stack([markers, markers])


def rollouts(
    cases: Sequence[Case], *, substeps: int = 1, seconds: float = SECONDS, batch: int = 4, edges: int = 20
) -> Rollout:
    """Simulates cases, arrays with the cases first."""
    run, parts = _compiled(Rod(edges, substeps, twisting=False)), []
    for begin in range(0, len(cases), batch):
        # one size of a batch, so that one compilation serves
        group = [*cases[begin : begin + batch]]
        full, count = group + [group[0]] * (batch - len(group)), len(group)
        arguments = jax.tree.map(
            lambda *leaves: np.stack(leaves), *[(physics_of(c), *inputs_of(c, seconds)) for c in full]
        )
        with jax.enable_x64(True):
            found = run(*arguments)
            parts.append(jax.tree.map(lambda leaf, n=count: np.asarray(leaf)[:n], found))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


@functools.cache
def _compiled(rod: Rod):
    def one(physics, position, frames, seen):
        return rod.rollout(physics, position, frames, seen, INTERVAL)

    return jax.jit(jax.vmap(one), compiler_options=compiler_options())


def _moved(motion: str, time: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T 3"]:
    """Of the second clamp from where it begins, over the cable's length."""
    slow = 0.5 * (1 - np.cos(2 * np.pi * time / 2.5))
    match motion:
        case "hand":
            waves = [np.sin(2 * np.pi * rate * time + k) - np.sin(k) for k, rate in enumerate((0.9, 1.3, 0.6))]
            return 0.08 * np.stack(waves, axis=1)
        case "loop":
            return slow[:, None] * np.array([-1.0, 0.06, 0.1])
        case "taut":
            return slow[:, None] * np.array([1.001 - _CHORD, 0.0, 0.0])
    return np.zeros((len(time), 3))


def _jerks(time: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
    """Distance [m] that the clamp is jerked to and fro, once a second."""
    acceleration = np.zeros(len(time))
    for k, begin in enumerate(range(round(0.5 / INTERVAL), len(time) - 2 * _SAMPLES, round(1.0 / INTERVAL))):
        sign = 1.0 - 2.0 * (k % 2)
        acceleration[begin : begin + _SAMPLES] = sign * _ACCELERATION
        acceleration[begin + _SAMPLES : begin + 2 * _SAMPLES] = -sign * _ACCELERATION
    return np.cumsum(np.cumsum(acceleration)) * INTERVAL**2


def _hanging() -> Float[np.ndarray, "N 3"]:
    """Markers at equal distances along a half wave of unit length that hangs over the chord."""
    line = np.linspace(0, 1, 4001)

    def curve(depth):
        points = np.stack([_CHORD * line, 0 * line, -depth * np.sin(np.pi * line)], axis=1)
        return points, np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])

    points, along = curve(brentq(lambda depth: curve(depth)[1][-1] - 1.0, 0.01, 1.0))
    wanted = np.linspace(0, 1, MARKERS + 2)[1:-1]
    return np.stack([np.interp(wanted, along, points[:, k]) for k in range(3)], axis=1)
