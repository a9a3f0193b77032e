"""Small synthetic gap logs: the diagnosing simulator's own chain with any effects in it, seen through a noisy camera.

Four episodes of ten seconds, each a motion that tells other causes apart, with the grippers at rest before and after.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from cablejax.cable import Cable, Discretisation
from cablejax.diagnose import LIBRARY, CableEffect, explanation
from cablejax.diagnose.case import FINE_LINKS
from cablejax.diagnose.evidence import Evidence
from cablejax.diagnose.planar import PlanarCable, physics_of
from cablejax.diagnose.playback import Playback
from cablejax.gaplog import Episode, gap_log_from_episodes
from cablejax.simulate.chain.replay import FINE_STEP, LARGEST_STEP
from cablejax.types import GapLog

CABLE = Cable()
INTERVAL = 0.1
SAMPLES = 100
MOTIONS = ("approach", "mirror", "translation", "ramp_hold")
BY_NAME = {effect.name: effect for effect in LIBRARY}
# Distance of the grippers, angle of gripper 0, of gripper 1 to the line between them, shift across that line. The first
# and the last pose of each motion are held.
_WAYPOINTS = {
    "approach": [(0.85, 0.3, -0.2, 0.0), (0.45, 0.9, -0.2, 0.05), (0.7, 0.1, -0.6, 0.1)],
    "mirror": [(0.85, -0.2, 0.3, 0.0), (0.5, -0.2, 1.0, 0.0), (0.75, -0.7, 0.2, -0.05)],
    "translation": [(0.7, 0.6, -0.5, 0.0), (0.7, 0.6, -0.5, 0.25), (0.7, 0.6, -0.5, 0.05)],
    "ramp_hold": [(0.9, 0.2, -0.3, 0.0), (0.5, 0.2, -0.8, 0.0), (0.5, 0.2, -0.8, 0.0), (0.85, 0.5, -0.3, 0.0)],
}
_WAYPOINTS |= {f"back_{name}": way[::-1] for name, way in _WAYPOINTS.items()}
_REST = 16
_SETTLING = 6


def poses(motion: str, samples: int = SAMPLES) -> Float[np.ndarray, "T 2 3"]:
    """Gripper poses (x, y, theta) of a motion."""
    way = np.array(_WAYPOINTS[motion])
    progress = np.clip((np.arange(samples) - _REST) / (samples - 1 - 2 * _REST), 0.0, 1.0) * (len(way) - 1)
    begin = np.minimum(progress.astype(int), len(way) - 2)
    fraction = progress - begin
    smooth = (fraction**2 * (3 - 2 * fraction))[:, None]
    distance, first, second, shift = (way[begin] + smooth * (way[begin + 1] - way[begin])).T
    zero = np.zeros(samples)
    return np.stack(
        [np.stack([zero, shift, first], axis=1), np.stack([distance, shift + 0.02, second], axis=1)], axis=1
    )


def arches(points: int, motions: Sequence[str] = MOTIONS) -> np.ndarray:
    """Keypoints of a made-up cable between the grippers. Where the gap lies needs no physics."""
    s = np.linspace(0.0, 1.0, points)
    pose = np.stack([poses(m) for m in motions])[..., :2]
    line = pose[:, :, None, 0] * (1 - s)[:, None] + pose[:, :, None, 1] * s[:, None]
    return line + 0.2 * np.sin(np.pi * s)[:, None] * np.array([0.0, 1.0])


def holds(samples: int = SAMPLES) -> np.ndarray:
    """At rest before the motion, and after it once the cable has settled."""
    index = np.arange(samples)
    return (index <= _REST) | (index >= samples - 1 - _REST + _SETTLING)


@functools.cache
def playback(n_links: int) -> Playback:
    """The four motions at a resolution; where it is that of the nominal cable, in time too."""
    config = Discretisation(CABLE, n_links=n_links)
    step = FINE_STEP if n_links == FINE_LINKS else LARGEST_STEP
    motions = np.stack([poses(m) for m in MOTIONS])
    return Playback.of_motion(config, motions, None, np.full(len(MOTIONS), INTERVAL), step)


def parts(*effects: tuple[str, Any]) -> list[tuple[CableEffect, int, Sequence[float]]]:
    """(name, values) or (name, variant, values) as `explanation` takes them."""
    return [(BY_NAME[e[0]], e[1] if len(e) == 3 else 0, e[-1]) for e in effects]


@functools.cache
def clean(*effects: tuple[Any, ...], n_links: int = FINE_LINKS) -> Float[np.ndarray, "E T N 2"]:
    """Keypoints without noise [m]; `effects` as for `parts`, with tuples throughout."""
    player = playback(n_links)
    return player.keypoints([physics_of(explanation(*parts(*effects)), player.believed, player.config)])[0]


def simulator(n_links: int, effects: Sequence[CableEffect] = LIBRARY) -> PlanarCable:
    """The cable of the four motions, exact at its resolution."""
    return PlanarCable(
        effects=effects,
        playback=playback(n_links),
        correction=np.zeros((len(MOTIONS), 1, 1, 1)),
        duration=INTERVAL * SAMPLES,
        max_curvature=np.full(len(MOTIONS), 6.0),
    )


def noise(shape: Sequence[int], noise_mm: float, seed: int) -> np.ndarray:
    """White Gaussian noise [m]."""
    return 1e-3 * noise_mm * np.random.default_rng(seed).normal(size=shape)


def evidence(*effects: tuple[Any, ...], noise_mm: float = 0.5, seed: int = 0, n_links: int = 17) -> Evidence:
    """What a log says if the simulator is exact but for the effects: white noise, no error of its own."""
    return evidence_of(clean(*effects, n_links=n_links), noise_mm=noise_mm, seed=seed, n_links=n_links)


def evidence_of(
    points: Float[np.ndarray, "E T N 2"], *, noise_mm: float = 0.5, seed: int = 0, n_links: int = 17
) -> Evidence:
    """The same for keypoints without noise [m] that the simulator gave at this resolution."""
    return Evidence(
        simulator=simulator(n_links),
        episodes=np.arange(len(points)),
        observed=points + noise(points.shape, noise_mm, seed),
        nominal=clean(n_links=n_links).astype(float),
        noise=np.full((points.shape[2], 1), 1e-3 * noise_mm),
        temper=np.ones(len(points)),
        freedom=1e6,
        motion=np.arange(len(points)),
    )


def arrived(*effects: tuple[Any, ...], cable: Cable = CABLE, n_links: int = FINE_LINKS) -> Float[np.ndarray, "E T N 2"]:
    """Keypoints [m] of the motions from when the grippers arrived at their first poses, by the motions backwards."""
    there = [np.concatenate([poses(f"back_{motion}")[:-1], poses(motion)]) for motion in MOTIONS]
    config = Discretisation(cable, n_links=n_links)
    step = FINE_STEP if n_links == FINE_LINKS else LARGEST_STEP
    player = Playback.of_motion(config, np.stack(there), None, np.full(len(MOTIONS), INTERVAL), step)
    points = player.keypoints([physics_of(explanation(*parts(*effects)), player.believed, config)])[0]
    return points[:, SAMPLES - 1 :]


def log_of(
    keypoints: Float[np.ndarray, "E T N 2"], motions: Sequence[str] = MOTIONS, *, cable: Cable = CABLE
) -> GapLog:
    """A gap log of these keypoints under the motions, with exact arms."""
    episodes = []
    for motion, points in zip(motions, keypoints, strict=True):
        pose = poses(motion)
        command = np.concatenate([np.diff(pose, axis=0) / INTERVAL, np.zeros((1, 2, 3))])
        episodes.append(Episode(motion, INTERVAL * np.arange(len(pose)), points, pose, command, holds()))
    return gap_log_from_episodes(episodes, cable, source="the diagnosing simulator itself")


def record(*effects: tuple[Any, ...], noise_mm: float = 0.5, seed: int = 0) -> GapLog:
    """A log of the fine simulator with these effects."""
    points = clean(*effects)
    return log_of(points + noise(points.shape, noise_mm, seed))
