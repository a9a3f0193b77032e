"""Plays commanded motions on a plant and records what it does, as an arm and a camera do in a laboratory."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Bool, Float

from cablejax.gaplog import Episode, gap_log_from_episodes
from cablejax.log_geometry import gripper_motion
from cablejax.simulate.equilibrium import arch_angles, chain_nodes, find_equilibrium
from cablejax.simulate.table_plant import TablePlant
from cablejax.types import GapLog

SETTLING = 1.5
"""Time at rest after which a sample counts as a hold [s]."""


def play(plant: TablePlant, log: GapLog, *, source: str, noise: float = 0.0, seed: int = 0) -> GapLog:
    """Plays the commands of every episode of a log, each on a new cable, and records them.

    Args:
        plant: of the cable that is recorded. The result states the cable that it is believed to be.
        log: with commands, for example a `next_motion.npz` of `cablejax diagnose`; its keypoints are not used.
        source: free text: what was recorded.
        noise: standard deviation of the recorded keypoints [m], per coordinate. A plant's own noise repeats itself with
            every new cable.
        seed: of the noise.

    Raises:
        ValueError: the log is not of two grippers on a level table, has no commands, an episode has too few samples or
            an uneven clock, or the plant rejects a start or a command.
        PlantError: the simulation became unstable.
    """
    if log.gripper_pose.shape[2:] != (2, 3):
        raise ValueError(
            f"The motion has gripper poses of shape {log.gripper_pose.shape[2:]}, expected (2, 3): (x, y, theta) of "
            "two grippers on a table."
        )
    gravity = np.asarray(log.meta["gravity_m_per_s2"], float)
    if np.abs(gravity[:2]).max() > 1e-6:
        raise ValueError(
            f"The motion states gravity as {gravity.tolist()} m/s^2, but the plant's table is level: state [0, 0, "
            "-9.81] in meta.gravity_m_per_s2 of both logs, and give the tilt as an effect, gravity_tilt."
        )
    moved = max(gripper_motion(pose[:n], 2) for pose, n in zip(log.gripper_pose, log.episode_length, strict=True))
    if not log.gripper_command.any() and moved > 1e-3:
        raise ValueError(
            f"The motion has no commands, but its grippers move by {moved:.3g} m: expected one with commands, such as "
            "a next_motion.npz of `cablejax diagnose`."
        )
    episodes, random = [], np.random.default_rng(seed)
    for e, (length, interval) in enumerate(zip(log.episode_length, even_intervals(log), strict=True)):
        episodes.append(
            played(
                plant,
                log.gripper_pose[e, 0].astype(float),
                log.gripper_command[e, :length].astype(float),
                interval,
                motion=log.meta["motion"][e],
                noise=noise,
                random=random,
            )
        )
    return gap_log_from_episodes(episodes, plant.config.cable, source=source)


def even_intervals(log: GapLog) -> list[float]:
    """The time between samples of each episode [s].

    Raises:
        ValueError: an episode has too few samples or an uneven clock.
    """
    intervals = []
    for e, length in enumerate(log.episode_length):
        steps = np.diff(log.time[e, :length])
        if length < 2 or np.ptp(steps) > 1e-6:
            raise ValueError(
                f"Episode {e} of the motion has {length} samples on {'an uneven' if length > 1 else 'no'} clock, "
                "expected at least two samples on an even one."
            )
        intervals.append(float(np.round(steps.mean(), 9)))
    return intervals


def played(
    plant: TablePlant,
    start: Float[np.ndarray, "2 3"],
    twist: Float[np.ndarray, "T 2 3"],
    interval: float,
    *,
    motion: str,
    hold: Bool[np.ndarray, "T"] | None = None,
    guess: Float[np.ndarray, "S 2"] | None = None,
    noise: float = 0.0,
    random: np.random.Generator | None = None,
) -> Episode:
    """Lays a new cable out, plays one motion and records it.

    Args:
        plant: to play it on.
        start: (x, y, theta) of both grippers [m, rad].
        twist: held from every sample to the next [m/s, rad/s]; the last one is not used.
        interval: between samples [s].
        motion: its name.
        hold: samples at which the cable has settled; None = those of `settled`.
        guess: points of a similar first shape [m], where several fit the grippers; None = a gentle arch.
        noise: standard deviation of the recorded keypoints [m], per coordinate.
        random: source of the noise; None = `default_rng(0)`.
    """
    seen = [plant.reset(start, guess=_arch(plant, start) if guess is None else guess)]
    seen += [plant.step(each, interval) for each in twist[:-1]]
    keypoints = np.stack([one.keypoints for one in seen])
    if noise > 0:
        random = np.random.default_rng(0) if random is None else random
        keypoints = keypoints + noise * random.standard_normal(keypoints.shape)
    return Episode(
        motion,
        interval * np.arange(len(seen)),
        keypoints,
        np.stack([one.gripper_pose for one in seen]),
        twist,
        settled(twist, interval) if hold is None else hold,
    )


def settled(twist: Float[np.ndarray, "T 2 3"], interval: float) -> Bool[np.ndarray, "T"]:
    """Samples before which both grippers have rested for `SETTLING`, and those until they first move."""
    index, samples = np.arange(len(twist)), math.ceil(SETTLING / interval - 1e-9)
    moved = np.append(False, np.abs(twist[:-1]).max(axis=(1, 2)) > 1e-9)
    return index - np.maximum.accumulate(np.where(moved, index, -samples)) >= samples


def _arch(plant: TablePlant, start: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "S 2"]:
    """Points of the arch from which a diagnosis simulates a motion, too."""
    planar = dataclasses.replace(plant.config.discretisation, dimension=2)
    angles = find_equilibrium(planar, start, arch_angles(planar, start)).angles
    return np.concatenate([start[:1, :2], chain_nodes(planar, start, angles), start[1:, :2]])
