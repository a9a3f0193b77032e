"""Synthetic recordings of a cable in space whose parameters are known, for checks of the estimates.

Cables are drawn at random from far wider ranges than the real ones span: 0.3 to 3 m, EI / rho of 0.0003 to 0.3 m^4/s^2.
The true cable is a rod of 64 edges, with eight time steps a sample, of which the search makes one where that is fine
enough, and the estimate four. Markers have a slow error and one that is new at every sample. In some recordings a
gripper is struck, a marker is not seen for a while, or another point is taken for it.
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

from cablejax.recordings.deform import SAMPLE_INTERVAL, DeformRecordings
from cablejax.simulate.compile import compiler_options
from cablejax.simulate.rod import Rod, RodPhysics
from cablejax.simulate.rod.clamps import frames_along
from cablejax.spatial.effects import CURVATURE_KNOTS, PROFILE_KNOTS, TWIST_RATIO
from cablejax.spatial.identify import EDGES
from real_cables import composite

STIFFNESS, LENGTH = (0.0003, 0.3), (0.3, 3.0)
"""Ranges of EI / rho, markers included [m^4/s^2], and of the length between the clamps [m]."""
MARKERS = 6, 9
"""Free ones: one of these numbers."""
_TRUE, _QUICK = Rod(64, 8), Rod(EDGES, 2)
# The cable swings in before the recording begins, so that it does not start at rest or at a guess.
_LEAD = 80
_REACH = 0.028  # from a gripper's outer to its inner marker [m]
_SLOW, _CORRELATION = 3e-4, 0.3  # slow error of a marker: standard deviation [m], correlation time [s]
_DISTINCT, _SOFTER = 1.3, 0.3  # least ratio of stiffness to the believed one, chance that it is the other way round
_UNDAMPED = 1e-3  # no cable is without any damping, and this does not show [s]
_DRAG = 0.2, 0.8  # range of both drags together at the grippers' speed [1/s]
_UNEVEN = 0.3  # least difference of the stiffness somewhere from its mean along the cable
_RATES = 0.3, 1.5  # of the grippers' vibrations [Hz]
_SPEED = 0.3, 1.2  # of the grippers, root mean square [m/s]
_LIVELY = 0.65  # and over the cable's length, at most [1/s]
_STRUCK, _STROKE = 0.08, (30.0, 300.0)  # a stroke to a gripper: its time [s], the largest acceleration [m/s^2]
_SHORT_STROKE = 0.05  # as a share of the length it moves the gripper no further
_CHANCE = 0.2  # of a stroke, a gap and a wrong point in each recording
_GAP, _WRONG = (0.05, 0.3), (0.03, 0.1)  # how long a marker is not seen [s], how far the wrong point is [m]

Law = Literal["as fitted", "richer", "composite"]
"""Whether the true cable obeys the simulator that is fitted, or has a rest curvature, markers off its centreline and
grippers that roll besides, or is one of MuJoCo's."""
EFFECTS = ("bending_stiffness", "bending_damping", "drag", "stiffness_profile", "gripper_rotation_offset")
"""What a cable may have, by the names of the gap log; drag of either law is one, for motion hardly tells them apart."""


@dataclasses.dataclass(frozen=True)
class SyntheticCable:
    """What is true of a cable and of how it is held, moved and seen.

    Attributes:
        believed: EI / rho that its user takes it to have, rho with the markers [m^4/s^2].
        stiffness: EI / rho of the bare cable, geometric mean over the knots of the profile [m^4/s^2].
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
        span: mean distance of the grippers over the length.
        speed: of the grippers, root mean square [m/s].
    """

    believed: float
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
    span: float
    speed: float

    @property
    def laden(self) -> float:
        """Mass of the cable with its markers over that of the bare one, see `effects.Layout.laden`."""
        return 1.0 + self.marker_mass * (len(self.offset) + 1) / self.length

    def without(self, effect: str) -> SyntheticCable:
        """The cable without one of `EFFECTS`.

        Without `bending_stiffness` EI / rho is what is believed; without `bending_damping` it is damped so little that
        this does not show.
        """
        match effect:
            case "bending_stiffness":
                return dataclasses.replace(self, stiffness=self.laden * self.believed)
            case "bending_damping":
                return dataclasses.replace(self, damping_time=_UNDAMPED)
            case "drag":
                return dataclasses.replace(self, drag=0.0, quadratic_drag=0.0)
            case "stiffness_profile":
                return dataclasses.replace(self, profile=np.zeros_like(self.profile))
            case "gripper_rotation_offset":
                return dataclasses.replace(self, grips=np.zeros_like(self.grips))
        raise ValueError(f"The effect is {effect!r}, expected one of {', '.join(EFFECTS)}.")


@dataclasses.dataclass(frozen=True)
class Synthetic:
    """A cable, and what motion capture saw of it.

    Attributes:
        cable: the true one.
        recordings: of it, with accidents as they come: nothing in them is repaired.
        arclength: of the free markers from the first gripper [m].
        position, frames: of the grippers, from before the recording on.
    """

    cable: SyntheticCable
    recordings: DeformRecordings
    arclength: Float[np.ndarray, "N"]
    position: Float[np.ndarray, "R S 2 3"]
    frames: Float[np.ndarray, "R S 2 3 3"]

    def moved_by(self, effect: str) -> float:
        """How far one of `EFFECTS` moves the markers by the law that is fitted: median over samples and markers [m]."""
        plain = dataclasses.replace(self.cable, rest_curvature=np.zeros((CURVATURE_KNOTS, 2)))
        plain = dataclasses.replace(plain, offset=np.zeros_like(plain.offset))
        has, lacks = (
            _simulated(cable, self.arclength, self.position, self.frames, _QUICK)
            for cable in (plain, plain.without(effect))
        )
        return float(np.nanmedian(np.linalg.norm(has - lacks, axis=-1)))


def synthetic_recordings(
    seed: int, law: Law, recordings: int, samples: int, *, present: Sequence[str] | None = None
) -> Synthetic:
    """A cable and what motion capture saw of it, in so many recordings of so many samples.

    Args:
        seed: of all draws.
        law: that the cable obeys.
        recordings: how many.
        samples: of each.
        present: which of `EFFECTS` it has, see `with_effects`; None = all, of any size.

    Raises:
        FloatingPointError: the simulation of this cable broke down.
    """
    generator, more = np.random.default_rng(seed), np.random.default_rng((seed, 1))
    cable = drawn_cable(generator, recordings)
    if present is not None:
        cable = with_effects(cable, present, np.random.default_rng((seed, 2)))
    count = len(cable.offset)
    if law == "richer":
        cable = dataclasses.replace(
            cable,
            rest_curvature=0.5 * more.normal(size=(CURVATURE_KNOTS, 2)),
            offset=0.002 * more.normal(size=(count, 2)),
            roll=0.15,
        )
    if law == "composite":
        damping = min(cable.damping_time, composite.longest_damping(cable))
        cable = dataclasses.replace(cable, damping_time=damping)
    position, direction = _motion(cable, generator, recordings, samples)
    roll = cable.roll * _vibrations(more, (recordings, 1, 2), samples)
    spread = 0.003 * min(1.0, cable.length)
    s = np.linspace(0, cable.length, count + 2)[1:-1] + spread * generator.normal(size=count)
    frames = _rolled(direction, roll)
    if law == "composite":
        free = composite.simulated(cable, s, position, frames, SAMPLE_INTERVAL)[:, _LEAD:]
    else:
        free = _simulated(cable, s, position, frames)
    if composite.broken(free, cable.length):
        raise FloatingPointError(f"The simulation of cable {seed} ({law}) broke down.")
    outer = position + np.array([-1.0, 1.0])[:, None] * _REACH * direction
    ends = [part[:, _LEAD:] for part in (outer[:, :, :1], position[:, :, :1], position[:, :, 1:], outer[:, :, 1:])]
    points = np.concatenate([*ends[:2], free, *ends[2:]], axis=2)
    points = points + _slow_error(generator, points.shape)
    points = points + cable.noise * generator.normal(size=points.shape)
    points = _misread(points, np.random.default_rng((seed, 4)))
    names = np.arange(recordings)
    split = np.full(recordings, "train")
    seen = DeformRecordings(points, SAMPLE_INTERVAL, split, names, names, f"seed {seed}, {law}")
    return Synthetic(cable, seen, s, position, frames)


def drawn_cable(generator: np.random.Generator, recordings: int) -> SyntheticCable:
    """A cable without the richer law, gripped again in every recording."""

    def between(low, high):
        return float(np.exp(generator.uniform(np.log(low), np.log(high))))

    markers, length, stiffness = int(generator.choice(MARKERS)), between(*LENGTH), between(*STIFFNESS)
    ratio = between(_DISTINCT, 10.0)
    if generator.random() < _SOFTER:
        ratio = 1 / between(_DISTINCT, 2.0)
    profile = 0.25 * generator.normal(size=PROFILE_KNOTS)
    cable = SyntheticCable(
        believed=stiffness / ratio,
        stiffness=stiffness,
        profile=profile - profile.mean(),
        length=length,
        damping_time=between(0.01, 0.3),
        drag=float(generator.uniform(0.0, 0.8)),
        quadratic_drag=float(generator.uniform(0.0, 0.3)),
        marker_mass=between(0.002, min(0.04, 0.04 * length)),
        grips=0.2 * generator.normal(size=(2, 2)) + 0.2 * generator.normal(size=(recordings, 2, 2)),
        noise=between(3e-5, 3e-4),
        rest_curvature=np.zeros((CURVATURE_KNOTS, 2)),
        offset=np.zeros((markers, 2)),
        roll=0.0,
        span=float(generator.uniform(0.35, 0.6)),
        speed=min(between(*_SPEED), _LIVELY * length),
    )
    return dataclasses.replace(cable, stiffness=cable.laden * cable.stiffness)


def with_effects(cable: SyntheticCable, present: Sequence[str], generator: np.random.Generator) -> SyntheticCable:
    """The cable with some of `EFFECTS`, of no negligible size, and none of the others."""
    linear, quadratic = generator.dirichlet([1.0, 1.0]) * generator.uniform(*_DRAG)
    uneven = np.abs(np.expm1(cable.profile)).max()
    cable = dataclasses.replace(
        cable,
        drag=linear,
        quadratic_drag=quadratic / cable.speed,
        profile=cable.profile * max(1.0, _UNEVEN / uneven),
    )
    if "bending_stiffness" not in present:  # what is believed is true then
        cable = dataclasses.replace(cable, believed=cable.stiffness / cable.laden)
    for effect in EFFECTS:
        cable = cable if effect in present else cable.without(effect)
    return cable


def _motion(
    cable: SyntheticCable, generator: np.random.Generator, recordings: int, samples: int
) -> tuple[np.ndarray, np.ndarray]:
    """Motion of both grippers: positions [R, S, 2, 3] and directions along the cable [R, S, 2, 3].

    The cable leaves one gripper downwards and comes up to the other, both turned by 0.2 rad. In some recordings one of
    them is struck: it moves aside and back.
    """
    shape = (recordings, 1, 2, 3)
    moved, turned = (_vibrations(generator, shape, samples) for _ in range(2))
    # the root mean square of three coordinates' speeds, each of its amplitude times 2 pi times the rate's
    square = (_RATES[1] ** 3 - _RATES[0] ** 3) / (3 * (_RATES[1] - _RATES[0]))
    amplitude = cable.speed / (2 * np.pi * math.sqrt(3 * square))
    position = amplitude * moved
    position = position + cable.span * cable.length * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    direction = np.array([[0.1, 0.0, -1.0], [0.1, 0.0, 1.0]]) + 0.15 * turned
    for recording in np.flatnonzero(generator.random(recordings) < _CHANCE):
        _strike(position[recording], cable.length, generator)
    return position, direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def _strike(motion: Float[np.ndarray, "S 2 3"], length: float, generator: np.random.Generator) -> None:
    """Moves one gripper aside and back, within the recording."""
    lasts = round(_STRUCK / SAMPLE_INTERVAL)
    begin = generator.integers(_LEAD + 5, len(motion) - lasts - 5)
    way = generator.normal(size=3)
    acceleration = np.exp(generator.uniform(*np.log(_STROKE)))
    far = min(2 * acceleration * (_STRUCK / (2 * np.pi)) ** 2, _SHORT_STROKE * length)
    bump = 0.5 * far * (1 - np.cos(2 * np.pi * np.arange(lasts) / lasts))
    motion[begin : begin + lasts, generator.integers(2)] += bump[:, None] * way / np.linalg.norm(way)


def _misread(points: Float[np.ndarray, "R T M 3"], generator: np.random.Generator) -> Float[np.ndarray, "R T M 3"]:
    """What the cameras make of it: a free marker that is not seen for a while, or another point in place of one."""
    points = points.copy()
    for recording in points:
        gap, wrong = generator.random(2) < _CHANCE
        one, other = generator.integers(2, points.shape[2] - 2, 2)
        if gap:
            lasts = round(generator.uniform(*_GAP) / SAMPLE_INTERVAL)
            begin = generator.integers(2, len(recording) - lasts)
            recording[begin : begin + lasts, one] = np.nan
        if wrong:
            begin, way = generator.integers(2, len(recording) - 3), generator.normal(size=3)
            far = generator.uniform(*_WRONG) / np.linalg.norm(way)
            recording[begin : begin + generator.integers(1, 4), other] += far * way
    return points


def _vibrations(generator: np.random.Generator, shape: tuple[int, ...], samples: int) -> np.ndarray:
    """Sums of three waves, root mean square 1; the second axis of the shape becomes time."""
    rate, phase = generator.uniform(*_RATES, (*shape, 3)), generator.uniform(0, 2 * np.pi, (*shape, 3))
    time = SAMPLE_INTERVAL * np.arange(-_LEAD, samples).reshape(-1, *(1,) * (rate.ndim - 2))
    return math.sqrt(2 / 3) * np.sin(2 * np.pi * rate * time + phase).sum(axis=-1)


def _rolled(direction, roll):
    """Frames of the grippers, turned about the cable, shape [R, T, 2, 3, 3]."""
    frames = np.stack([frames_along(direction[:, :, q]) for q in range(2)], axis=2)
    along, second, third = np.moveaxis(frames, -2, 0)
    cosine, sine = np.cos(roll)[..., None], np.sin(roll)[..., None]
    return np.stack([along, cosine * second + sine * third, cosine * third - sine * second], axis=-2)


def _simulated(cable: SyntheticCable, s, position, frames, rod: Rod = _TRUE) -> Float[np.ndarray, "R T N 3"]:
    """Free markers, from the beginning of the recordings on; NaN from where on no time step was solved."""
    guess = np.stack([composite.hanging(cable.length, motion[0], s) for motion in position])
    values: dict[str, Any] = {
        "length": cable.length, "stiffness": cable.stiffness * np.exp(cable.profile),
        "rest_curvature": cable.rest_curvature, "damping_time": cable.damping_time, "drag": cable.drag,
        "quadratic_drag": cable.quadratic_drag, "twist_stiffness": TWIST_RATIO * cable.stiffness, "stretch": 5e4,
        "marker_mass": cable.marker_mass, "arclength": s, "offset": cable.offset, "gravity": [0.0, 0.0, -9.81],
    }  # fmt: skip
    arrays: dict[str, Any] = {n: np.repeat(np.asarray(v, float)[None], len(position), 0) for n, v in values.items()}
    physics = RodPhysics(**arrays, clamp_rotation=cable.grips)  # pyright: ignore[reportArgumentType]
    rod = dataclasses.replace(rod, twisting=bool(cable.rest_curvature.any() or cable.offset.any()))
    with jax.enable_x64(True):
        points, solved = map(np.asarray, _program(rod)(physics, position, frames, np.stack([guess, guess], axis=1)))
    reached = np.arange(points.shape[1]) < solved[:, None]
    return np.where(reached[:, :, None, None], points, np.nan)[:, _LEAD:]


@functools.cache
def _program(rod: Rod):
    def one(physics, position, frames, seen):
        found = rod.rollout(physics, position, frames, seen, jnp.asarray(SAMPLE_INTERVAL))
        return found.points, found.solved

    return jax.jit(jax.vmap(one), compiler_options=compiler_options())


def _slow_error(generator: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Autoregressive of first order along the second axis [m]."""
    keep = math.exp(-SAMPLE_INTERVAL / _CORRELATION)
    error = _SLOW * generator.normal(size=shape)
    for k in range(1, shape[1]):
        error[:, k] = keep * error[:, k - 1] + math.sqrt(1 - keep**2) * error[:, k]
    return error
