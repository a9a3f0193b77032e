"""The paper's strongest rival: a network fine-tuned on transitions of the cable that is to be shaped."""

from __future__ import annotations

import dataclasses
import pathlib
import sys

import numpy as np

from cablejax.cable import Discretisation
from cablejax.cable_file import cable_to_fields
from cablejax.control.shaping import Model, load_model
from cablejax.dynamics.fine_tune import starting_from
from cablejax.dynamics.train import train
from cablejax.dynamics.train_config import Phase, TrainConfig
from cablejax.dynamics.weights import FILE_NAME, save_weights
from cablejax.npz import read_npz
from cablejax.simulate.motions import MotionConfig, random_motion
from cablejax.types import Trajectory
from closed_loop.protocols import GuessingCable


@dataclasses.dataclass(frozen=True)
class FineTuneConfig:
    """How a model is fitted to one cable. Wang et al., RA-L 2022, record 2,000 transitions.

    Attributes:
        weights: released model to start from.
        trajectories: recorded from straight starts.
        commands: of each, one second long.
        phases: of the training.
        symmetric: whether the cable is the same in a mirror and from its other end. Knowing it is a gift to this rival.
        seed: of motions and training.
    """

    weights: str = "gns-reference"
    trajectories: int = 20
    commands: int = 100
    phases: tuple[Phase, ...] = (
        Phase(steps=400, batch=32, rollout=1, noise=1e-4, lr_start=1e-4, lr_end=5e-5),
        Phase(steps=150, batch=16, rollout=4, noise=3e-5, lr_start=5e-5, lr_end=1e-6),
    )
    symmetric: bool = True
    seed: int = 0


def record(
    plant: GuessingCable, cable: Discretisation, config: FineTuneConfig, cache: pathlib.Path | None = None
) -> Trajectory:
    """Random motions of a plant's cable, arrays [M, T + 1, N, 2] and so on. A motion that the plant cannot bear is
    drawn again.

    Args:
        plant: what is moved.
        cable: geometry, for motions within what it can bear.
        config: how much.
        cache: file to keep the recording in, and to take it from if it is there.
    """
    if cache is not None and cache.is_file():
        arrays = read_npz(cache, ["keypoints", "gripper_pose", "gripper_twist"])
        return Trajectory(arrays["keypoints"], arrays["gripper_pose"], arrays["gripper_twist"])  # pyright: ignore[reportArgumentType]
    motion = MotionConfig(start="straight")
    keypoints, poses, twists, attempt = [], [], [], 0
    while len(twists) < config.trajectories:
        rng = np.random.default_rng((config.seed, attempt))
        attempt += 1
        start, twist = random_motion(rng, cable, config.commands, motion)
        try:
            seen = [plant.reset(start)]
            for command in twist:
                seen += plant.record(command, 1.0, samples=1)
        except ValueError as error:
            print(f"recording drawn again: {error}", file=sys.stderr)
            continue
        keypoints.append([one.keypoints for one in seen])
        poses.append([one.gripper_pose for one in seen])
        twists.append(twist)
    data = Trajectory(*(np.asarray(x, np.float32) for x in (keypoints, poses, twists)))  # pyright: ignore[reportArgumentType]
    if cache is not None:
        cache.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(
            cache, keypoints=data.keypoints, gripper_pose=data.gripper_pose, gripper_twist=data.gripper_twist
        )
    return data


def fine_tune(data: Trajectory, config: FineTuneConfig, folder: pathlib.Path) -> Model:
    """The released model after training on recorded transitions; what is in the folder already is not done again."""
    if not (folder / FILE_NAME).is_file():
        source = load_model(config.weights)
        model = dataclasses.replace(source.config, symmetric=source.config.symmetric and config.symmetric)
        initial = starting_from(config.weights, model)
        training = TrainConfig(
            model=model,
            phases=config.phases,
            flips=config.symmetric,
            seed=config.seed,
            warmup=20,
            ema=0.99,
            clip=1.0,
        )
        result = train(training, data, folder / "training", initial=initial)
        if not result.completed:
            raise KeyboardInterrupt(f"Stopped while fine-tuning; run the same command again to go on in {folder}.")
        info = {
            "started_from": config.weights,
            "cable": cable_to_fields(source.cable),
            "transitions": int(np.prod(np.shape(data.gripper_twist)[:2])),
        }
        save_weights(folder / FILE_NAME, result.model, result.weights, info)
    return load_model(str(folder))
