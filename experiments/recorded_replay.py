"""Replays a recorded episode open loop: the recorded gripper poses drive the simulator, nothing corrects it."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from cablejax.effects.physics import nominal_physics
from cablejax.simulate.engine import Engine
from cablejax.types import GapLog


@dataclasses.dataclass(frozen=True)
class Replay:
    """One episode as the simulator repeats it.

    Attributes:
        keypoints: simulated positions [m], shape [T, N, D].
        rmse: root mean square difference from the recording, per coordinate, over all observed keypoints [m].
    """

    keypoints: Float[np.ndarray, "T N D"]
    rmse: float


def replay_episode(engine: Engine, log: GapLog, episode: int) -> Replay:
    """Simulates one planar episode from the settled shape nearest to its first sample.

    Raises:
        ValueError: the log is not planar, or its sample interval is no multiple of the engine's time step.
    """
    if log.keypoints.shape[-1] != 2:
        raise ValueError(f"The log has keypoints in {log.keypoints.shape[-1]} dimensions, expected 2 for a replay.")
    length = int(log.episode_length[episode])
    pose = log.gripper_pose[episode, :length].astype(np.float64)
    seen = log.keypoints[episode, :length].astype(np.float64)
    interval = float(np.round(np.diff(log.time[episode, :length]).mean(), 9))
    state = engine.initial_state(pose[0], guess=seen[0])
    twist = np.diff(pose, axis=0) / interval
    _, trajectory = engine.rollout(nominal_physics(engine.config), state, twist, interval)
    keypoints = np.asarray(trajectory.keypoints, np.float64)
    return Replay(keypoints=keypoints, rmse=float(np.sqrt(np.nanmean((keypoints - seen) ** 2))))
