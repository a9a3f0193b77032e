"""Runs one setup through one family of simulators: true poses and noiseless keypoints of every episode."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from . import rod
from .effects import Arm, Context, Setup
from .motions import INTERVAL, Commands
from .observe import lagged, observe
from .rod import Motion
from .world import World

FRAMES = 5
"""Frames of a simulation per sample of the log."""
FRAME = INTERVAL / FRAMES
TAUT = 0.994
"""Largest distance between grippers in lengths of the cable between them."""

Simulate = Callable[[World, np.ndarray, float], Motion]


class Unreachable(ValueError):
    """Motions and effect that do not go together: the cable would be torn, or bent past what fits."""


@dataclasses.dataclass(frozen=True)
class Record:
    """Noiseless log of one setup.

    Attributes:
        pose: at the samples of every episode, [T, 2, 3] each.
        keypoints: [T, 13, 2] each.
        motions: the cable itself, at the frames of every episode.
    """

    pose: list[np.ndarray]
    keypoints: list[np.ndarray]
    motions: list[Motion]


def actual_path(commands: Commands, arm: Arm) -> np.ndarray:
    """Gripper poses at every frame, from what was commanded."""
    path = commands.fine_path(FRAMES)
    path = path[:1] + arm.gain * (path - path[:1])
    return lagged(path, arm.lag, arm.lag_share, FRAME) if arm.lag > 0 else path


def grasp_path(path: np.ndarray, play: float) -> np.ndarray:
    """Poses of the grasps where the gripper's rotation has play: they trail its encoder."""
    if play == 0:
        return path
    path = path.copy()
    for t in range(1, len(path)):
        path[t, :, 2] = np.clip(path[t - 1, :, 2], path[t, :, 2] - play, path[t, :, 2] + play)
    return path


def record(setup: Setup, commands: list[Commands], simulate: Simulate, known: Record | None = None) -> Record:
    """All episodes; `known` gives the cable's motion where only the camera differs."""
    poses, keypoints, motions = [], [], []
    free = setup.world.length + min(setup.world.slip[2], 0.0) if setup.world.slip else setup.world.length
    for episode, command in enumerate(commands):
        path = actual_path(command, setup.arm)
        if np.linalg.norm(path[:, 1, :2] - path[:, 0, :2], axis=1).max() > TAUT * free:
            raise Unreachable("The grippers would pull the cable taut.")
        if known is not None:
            motion = known.motions[episode]
        else:
            try:
                motion = simulate(setup.world, grasp_path(path, setup.arm.play), FRAME)
            except (FloatingPointError, ValueError) as error:
                raise Unreachable(str(error)) from error
        poses.append(path[::FRAMES])
        keypoints.append(observe(motion, setup.camera, setup.world.length, FRAME, FRAMES, episode))
        motions.append(motion)
    return Record(poses, keypoints, motions)


def context_of(world: World, commands: list[Commands], record_: Record) -> Context:
    """What effects may look at."""
    return Context(world, commands, [Motion(m.points[::FRAMES], m.arc[::FRAMES]) for m in record_.motions])


def gap(one: Record, other: Record) -> tuple[float, list[float]]:
    """Root mean square difference per coordinate of two logs [m], in all and by episode."""
    squares = [np.mean((a - b) ** 2) for a, b in zip(one.keypoints, other.keypoints, strict=True)]
    sizes = [len(a) for a in one.keypoints]
    return float(np.sqrt(np.average(squares, weights=sizes))), [float(np.sqrt(square)) for square in squares]


def family_a(world: World, pose: np.ndarray, frame: float) -> Motion:
    """Family A with the time step at which the logs are made; see `rod`."""
    return rod.simulate(world, pose, frame, rod.RodConfig(timestep=4e-3))


def quick(world: World, pose: np.ndarray, frame: float) -> Motion:
    """Family A at long time steps, right to 0.05 to 0.2 mm, to find strengths with."""
    return rod.simulate(world, pose, frame, rod.RodConfig(timestep=frame, iterations=1))
