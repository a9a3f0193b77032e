"""A batch of cables to be shaped by actions: the state, the reward and the randomisation of the environments."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Bool, Float

from cablejax.arrays import real
from cablejax.control.run import shape_error_cm
from cablejax.control.targets import Shape, Target, straight_start
from cablejax.dataset.drawing import cable_params, draw_parameters
from cablejax.dataset.schema import Randomisation
from cablejax.effects.camera import without_bias
from cablejax.effects.physics import Physics
from cablejax.environment.config import EffectText, ShapeCableConfig
from cablejax.simulate.chain.engine import ChainEngine
from cablejax.types import CableState


class Cables:
    """B cables between two grippers each. Arrays are NumPy's; the simulation is one compiled call for all of them.

    Attributes:
        config: see `ShapeCableConfig`.
        keypoints: observed [m], float32, shape [B, N, 2].
        gripper_pose: (x, y, theta) [m, rad], theta counting turns, float32, shape [B, 2, 3].
        target: wanted keypoints [m], float32, shape [B, N, 2].
        error: root mean square distance of the true keypoints to the target [lengths of the cable], shape [B].
        taken: actions in this episode, shape [B].
        executed: the last action after its limits, in the same units, see `step`; 0 where it was not executed and after
            a reset, float32, shape [B, 2, 3].
        names: of the targets; None before the first reset.
    """

    def __init__(self, config: ShapeCableConfig, size: int):
        self.config = config
        self._engine = ChainEngine(config.discretisation)
        self._recipe = config.recipe(config.effects)
        self._targets = [config.target(target) for target in config.targets]
        pose = straight_start(config.cable)
        self._laid = self._engine.initial_state(pose[None])
        drawn = cable_params(self._recipe, draw_parameters(self._recipe, np.random.default_rng(0)))
        one = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32)[None], drawn)
        self._start, self._shown = self._at_rest(one)
        if not np.isfinite(self._shown).all():
            raise ValueError(self._diverges)

        def rows(leaf):
            return np.repeat(np.asarray(leaf), size, axis=0)

        self._physics, self._state = jax.tree.map(rows, (one, self._start))
        points = config.cable.n_keypoints
        self.keypoints, self.target = np.zeros((2, size, points, 2), np.float32)
        self.gripper_pose = rows(np.asarray(pose, np.float32)[None])
        self.error, self.taken = np.zeros(size), np.zeros(size, int)
        self.executed = np.zeros((size, 2, 3), np.float32)
        self.names: list[str | None] = [None] * size

    def _at_rest(self, physics: Physics) -> tuple[CableState, Float[np.ndarray, "2 N 2"]]:
        """One cable before its first action: its state, its true and its seen keypoints [m]; NaN where it diverges."""
        start = self._engine.settled(physics, self._laid, self.config.interval)
        rest = self._engine.rollout(physics, start, np.zeros((1, 1, 2, 3)))[1]
        true = self._engine.keypoints(without_bias(physics), start)
        shown = np.stack([np.asarray(true[0]), np.asarray(rest.keypoints[0, 0])])
        return start, shown if np.isfinite(rest.keypoints).all() else np.full_like(shown, np.nan)

    @property
    def _diverges(self) -> str:
        return (
            f"The simulation of this cable by {self.config.discretisation.n_links} links diverges at rest. Check the "
            "numbers of the cable and of its effects, and their units, or take a discretisation with fewer links "
            "(n_links)."
        )

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
            ValueError: the target does not fit the cable, a cable with these effects diverges at rest, or see
                `ShapeCableConfig.recipe`.
        """
        config = self.config
        drawn = self._targets[random.integers(len(self._targets))]
        chosen = drawn if target is None else config.target(target)
        recipe = self._recipe if effects is None else config.recipe(effects)
        physics = cable_params(recipe, draw_parameters(recipe, random))
        batch = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32)[None], physics)
        start, shown = self._start, self._shown
        # without effects all cables lie alike, whatever their parameters
        if recipe.effects != self._recipe.effects or (recipe.effects and config.randomisation != Randomisation()):
            rested, seen = self._at_rest(batch)
            if np.isfinite(seen).all():
                start, shown = rested, seen
            elif effects is not None:
                raise ValueError(self._diverges)
            # one that was drawn ends its own episode, with its first action

        def put(whole, leaf):
            whole[row] = leaf
            return whole

        # what a simulation returned is read-only: it is copied once, not for every cable that is reset after it
        self._state = jax.tree.map(lambda leaf: np.require(leaf, requirements="W"), self._state)
        jax.tree.map(put, self._physics, physics)
        jax.tree.map(lambda whole, leaf: put(whole, leaf[0]), self._state, start)
        self.target[row], self.names[row] = chosen.keypoints, chosen.name
        self.gripper_pose[row] = np.asarray(start.gripper_pose[0])
        self.taken[row], self.executed[row] = 0, 0.0
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
        twists = config.twist(real(actions, "The actions have"), self.gripper_pose) * active[:, None, None]
        after, shown = self._engine.rollout(self._physics, self._state, twists[:, None], config.interval)
        keypoints, diverged, torn = map(np.asarray, config.outcome(self._engine, self._physics, self._state, after))
        poses = np.asarray(shown.gripper_pose[:, -1])
        self._state = jax.tree.map(
            lambda new, old: np.where(torn.reshape(-1, *[1] * (new.ndim - 1)), old, new), after, self._state
        )
        self.taken += active
        self.executed = np.where((torn | diverged)[:, None, None], 0.0, twists / config.scale).astype(np.float32)
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
