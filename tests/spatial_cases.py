"""A synthetic recording of a cable in space: a finer rod than the one that is fitted, seen through noise."""

from __future__ import annotations

import dataclasses
import functools

import jax
import numpy as np

from cablejax.cable import Cable
from cablejax.gaplog import Episode, gap_log_from_episodes
from cablejax.poses import twists
from cablejax.simulate.compile import compiler_options
from cablejax.simulate.rod import Rod, RodPhysics
from cablejax.simulate.rod.clamps import frames_along
from cablejax.spatial.windows import Windows, windows_of
from cablejax.types import GapLog

INTERVAL = 0.02
SAMPLES = 100
LENGTH = 0.9
NOISE = 5e-5
TRUE_RATIO, TRUE_DAMPING = 2.5, 0.03
NOMINAL = 0.02  # EI / rho [m^4/s^2]
_DENSITY = 0.04
# Keypoints 0, 1 and the last two are on the grippers.
REACH = 0.03
MARKS = np.linspace(0.1, 0.8, 6)


def arclength() -> np.ndarray:
    return np.concatenate([[0.0, REACH], REACH + MARKS, [REACH + LENGTH, 2 * REACH + LENGTH]])


def _motion(seed):
    """Clamp positions [T, 2, 3] and directions along the cable [T, 2, 3]."""
    generator = np.random.default_rng(seed)
    time = INTERVAL * np.arange(SAMPLES)
    phase, rate = generator.uniform(0, 2 * np.pi, (2, 3, 3)), generator.uniform(0.3, 1.2, (2, 3, 3))
    swing = 0.05 * np.sin(2 * np.pi * rate * time[:, None, None, None] + phase).sum(axis=3)
    position = np.array([[0.0, 0.0, 0.6], [0.5, 0.05, 0.55]]) + swing
    tilt = 0.1 * np.sin(2 * np.pi * 0.5 * time[:, None, None] + phase[:, :, 0])
    direction = np.array([[0.3, 0.1, -1.0], [0.2, -0.1, 1.0]]) + tilt
    return position, direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def physics(ratio=TRUE_RATIO, damping=TRUE_DAMPING, curvature=0.0) -> RodPhysics:
    rest = np.zeros((5, 2))
    rest[1:4, 0] = curvature
    return RodPhysics(
        length=np.asarray(LENGTH), stiffness=np.full(1, NOMINAL * ratio), rest_curvature=rest,
        damping_time=np.asarray(damping), drag=np.zeros(()), quadratic_drag=np.zeros(()),
        twist_stiffness=np.asarray(0.7 * NOMINAL), stretch=np.asarray(5e4), marker_mass=np.zeros(()),
        clamp_rotation=np.zeros((2, 2)), arclength=MARKS,
        offset=np.zeros((len(MARKS), 2)), gravity=np.array([0.0, 0.0, -9.81]),
    )  # fmt: skip


@functools.cache
def recording(episodes: int = 4, regripped: int | None = None) -> GapLog:
    """A gap log in space of a cable that is stiffer than believed, and damped; every episode is a recording.

    Args:
        episodes: how many.
        regripped: the episode whose first two keypoints are 8 mm nearer to each other.
    """
    motions = [_motion(seed) for seed in range(episodes)]
    position, direction = (np.stack([m[k] for m in motions]) for k in range(2))
    frames = np.stack([frames_along(direction[:, :, q]) for q in range(2)], axis=2)
    # more edges and shorter steps than those from which an estimate is corrected
    rod = Rod(60, 8, twisting=False)
    # from hanging still, so that the first two samples are a cable at equilibrium
    still = [np.concatenate([np.repeat(a[:, :1], 60, 1), a], axis=1) for a in (position, frames)]
    line = np.linspace(0, 1, len(MARKS) + 2)[1:-1, None]
    sag = -0.3 * np.sin(np.pi * line) * np.array([0, 0, 1.0])
    guess = position[:, 0, :1] * (1 - line) + position[:, 0, 1:] * line + sag
    with jax.enable_x64(True):
        run = jax.jit(
            jax.vmap(lambda p, f, g: rod.rollout(physics(), p, f, np.ones((2, 1, 1)) * g, INTERVAL).points),
            compiler_options=compiler_options(),
        )
        points = np.asarray(run(*still, guess))[:, 60:]
    generator = np.random.default_rng(0)
    rows = []
    for e in range(episodes):
        reach = REACH - 0.008 * (e == regripped)
        outer0 = position[e, :, 0] - reach * direction[e, :, 0]
        outer1 = position[e, :, 1] + REACH * direction[e, :, 1]
        marks = np.concatenate(
            [outer0[:, None], position[e, :, :1], points[e], position[e, :, 1:], outer1[:, None]], axis=1
        )
        pose = np.concatenate([np.stack([outer0, outer1], axis=1), _quaternions(direction[e])], axis=-1)
        time = INTERVAL * np.arange(SAMPLES)
        rows.append(
            Episode(
                motion="recorded",
                time=time,
                keypoints=marks + NOISE * generator.standard_normal(marks.shape),
                gripper_pose=pose,
                gripper_command=twists(time, pose),
                hold=np.zeros(SAMPLES, bool),
            )
        )
    cable = Cable(
        length=LENGTH + 2 * REACH, n_keypoints=len(MARKS) + 4, bending_stiffness=NOMINAL * _DENSITY, diameter=0.006,
        linear_density=_DENSITY, damping_time=0.0, friction_coefficient=0.0,
    )  # fmt: skip
    log = gap_log_from_episodes(rows, cable, source="synthetic")
    log.meta["keypoint_arclength_m"] = arclength().tolist()
    return log


def swinging(times: int) -> Windows:
    """Windows of a motion there, back and there again, the first so many of the three."""
    windows = windows_of(recording())
    longer = {
        name: np.concatenate([a, np.flip(a, axis=1), a][:times], axis=1)
        for name in ("keypoints", "position", "frames", "valid")
        for a in [getattr(windows, name)]
    }
    return dataclasses.replace(windows, **longer)


def _quaternions(direction):
    """The smallest rotation from x to the direction."""
    w = 1 + direction[..., 0]
    q = np.stack([w, 0 * w, -direction[..., 2], direction[..., 1]], axis=-1)
    return q / np.linalg.norm(q, axis=-1, keepdims=True)
