"""Synthetic recordings of a cable in space whose parameters are known, for checks of the estimates.

Cables are drawn at random from wider ranges than the real ones span. The true cable is a rod with twice the edges of
the one that is fitted, and with eight time steps a sample, of which the search makes one where that is fine enough, and
the estimate four. Markers have a slow error and one that is new at every sample.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from cablejax.recordings.deform import NOMINAL, SAMPLE_INTERVAL, DeformRecordings
from cablejax.simulate.compile import compiler_options
from cablejax.simulate.rod import Rod, RodPhysics
from cablejax.simulate.rod.clamps import frames_along
from cablejax.spatial.effects import CURVATURE_KNOTS, PROFILE_KNOTS, TWIST_RATIO
from cablejax.spatial.identify import EDGES
from real_cables import composite

RECORDINGS, SAMPLES, MARKERS = 16, 100, 6
SPEED = 0.6
"""Of the grippers, root mean square [m/s]."""
# The cable swings in before the recording begins, so that it does not start at rest or at a guess.
_LEAD = 80
_REACH = 0.028  # from a gripper's outer to its inner marker [m]
_SLOW, _CORRELATION = 3e-4, 0.3  # slow error of a marker: standard deviation [m], correlation time [s]
_DISTINCT, _SOFTER = 1.3, 0.3  # least ratio of stiffness to the believed one, chance that it is the other way round
_UNDAMPED = 1e-3  # no cable is without any damping, and this does not show [s]
_DRAG = 0.2, 0.8  # range of both drags together at the grippers' speed [1/s]
_UNEVEN = 0.3  # least difference of the stiffness somewhere from its mean along the cable

Law = Literal["as fitted", "richer", "composite"]
"""Whether the true cable obeys the simulator that is fitted, or has a rest curvature, markers off its centreline and
grippers that roll besides, or is one of MuJoCo's."""
EFFECTS = ("bending_stiffness", "bending_damping", "drag", "stiffness_profile", "gripper_rotation_offset")
"""What a cable may have, by the names of the gap log; drag of either law is one, for motion hardly tells them apart."""


@dataclasses.dataclass(frozen=True)
class SyntheticCable:
    """What is true of a cable and of how it is held and seen.

    Attributes:
        stiffness: EI / rho, geometric mean over the knots of the profile [m^4/s^2].
        profile: logarithm of EI / rho over that mean, at evenly spaced knots along the cable, shape [K].
        length: between the clamps [m].
        damping_time: Kelvin-Voigt time constant of bending [s].
        drag: force per mass and speed [1/s].
        quadratic_drag: force per mass and squared speed [1/m].
        marker_mass: of each marker, as length of cable of the same mass [m].
        grips: slope of the cable against both grippers in every recording, the tangent of its angle, shape [R, 2, 2].
        noise: standard deviation of a coordinate, independent at every sample [m].
        rest_curvature: at evenly spaced knots, about the material's second and third axis [1/m], shape [C, 2].
        offset: of the free markers from the centreline [m], shape [N, 2].
        roll: of the grippers about the cable, root mean square [rad].
    """

    stiffness: float
    profile: Float[np.ndarray, "K"]
    length: float
    damping_time: float
    drag: float
    quadratic_drag: float
    marker_mass: float
    grips: Float[np.ndarray, "R 2 2"]
    noise: float
    rest_curvature: Float[np.ndarray, "C 2"]
    offset: Float[np.ndarray, "N 2"]
    roll: float

    @property
    def laden(self) -> float:
        """Mass of the cable with its markers over that of the bare one, see `effects.Layout.laden`."""
        return 1.0 + self.marker_mass * (len(self.offset) + 1) / self.length


def synthetic_recordings(
    seed: int, law: Law, recordings: int = RECORDINGS, *, present: Sequence[str] | None = None
) -> tuple[SyntheticCable, DeformRecordings]:
    """A cable and what motion capture saw of it, in so many recordings of `SAMPLES` samples.

    Args:
        seed: of all draws.
        law: that the cable obeys.
        recordings: how many.
        present: which of `EFFECTS` it has, see `with_effects`; None = all, of any size.

    Raises:
        FloatingPointError: the simulation of this cable broke down.
    """
    generator, more = np.random.default_rng(seed), np.random.default_rng((seed, 1))
    cable = drawn_cable(generator, recordings)
    if present is not None:
        cable = with_effects(cable, present, np.random.default_rng((seed, 2)))
    if law == "richer":
        cable = dataclasses.replace(
            cable,
            rest_curvature=0.5 * more.normal(size=(CURVATURE_KNOTS, 2)),
            offset=0.002 * more.normal(size=(MARKERS, 2)),
            roll=0.15,
        )
    position, direction = _motion(generator, recordings)
    roll = cable.roll * _vibrations(more, (recordings, 1, 2))
    s = np.linspace(0, cable.length, MARKERS + 2)[1:-1] + 0.003 * generator.normal(size=MARKERS)
    frames = _rolled(direction, roll)
    if law == "composite":
        free = composite.simulated(cable, s, position, frames, SAMPLE_INTERVAL)[:, _LEAD:]
    else:
        free = _simulated(cable, s, position, frames)
    if composite.broken(free):
        raise FloatingPointError(f"The simulation of cable {seed} ({law}) broke down.")
    outer = position + np.array([-1.0, 1.0])[:, None] * _REACH * direction
    ends = [part[:, _LEAD:] for part in (outer[:, :, :1], position[:, :, :1], position[:, :, 1:], outer[:, :, 1:])]
    points = np.concatenate([*ends[:2], free, *ends[2:]], axis=2)
    points = points + _slow_error(generator, points.shape)
    points = points + cable.noise * generator.normal(size=points.shape)
    names = np.arange(recordings)
    split = np.full(recordings, "train")
    return cable, DeformRecordings(points, SAMPLE_INTERVAL, split, names, names, f"seed {seed}, {law}")


def drawn_cable(generator: np.random.Generator, recordings: int) -> SyntheticCable:
    """A cable without the richer law, gripped again in every recording."""

    def between(low, high):
        return float(np.exp(generator.uniform(np.log(low), np.log(high))))

    profile = 0.25 * generator.normal(size=PROFILE_KNOTS)
    return SyntheticCable(
        stiffness=between(0.01, 0.2),
        profile=profile - profile.mean(),
        length=float(generator.uniform(0.85, 1.0)),
        damping_time=between(0.01, 0.1),
        drag=float(generator.uniform(0.0, 0.8)),
        quadratic_drag=float(generator.uniform(0.0, 0.3)),
        marker_mass=between(0.002, 0.04),
        grips=0.2 * generator.normal(size=(2, 2)) + 0.2 * generator.normal(size=(recordings, 2, 2)),
        noise=between(3e-5, 3e-4),
        rest_curvature=np.zeros((CURVATURE_KNOTS, 2)),
        offset=np.zeros((MARKERS, 2)),
        roll=0.0,
    )


def with_effects(cable: SyntheticCable, present: Sequence[str], generator: np.random.Generator) -> SyntheticCable:
    """The cable with some of `EFFECTS`, all but the grips large enough to show, and none of the others.

    Without `bending_stiffness` EI / rho is what is believed, rho with the markers.
    """
    ratio = np.exp(generator.uniform(np.log(_DISTINCT), np.log(10.0)))
    if generator.random() < _SOFTER:
        ratio = 1 / np.exp(generator.uniform(np.log(_DISTINCT), np.log(2.0)))
    linear, quadratic = generator.dirichlet([1.0, 1.0]) * generator.uniform(*_DRAG)
    uneven = np.abs(np.expm1(cable.profile)).max()
    has = {effect: effect in present for effect in EFFECTS}
    return dataclasses.replace(
        cable,
        stiffness=cable.laden * NOMINAL.stiffness_over_density * (ratio if has["bending_stiffness"] else 1.0),
        damping_time=cable.damping_time if has["bending_damping"] else _UNDAMPED,
        drag=linear * has["drag"],
        quadratic_drag=quadratic / SPEED * has["drag"],
        profile=cable.profile * max(1.0, _UNEVEN / uneven) * has["stiffness_profile"],
        grips=cable.grips * has["gripper_rotation_offset"],
    )


def _motion(generator: np.random.Generator, recordings: int) -> tuple[np.ndarray, np.ndarray]:
    """Fast motion of both grippers: positions [R, T, 2, 3] and directions along the cable [R, T, 2, 3].

    Vibrations with 6 cm root mean square make 0.6 m/s. The cable leaves one gripper downwards and comes up to the
    other, both turned by 0.2 rad.
    """
    shape = (recordings, 1, 2, 3)
    rates = [generator.uniform(low, high, (*shape, 3)) for low, high in [(0.3, 1.5), (0, 2 * np.pi)] * 2]
    position = np.array([[0.0, 0.0, 0.6], [0.5, 0.0, 0.6]]) + 0.06 * _sum_of_waves(*rates[:2])
    direction = np.array([[0.1, 0.0, -1.0], [0.1, 0.0, 1.0]]) + 0.15 * _sum_of_waves(*rates[2:])
    return position, direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def _vibrations(generator: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Root mean square 1; the second axis of the shape becomes time."""
    return _sum_of_waves(generator.uniform(0.3, 1.5, (*shape, 3)), generator.uniform(0, 2 * np.pi, (*shape, 3)))


def _sum_of_waves(rate, phase):
    time = SAMPLE_INTERVAL * np.arange(-_LEAD, SAMPLES).reshape(-1, *(1,) * (rate.ndim - 2))
    return math.sqrt(2 / 3) * np.sin(2 * np.pi * rate * time + phase).sum(axis=-1)


def _rolled(direction, roll):
    """Frames of the grippers, turned about the cable, shape [R, T, 2, 3, 3]."""
    frames = np.stack([frames_along(direction[:, :, q]) for q in range(2)], axis=2)
    along, second, third = np.moveaxis(frames, -2, 0)
    cosine, sine = np.cos(roll)[..., None], np.sin(roll)[..., None]
    return np.stack([along, cosine * second + sine * third, cosine * third - sine * second], axis=-2)


def _simulated(cable: SyntheticCable, s, position, frames) -> Float[np.ndarray, "R T N 3"]:
    """Free markers, from the beginning of the recordings on."""
    line = (s / cable.length)[:, None]
    sag = np.concatenate([0.5 * line, 0 * line, 0.6 - 0.35 * np.sin(np.pi * line)], axis=1)
    values: dict[str, Any] = {
        "length": cable.length, "stiffness": cable.stiffness * np.exp(cable.profile),
        "rest_curvature": cable.rest_curvature, "damping_time": cable.damping_time, "drag": cable.drag,
        "quadratic_drag": cable.quadratic_drag, "twist_stiffness": TWIST_RATIO * cable.stiffness, "stretch": 5e4,
        "marker_mass": cable.marker_mass, "arclength": s, "offset": cable.offset, "gravity": [0.0, 0.0, -9.81],
    }  # fmt: skip
    arrays: dict[str, Any] = {n: np.repeat(np.asarray(v, float)[None], len(position), 0) for n, v in values.items()}
    physics = RodPhysics(**arrays, clamp_rotation=cable.grips)  # pyright: ignore[reportArgumentType]
    twisting = bool(cable.rest_curvature.any() or cable.offset.any())
    with jax.enable_x64(True):
        return np.asarray(_program(twisting)(physics, position, frames, np.stack([sag, sag])))[:, _LEAD:]


@functools.cache
def _program(twisting: bool):
    rod = Rod(2 * EDGES, 8, twisting=twisting)

    def one(physics, position, frames, seen):
        return rod.rollout(physics, position, frames, seen, jnp.asarray(SAMPLE_INTERVAL)).points

    return jax.jit(jax.vmap(one, (0, 0, 0, None)), compiler_options=compiler_options())


def _slow_error(generator: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Autoregressive of first order along the second axis [m]."""
    keep = math.exp(-SAMPLE_INTERVAL / _CORRELATION)
    error = _SLOW * generator.normal(size=shape)
    for k in range(1, shape[1]):
        error[:, k] = keep * error[:, k - 1] + math.sqrt(1 - keep**2) * error[:, k]
    return error
