"""A batch of cables to be shaped by actions: the state, the reward and the randomisation of the environments."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import get_args

import jax
import numpy as np
from jaxtyping import Bool, Float

from cablejax.cable import Cable, Discretisation
from cablejax.control.command_limits import CommandLimits
from cablejax.control.run import shape_error_cm
from cablejax.control.targets import Shape, Target, make_target, straight_start
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
        speed: of a gripper that an action of 1 asks for [lengths of the cable per second].
        turn_rate: likewise [rad/s].
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
        """Of every action: the grippers stay within a square of three lengths, and never pull the cable taut."""
        length = self.cable.length
        return CommandLimits(
            speed=2.0 * self.speed * length,
            turn_rate=self.turn_rate + 1e-6,
            workspace=((-1.5 * length, -1.5 * length), (1.5 * length, 1.5 * length)),
        )

    def recipe(self, effects: Sequence[EffectText]) -> DatasetConfig:
        """How cables with these effects are drawn.

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
    """Raises ValueError for what is no configuration of the environments."""
    if not isinstance(config, ShapeCableConfig):
        raise ValueError(f"config is of type {type(config).__name__}, expected a ShapeCableConfig.")


class Cables:
    """B cables between two grippers each. Arrays are NumPy's; the simulation is one compiled call for all of them.

    Attributes:
        config: see `ShapeCableConfig`.
        keypoints: observed [m], float32, shape [B, N, 2].
        gripper_pose: (x, y, theta) [m, rad], theta counting turns, float32, shape [B, 2, 3].
        target: wanted keypoints [m], float32, shape [B, N, 2].
        error: root mean square distance of the true keypoints to the target [lengths of the cable], shape [B].
        taken: actions in this episode, shape [B].
        names: of the targets.
    """

    def __init__(self, config: ShapeCableConfig, size: int):
        self.config = config
        self._engine = ChainEngine(config.discretisation)
        self._recipe = config.recipe(config.effects)
        self._targets = [config.target(target) for target in config.targets]
        pose = straight_start(config.cable)
        self._start = self._engine.initial_state(pose[None])
        self._shown = self._at_rest(*self._resting())

        def rows(leaf):
            return np.repeat(np.asarray(leaf), size, axis=0)

        self._physics, self._state = jax.tree.map(rows, self._resting())
        points = config.cable.n_keypoints
        self.keypoints, self.target = np.zeros((2, size, points, 2), np.float32)
        self.gripper_pose = rows(np.asarray(pose, np.float32)[None])
        self.error, self.taken = np.zeros(size), np.zeros(size, int)
        self.names = [""] * size

    def _at_rest(self, physics: Physics, start: CableState) -> Float[np.ndarray, "2 N 2"]:
        """True and seen keypoints of one cable before its first action [m]; raises ValueError if it diverges there."""
        rest = self._engine.rollout(physics, start, np.zeros((1, 1, 2, 3)))[1]
        if not np.isfinite(rest.keypoints).all():
            raise ValueError(
                f"The simulation of this cable by {self.config.discretisation.n_links} links diverges at rest. Check "
                "the numbers of the cable and of its effects, and their units, or take a discretisation with fewer "
                "links (n_links)."
            )
        true = self._engine.keypoints(without_bias(physics), start)
        return np.stack([np.asarray(true[0]), np.asarray(rest.keypoints[0, 0])])

    def _resting(self):
        one = cable_params(self._recipe, draw_parameters(self._recipe, np.random.default_rng(0)))
        return jax.tree.map(lambda leaf: np.asarray(leaf, np.float32)[None], one), self._start

    def reset(
        self,
        row: int,
        random: np.random.Generator,
        *,
        target: Shape | Target | None = None,
        effects: Sequence[EffectText] | None = None,
    ) -> None:
        """Lays a new straight cable between one pair of grippers.

        Args:
            row: which one.
            random: draws target, parameters and noise.
            target: by default one of the configuration's.
            effects: by default the configuration's.

        Raises:
            ValueError: the target does not fit the cable, or see `ShapeCableConfig.recipe`.
        """
        config = self.config
        drawn = self._targets[random.integers(len(self._targets))]
        chosen = drawn if target is None else config.target(target)
        recipe = self._recipe if effects is None else config.recipe(effects)
        physics = cable_params(recipe, draw_parameters(recipe, random))
        batch = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32)[None], physics)
        shown = self._shown if effects is None else self._at_rest(batch, self._start)

        def put(whole, leaf):
            whole[row] = leaf
            return whole

        # what a simulation returned is read-only: it is copied once, not for every cable that is reset after it
        self._state = jax.tree.map(lambda leaf: np.require(leaf, requirements="W"), self._state)
        jax.tree.map(put, self._physics, physics)
        jax.tree.map(lambda whole, leaf: put(whole, leaf[0]), self._state, self._start)
        self.target[row], self.names[row] = chosen.keypoints, chosen.name
        self.gripper_pose[row] = np.asarray(self._start.gripper_pose[0])
        self.taken[row] = 0
        only = np.arange(len(self.taken)) == row
        true, seen = np.repeat(shown[:, None], len(only), axis=1)
        self._observe(only, true, seen, [random] * len(only))

    def step(
        self,
        actions: Float[np.ndarray, "B 2 3"],
        randoms: Sequence[np.random.Generator],
        active: Bool[np.ndarray, " B"],
    ) -> tuple[Float[np.ndarray, " B"], Bool[np.ndarray, " B"], Bool[np.ndarray, " B"]]:
        """Executes actions: twists of both grippers in units of `speed` and `turn_rate`, cut off at 1.

        A twist that would leave `limits` is shortened. One that is not finite counts as zero. One that would tear the
        cable out of a gripper, as where it is wound up, or farther out where an effect has, is not executed.

        Args:
            actions: in the world's frame.
            randoms: of each cable's noise.
            active: cables that move; the others stay as they are.

        Returns:
            The rewards, minus the error; whether the target is reached or the simulation has diverged; and whether the
            time is up.
        """
        config, shape = self.config, (len(self.taken), 2, 3)
        if np.shape(actions) != shape:
            raise ValueError(f"The actions have shape {np.shape(actions)}, expected {shape}: (vx, vy, omega) of each.")
        twists = config.scale * np.clip(np.nan_to_num(np.asarray(actions, float), posinf=0.0, neginf=0.0), -1.0, 1.0)
        length = config.cable.length
        twists = config.limits.shortened(twists, self.gripper_pose, config.interval, length) * active[:, None, None]
        after, shown = self._engine.rollout(self._physics, self._state, twists[:, None], config.interval)
        keypoints = np.asarray(self._engine.keypoints(without_bias(self._physics), after))
        poses = np.asarray(shown.gripper_pose[:, -1])
        diverged = ~(np.abs(keypoints) < config.room).all(axis=(1, 2))
        before, opening = (np.asarray(self._engine.opening(state)) for state in (self._state, after))
        torn = ~diverged & (opening > np.maximum(config.widest, before))
        self._state = jax.tree.map(
            lambda new, old: np.where(torn.reshape(-1, *[1] * (new.ndim - 1)), old, new), after, self._state
        )
        self.taken += active
        seen = active & ~diverged & ~torn
        self.gripper_pose[seen] = poses[seen]
        self._observe(seen, keypoints, np.asarray(shown.keypoints[:, -1]), randoms)
        done = (self.error <= config.tolerance) | diverged
        return -self.error, done, ~done & (self.taken >= config.steps)

    def _observe(
        self, rows: np.ndarray, true: np.ndarray, seen: np.ndarray, randoms: Sequence[np.random.Generator]
    ) -> None:
        """Takes in the true and the seen keypoints [B, N, 2] of some rows."""
        config = self.config
        self.error[rows] = shape_error_cm(true[rows], self.target[rows]) / (100.0 * config.cable.length)
        self.keypoints[rows] = seen[rows]
        if config.keypoint_noise:
            for row in np.flatnonzero(rows).tolist():
                self.keypoints[row] += config.keypoint_noise * randoms[row].standard_normal(seen.shape[1:])
