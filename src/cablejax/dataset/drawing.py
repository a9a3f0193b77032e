"""The random part of a data set: cables and motions, each from the configuration and its number alone."""

from __future__ import annotations

import concurrent.futures
import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from cablejax.cores import available_cores
from cablejax.dataset.schema import DatasetConfig
from cablejax.effects.given import with_effects
from cablejax.effects.physics import Physics, nominal_physics
from cablejax.simulate.motions import random_motion


@dataclasses.dataclass(frozen=True)
class Draw:
    """The random part of one trajectory.

    Attributes:
        gripper_pose: where the grippers start, float32, shape [Q, 3].
        gripper_twist: what they do, float32, shape [T, Q, 3].
        parameters: the columns of `cablejax.dataset.schema.PARAMETERS`, float64, shape [3].
        index: of the trajectory, for `DatasetConfig.effects_of`.
    """

    gripper_pose: np.ndarray
    gripper_twist: np.ndarray
    parameters: np.ndarray
    index: int


def draw(config: DatasetConfig, index: int, attempt: int = 0) -> Draw:
    """Everything random about trajectory `index`, from (seed, index, attempt) alone."""
    rng = np.random.default_rng(np.random.SeedSequence(config.seed, spawn_key=(index, attempt)))
    parameters = draw_parameters(config, rng)
    pose, twist = random_motion(rng, config.discretisation, config.n_steps, config.motion, config.interval)
    return Draw(
        gripper_pose=np.asarray(pose, np.float32),
        gripper_twist=np.asarray(twist, np.float32),
        parameters=parameters,
        index=index,
    )


def moves_alike(config: DatasetConfig, other: DatasetConfig) -> bool:
    """Whether trajectories of one number have one motion of the grippers in both, whatever their cables."""

    def of(one: DatasetConfig):
        drawn = sum(limits is not None for limits in dataclasses.astuple(one.randomisation))
        return one.seed, drawn, one.cable.length, one.n_steps, one.motion, one.interval

    return of(config) == of(other)


def draw_all(config: DatasetConfig, indices: Sequence[int], attempt: int = 0) -> list[Draw]:
    """`draw` of some trajectories, on all cores."""
    with concurrent.futures.ThreadPoolExecutor(available_cores()) as pool:
        return list(pool.map(lambda index: draw(config, index, attempt), indices))


def draw_parameters(config: DatasetConfig, rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """The random parameters of one cable, the columns of `cablejax.dataset.schema.PARAMETERS`."""
    ranges, cable = config.randomisation, config.cable
    stiffness, friction, damping = (
        1.0 if limits is None else float(np.exp(rng.uniform(*np.log(limits))))
        for limits in (ranges.stiffness, ranges.friction, ranges.damping)
    )
    return np.array([stiffness, friction * cable.friction_coefficient, damping * cable.damping_time])


def cable_params(config: DatasetConfig, parameters: Float[Any, "3"], index: int = 0) -> Physics:
    """The simulator's parameters of trajectory `index`: its row of the store's `parameters`, and its effects.

    NumPy in, NumPy out; JAX in, JAX out.
    """
    stiffness, friction, damping = parameters.astype(np.float32)
    nominal = nominal_physics(config.discretisation)
    drawn = dataclasses.replace(
        nominal, stiffness=nominal.stiffness * stiffness, friction=friction, damping_time=damping
    )
    return with_effects(drawn, config.effects_of(index), config.discretisation)
