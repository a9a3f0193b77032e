"""Replays a recorded episode open loop: the recorded gripper poses drive the simulator, nothing corrects it."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from cablejax.cable import Cable, Discretisation
from cablejax.effects.physics import nominal_physics
from cablejax.simulate.engine import Engine
from cablejax.types import GapLog

_SLENDER = 0.01


@dataclasses.dataclass(frozen=True)
class Replay:
    """One episode as the simulator repeats it.

    Attributes:
        keypoints: simulated positions [m], shape [T, N, D].
        rmse: root mean square difference from the recording, per coordinate, over all observed keypoints [m].
    """

    keypoints: Float[np.ndarray, "T N D"]
    rmse: float


def config_of_log(log: GapLog, *, n_links: int | None = None, timestep: float | None = None) -> Discretisation:
    """The simulator of the cable that a log states, by default at the default resolution.

    In the plane the diameter hardly matters to the motion, and a cable thicker than a link is long gets a smaller one.
    """
    cable, table = log.meta["cable"], log.meta["table"]
    dimension, chosen = log.keypoints.shape[-1], {"n_links": n_links, "timestep": timestep}
    described = Cable(
        length=cable["length_m"],
        diameter=cable["diameter_m"] if dimension == 3 else min(cable["diameter_m"], _SLENDER * cable["length_m"]),
        linear_density=cable["linear_density_kg_per_m"],
        bending_stiffness=cable["bending_stiffness_n_m2"],
        damping_time=cable["bending_damping_s"],
        rest_curvature=cable.get("rest_curvature_per_m", 0.0),
        friction_coefficient=0.0 if table is None else table["friction_coefficient"],
        n_keypoints=log.keypoints.shape[-2],
    )
    return Discretisation(
        described, dimension=dimension, **{name: value for name, value in chosen.items() if value is not None}
    )


def cable_of_log(log: GapLog) -> Cable:
    """The cable that a log states, with its own diameter, marks and grasp.

    Raises:
        ValueError: it is not one that a simulator can take.
    """
    cable, marks = log.meta["cable"], np.asarray(log.meta["keypoint_arclength_m"], float)
    uniform = np.allclose(marks, np.linspace(0.0, cable["length_m"], len(marks)), rtol=0, atol=1e-6 * cable["length_m"])
    return dataclasses.replace(
        config_of_log(log).cable,
        diameter=cable["diameter_m"],
        marks=None if uniform else tuple(marks.tolist()),
        grasp=tuple(log.meta["grasp"]),
    )


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
