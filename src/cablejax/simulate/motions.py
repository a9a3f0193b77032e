"""Random gripper motions within what a cable can bear."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from cablejax.cable import Cable, Discretisation
from cablejax.limits import check
from cablejax.simulate import compiled_equilibrium
from cablejax.simulate.compiled_equilibrium import walk
from cablejax.simulate.composite import link_lengths
from cablejax.simulate.equilibrium import arch_angles, find_equilibrium
from cablejax.types import ROTATION_WEIGHT

_COARSE_LINKS = 13
# Poses that are drawn before the bounds are said to exclude all of them.
_DRAWS = 10_000
# Angle of both grippers at a straight start, by which the cable leans to a side [rad].
_LEAN = 0.01


@dataclasses.dataclass(frozen=True)
class MotionConfig:
    """Settings of random gripper motions, and bounds on their poses.

    Velocities follow a first-order autoregressive process in each gripper's (vx, vy, omega). Its scale and persistence
    are drawn separately for every trajectory, so that the data hold slow and fast, jerky and steady motions.

    Attributes:
        start: "straight" (ends almost the full length apart, aligned) or "random" poses.
        max_step: bound of `sqrt(vx^2 + vy^2 + (rotation_weight omega)^2)` times the interval [m].
        rotation_weight: metres that one radian counts for [m/rad].
        min_scale: the slowest trajectories move at this fraction of the bound.
        max_persistence: correlation of the velocity from step to step is drawn from [0, max_persistence].
        rest_probability: chance that the grippers stand still for one step.
        straight_slack: of a straight start, relative to the length. A cable without slack could not move at all.
        min_distance: least distance of the grippers, relative to the length.
        max_angle: largest angle between a gripper and the line through both [rad].
        max_curvature: that the grippers may force upon the cable near taut [1/m].
        max_amplification: largest movement of any point of the cable's equilibrium, relative to the sum of the
            grippers' movements. The limit keeps the cable from snapping through to another shape, which a small change
            of the start can delay or prevent. A large number lets it snap.
    """

    start: Literal["straight", "random"] = "straight"
    max_step: float = 0.05
    rotation_weight: float = ROTATION_WEIGHT
    min_scale: float = 0.1
    max_persistence: float = 0.95
    rest_probability: float = 0.05
    straight_slack: float = 0.002
    min_distance: float = 0.15
    max_angle: float = 2.2
    max_curvature: float = 12.0
    max_amplification: float = 1.5

    @classmethod
    def for_length(cls, length: float, **settings: Any) -> MotionConfig:
        """The defaults for a cable of this length [m]: lengths in proportion to it, curvature inversely.

        Cables of any length then make the same shapes and motions, relative to their length.
        """
        ratio = length / Cable.length
        return cls(
            max_step=ratio * cls.max_step,
            rotation_weight=ratio * cls.rotation_weight,
            max_curvature=cls.max_curvature / ratio,
            **settings,
        )

    def __post_init__(self):
        if self.start not in ("straight", "random"):
            raise ValueError(f"MotionConfig.start is {self.start!r}, expected 'straight' or 'random'.")
        check(
            self,
            max_step="length_scale",
            rotation_weight="length_scale",
            min_scale="share",
            max_persistence="probability",
            rest_probability="probability",
            straight_slack="share",
            min_distance="share",
            max_angle="angle",
            max_curvature="positive",
            max_amplification="amplification",
        )


def random_motion(
    rng: np.random.Generator,
    config: Discretisation,
    n_steps: int,
    motion: MotionConfig = MotionConfig(),
    interval: float = 1.0,
) -> tuple[Float[np.ndarray, "Q 3"], Float[np.ndarray, "T Q 3"]]:
    """Draws a start pose and n_steps twists.

    Every pose on the way is within `admissible`, and no command makes the frictionless cable snap through.

    Args:
        rng: source of all randomness.
        config: the cable.
        n_steps: number of commands T.
        motion: see `MotionConfig`.
        interval: duration of each command [s].

    Returns:
        Gripper poses (x, y, theta) at the start [Q, 3] and twists [T, Q, 3] in m/s and rad/s.
    """
    start = _straight_start if motion.start == "straight" else _random_start
    pose = start(rng, config, motion)
    coarse = dataclasses.replace(config, n_links=min(config.n_links, _COARSE_LINKS))
    scale = np.exp(rng.uniform(np.log(motion.min_scale), 0.0))
    persistence = rng.uniform(0.0, motion.max_persistence)
    unit = np.array([1.0, 1.0, 1.0 / motion.rotation_weight]) * scale * motion.max_step / interval / np.sqrt(2.0)
    twists = walk(
        rng,
        link_lengths(coarse),
        pose,
        find_equilibrium(coarse, pose, arch_angles(coarse, pose)).angles,
        n_steps,
        float(interval),
        unit,
        persistence,
        float(motion.rest_probability),
        (motion.max_step / interval, float(motion.rotation_weight)),
        float(motion.max_amplification),
        _limits(config, motion),
    )
    return pose, twists


def twist_size(twist: Float[np.ndarray, "Q 3"], rotation_weight: float) -> Float[np.ndarray, "Q"]:
    """`sqrt(vx^2 + vy^2 + (rotation_weight omega)^2)` of each gripper [m/s]."""
    return np.linalg.norm(twist * np.array([1.0, 1.0, rotation_weight]), axis=-1)


def admissible(config: Discretisation, motion: MotionConfig, pose: Float[np.ndarray, "Q 3"]) -> bool:
    """Whether the cable can take these poses without being pulled taut or bent beyond `max_curvature` at a grip.

    An end that leaves the line through both grippers at angle a must bend there and back. On arcs of radius
    R = 1 / max_curvature this takes 2 R (|a| - sin |a|) of the length.
    """
    return bool(compiled_equilibrium.admissible(np.asarray(pose, np.float64), _limits(config, motion)))


def _limits(config: Discretisation, motion: MotionConfig) -> tuple[float, float, float, float]:
    """The arguments `limits` of the compiled functions."""
    length = config.cable.length
    shortest, longest = motion.min_distance * length, (1.0 - motion.straight_slack) * length
    return shortest, longest, float(motion.max_curvature), float(motion.max_angle)


def _straight_start(rng, config, motion):
    """Aligned grippers along a random direction; the slack lets the cable lean to a random side."""
    half = 0.5 * config.cable.length * (1.0 - 1.5 * motion.straight_slack)
    lean = rng.choice([-1.0, 1.0]) * _LEAN
    heading = rng.uniform(-np.pi, np.pi)
    offset = half * np.array([np.cos(heading), np.sin(heading)])
    pose = np.array([[*-offset, heading + lean], [*offset, heading - lean]])
    if not admissible(config, motion, pose):
        raise ValueError(
            f"A straight start is out of the bounds of MotionConfig: grippers {1 - 1.5 * motion.straight_slack:g} "
            f"lengths apart, {_LEAN:g} rad from their line. Widen min_distance or max_angle, or make straight_slack "
            "smaller."
        )
    return pose


def _random_start(rng, config, motion):
    for _ in range(_DRAWS):
        half = 0.5 * config.cable.length * rng.uniform(motion.min_distance, 1.0)
        heading = rng.uniform(-np.pi, np.pi)
        offset = half * np.array([np.cos(heading), np.sin(heading)])
        angles = heading + rng.uniform(-motion.max_angle, motion.max_angle, 2)
        pose = np.array([[*-offset, angles[0]], [*offset, angles[1]]])
        if admissible(config, motion, pose):
            return pose
    raise ValueError(
        f"None of {_DRAWS} random starts keeps the bounds of MotionConfig: grippers {motion.min_distance:g} to "
        f"{1 - motion.straight_slack:g} lengths apart, at most {motion.max_angle:g} rad from their line and "
        f"{motion.max_curvature:g} /m. Widen them: min_distance, straight_slack, max_angle or max_curvature."
    )
