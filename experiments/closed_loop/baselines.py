"""Baselines: a drive to the goal without a model of the cable, and the statics without a network."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cablejax.cable import Cable
from cablejax.control.shaping import Model
from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.graph import prior_of
from cablejax.mpc import MPCConfig
from cablejax.mpc.target_pose import continued, straight_plan, target_pose
from cablejax.types import History, Measurement


@dataclasses.dataclass(frozen=True)
class StraightDrive:
    """Both grippers straight to where the target's ends are held, as fast as the bound allows, and there they stay.

    It has no model and no feedback of the shape: a `Controller` that reads the keypoints' total turn only.

    Attributes:
        target: wanted keypoints [m], shape [N, 2].
        config: bound on a step's motion, interval and the weight of rotations.
    """

    target: Float[Array, "N 2"]
    config: MPCConfig = dataclasses.field(default_factory=MPCConfig)

    def init(self, history: History) -> tuple[()]:
        """It remembers nothing."""
        del history
        return ()

    def step(self, state: tuple[()], measurement: Measurement) -> tuple[tuple[()], Float[Array, "2 3"], None]:
        """The twist [m/s, rad/s] that goes straight on."""
        return state, _drive(self.config, jnp.asarray(self.target), *map(jnp.asarray, measurement[:2])), None


@functools.partial(jax.jit, static_argnums=0)
def _drive(
    config: MPCConfig, target: Float[Array, "N 2"], keypoints: Float[Array, "N 2"], gripper_pose: Float[Array, "2 3"]
) -> Float[Array, "2 3"]:
    objective = config.objective
    pose = continued(gripper_pose, keypoints)
    plan = straight_plan(pose, target_pose(target), jnp.asarray(config.radius_max), objective.rotation_weight, steps=1)
    return objective.to_twist(plan[0])


@dataclasses.dataclass(frozen=True)
class Statics:
    """Dynamics without a network: the cable goes from one frictionless resting shape to the next.

    Attributes:
        config: of the networks whose prior it is.
    """

    config: ModelConfig

    def __call__(self, weights: Any, history: History, twist: Float[Array, "2 3"]) -> Float[Array, "N 2"]:
        del weights
        return prior_of(history, twist, self.config).displacement


def statics_model(config: ModelConfig = ModelConfig()) -> Model:
    """The statics as the controllers take a model; it has no weights."""
    return Model("statics", config, Statics(config), (), Cable())  # pyright: ignore[reportArgumentType]
