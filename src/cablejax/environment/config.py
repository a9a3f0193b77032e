"""Settings of the environments: the cable, what is drawn, what an action commands, and when a motion has failed."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, get_args

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from cablejax.cable import Cable, Discretisation
from cablejax.control.command_limits import CommandLimits
from cablejax.control.targets import Shape, Target, make_target
from cablejax.dataset.drawing import cable_params, draw_parameters
from cablejax.dataset.schema import DatasetConfig, Randomisation
from cablejax.effects.camera import without_bias
from cablejax.effects.given import GivenEffect, parse_effect
from cablejax.effects.physics import Physics
from cablejax.limits import check, shown
from cablejax.simulate.chain.engine import ChainEngine
from cablejax.simulate.engine import refuse_lags
from cablejax.types import CableState

EffectText = GivenEffect | str
"""An effect, or its text as `parse_effect` reads it."""


@dataclasses.dataclass(frozen=True)
class ShapeCableConfig:
    """Settings of the environment.

    Attributes:
        discretisation: the cable, its links and time step; planar.
        targets: letters or targets, one of which each episode draws.
        effects: of every cable; no lags of arms or camera. `reset` takes others as an option.
        randomisation: ranges of the physical parameters, drawn in each episode.
        interval: time for which an action is held [s].
        steps: actions after which an episode is truncated.
        speed: speed of a gripper for an action of 1 [lengths of the cable per second].
        turn_rate: turn rate of a gripper for an action of 1 [rad/s].
        tolerance: error at which an episode terminates [lengths of the cable].
        keypoint_noise: standard deviation of the observed keypoints [m] per coordinate.
    """

    discretisation: Discretisation = Discretisation(n_links=24)
    targets: tuple[Shape | Target, ...] = ("U", "S", "Z")
    effects: tuple[EffectText, ...] = ()
    randomisation: Randomisation = Randomisation()
    interval: float = 1.0
    steps: int = 40
    speed: float = 0.05
    turn_rate: float = 1 / 3
    tolerance: float = 0.005
    keypoint_noise: float = 0.0

    def __post_init__(self):
        # a policy divides by both
        check(self, speed="positive", turn_rate="positive")
        check(self, "speed", "interval", steps="commands", turn_rate="speed", tolerance="share", keypoint_noise="noise")
        for name, kind in (("discretisation", Discretisation), ("randomisation", Randomisation)):
            if not isinstance(getattr(self, name), kind):
                raise ValueError(
                    f"ShapeCableConfig.{name} is a {type(getattr(self, name)).__name__}, expected a {kind.__name__}"
                    f"{': Discretisation(cable)' if kind is Discretisation else ''}."
                )
        if isinstance(self.targets, str) or not isinstance(self.targets, Sequence):
            raise ValueError(f"ShapeCableConfig.targets is {self.targets!r}, expected a tuple: ({self.targets!r},).")
        if not self.targets:
            raise ValueError("ShapeCableConfig.targets is empty, expected one target or more.")
        for target in self.targets:
            if not isinstance(target, Target) and target not in get_args(Shape):
                raise ValueError(
                    f"ShapeCableConfig.targets has {target!r}, expected {', '.join(get_args(Shape))} or a `Target`."
                )
        self.recipe(self.effects)

    @property
    def cable(self) -> Cable:
        """The nominal cable."""
        return self.discretisation.cable

    @functools.cached_property
    def scale(self) -> Float[np.ndarray, "3"]:
        """The twist (vx, vy, omega) [m/s, rad/s] that an action of 1 asks for."""
        return np.array([self.speed * self.cable.length] * 2 + [self.turn_rate])

    @property
    def room(self) -> float:
        """Largest coordinate of an observed keypoint [m]; beyond it, or not finite, a simulation has diverged."""
        # the grippers' square, a length of cable, and a metre for camera offsets and noise
        return 3 * self.cable.length + 1

    @property
    def widest(self) -> float:
        """Distance of the cable's end from its gripper [m] beyond which it is torn out."""
        return 0.01 * self.cable.length

    @functools.cached_property
    def limits(self) -> CommandLimits:
        """Limits of every action: the grippers stay within a square of three lengths, and never pull the cable taut."""
        length = self.cable.length
        return CommandLimits(
            speed=2.0 * self.speed * length,
            turn_rate=self.turn_rate + 1e-6,
            workspace=((-1.5 * length, -1.5 * length), (1.5 * length, 1.5 * length)),
        )

    def twist(self, action: Float[Any, "*B 2 3"], pose: Float[Any, "*B 2 3"]) -> Float[Any, "*B 2 3"]:
        """The twist of an action [m/s, rad/s]; zero if it is not finite, shortened if it is beyond `limits`.

        NumPy in, NumPy out in double precision; JAX in, JAX out, also within `jit`.

        Args:
            action: in units of `speed` and `turn_rate`, cut off at 1.
            pose: of both grippers [m, rad].
        """
        xp = action.__array_namespace__()
        share = xp.clip(xp.nan_to_num(action, posinf=0.0, neginf=0.0), -1.0, 1.0)
        twist = xp.asarray(self.scale, dtype=share.dtype) * share
        return self.limits.shortened(twist, pose, self.interval, self.cable.length)

    def outcome(
        self, engine: ChainEngine, physics: Physics, before: CableState, after: CableState
    ) -> tuple[Float[Array, "*B N 2"], Bool[Array, "*B"], Bool[Array, "*B"]]:
        """Outcome of a motion: true keypoints [m], which cables have diverged and which are torn out.

        Args:
            engine: simulates the cables.
            physics: of them.
            before: their states before the motion.
            after: and after it.
        """
        true = engine.keypoints(without_bias(physics), after)
        diverged = ~(jnp.abs(true) < self.room).all(axis=(-2, -1))
        widest = jnp.maximum(self.widest, engine.opening(before))
        return true, diverged, ~diverged & (engine.opening(after) > widest)

    def recipe(self, effects: Sequence[EffectText]) -> DatasetConfig:
        """The data set's configuration from which cables with these effects are drawn.

        Raises:
            ValueError: an effect is unknown, out of bounds, or a lag.
        """
        if isinstance(effects, str) or not isinstance(effects, Sequence):
            raise ValueError(f"Effects are {effects!r}, expected a list of them: [{effects!r}].")
        given = tuple(parse_effect(effect) if isinstance(effect, str) else effect for effect in effects)
        if wrong := [effect for effect in given if not isinstance(effect, GivenEffect)]:
            raise ValueError(f"An effect is {shown(wrong[0])}, expected NAME:PARAMETER=VALUE,... or a `GivenEffect`.")
        recipe = DatasetConfig(
            interval=self.interval,
            discretisation=self.discretisation,
            randomisation=self.randomisation,
            engine="chain",
            effects=given,
        )
        refuse_lags(cable_params(recipe, draw_parameters(recipe, np.random.default_rng(0))))
        return recipe

    def target(self, target: Shape | Target) -> Target:
        """A target of this cable; raises ValueError for another letter, length or number of points, or far away."""
        made = make_target(target, self.cable) if isinstance(target, str) else target
        if not isinstance(made, Target):
            raise ValueError(f"The target is a {type(made).__name__}, expected a letter or a `Target`.")
        if made.keypoints.shape != (self.cable.n_keypoints, 2):
            raise ValueError(
                f"Target {made.name!r} has keypoints of shape {made.keypoints.shape}, expected "
                f"({self.cable.n_keypoints}, 2) as the cable."
            )
        if not (np.abs(made.keypoints) <= self.room).all():
            raise ValueError(
                f"Target {made.name!r} has a coordinate that is not finite or beyond {self.room:g} m, where no gripper "
                "of this environment comes."
            )
        made.require_length(self.cable.length, "the environment")
        return made


def require_config(config: object) -> None:
    """Raises ValueError if a value is not a configuration of the environments."""
    if not isinstance(config, ShapeCableConfig):
        raise ValueError(f"config is of type {type(config).__name__}, expected a ShapeCableConfig.")
