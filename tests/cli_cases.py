"""A network small enough for tests of the command line, and a run that nobody has to wait for.

Untrained, the network does what its prior does."""

import pathlib

import numpy as np
from flax import nnx

from cablejax.cable import Cable
from cablejax.cable_file import cable_to_fields
from cablejax.control.run import ClosedLoopRun, shape_error_cm
from cablejax.control.targets import Target
from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.networks import GNS
from cablejax.dynamics.weights import FILE_NAME, save_weights
from cablejax.gaplog import Episode


def small_model(folder: pathlib.Path, seed: int = 0, cable: Cable = Cable()) -> pathlib.Path:
    """Writes the weights file of a small network into a folder, as `cablejax train` would, and returns the folder."""
    config = ModelConfig(
        n_keypoints=cable.n_keypoints,
        length=cable.length,
        latent=8,
        hidden=8,
        hidden_layers=1,
        message_passing=1,
        prior="rigid",
    )
    folder.mkdir(parents=True, exist_ok=True)
    info = {"source": "test", "cable": cable_to_fields(cable)}
    save_weights(folder / FILE_NAME, config, nnx.split(GNS(config, nnx.Rngs(seed)))[1], info)
    return folder


def made_up_run(target: Target, commands: int = 2) -> ClosedLoopRun:
    """A run whose cable goes nine tenths of the way to its target."""
    samples = commands + 1
    way = np.linspace(0.0, 0.9, samples)[:, None, None]
    line = np.stack([np.linspace(-0.5, 0.5, len(target.keypoints)), np.zeros(len(target.keypoints))], axis=1)
    keypoints = (1 - way) * line + way * target.keypoints
    pose = np.repeat(target.gripper_pose[None], samples, axis=0)
    last = np.arange(samples) == commands
    error = shape_error_cm(keypoints, target.keypoints)
    return ClosedLoopRun(
        target=target,
        times=np.arange(samples, dtype=float),
        keypoints=keypoints,
        gripper_pose=pose,
        twist=np.where(last[:, None, None], np.nan, 0.0) * pose,
        error_cm=error,
        residual_share=np.where(last, np.nan, 0.5),
        action=np.full_like(error, np.nan),
        radius=np.where(last, np.nan, 0.05),
        mpc_ms=np.where(last, np.nan, 100.0),
        unobserved=0,
        stopped=None,
        episode=Episode(
            motion=f"approach_{target.name.lower()}",
            time=np.arange(samples, dtype=float),
            keypoints=keypoints,
            gripper_pose=pose,
            gripper_command=np.zeros_like(pose),
            hold=np.zeros(samples, bool),
        ),
    )
