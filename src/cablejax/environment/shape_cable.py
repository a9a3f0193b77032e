"""The environments: one cable as a `gymnasium.Env`, and many in one compiled call as a `gymnasium.vector.VectorEnv`.

Both observe {"keypoints" [N, 2], "gripper_pose" [2, 3], "target" [N, 2]} in metres and radians, act with twists of both
grippers [2, 3] in units of the largest ones, and are rewarded with minus the error in lengths of the cable.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from cablejax.environment.cables import Cables
from cablejax.environment.config import ShapeCableConfig, require_config
from cablejax.environment.picture import picture
from cablejax.limits import require

OBSERVED = ("keypoints", "gripper_pose", "target")
"""Parts of an observation."""

_METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 5}


def _spaces(config: ShapeCableConfig, render_mode: str | None) -> tuple[gymnasium.spaces.Dict, gymnasium.spaces.Box]:
    """What is observed, and the actions; raises ValueError for another render mode, or what is no configuration."""
    require_config(config)
    if render_mode not in (None, *_METADATA["render_modes"]):
        raise ValueError(
            f"render_mode is {render_mode!r}, expected None or 'rgb_array'. To open a window, wrap the environment in "
            "`gymnasium.wrappers.HumanRendering`."
        )
    points, length = config.cable.n_keypoints, config.cable.length
    turns = 2 * np.pi + config.steps * config.turn_rate * config.interval
    pose = np.repeat(np.array([[3 * length, 3 * length, turns]], np.float32), 2, axis=0)
    cable = gymnasium.spaces.Box(-config.room, config.room, (points, 2), np.float32)
    observed: dict[str, gymnasium.Space[Any]] = dict(
        zip(OBSERVED, (cable, gymnasium.spaces.Box(-pose, pose), cable), strict=True)
    )
    return gymnasium.spaces.Dict(observed), gymnasium.spaces.Box(-1.0, 1.0, (2, 3), np.float32)


def _known(options: dict[str, Any] | None) -> dict[str, Any]:
    """The options of a reset; raises ValueError if they are no dictionary, or not those that `Cables.reset` takes."""
    options = {} if options is None else options
    if not isinstance(options, dict):
        raise ValueError(f"options is of type {type(options).__name__}, expected a dictionary with target or effects.")
    if unknown := set(options) - {"target", "effects"}:
        raise ValueError(f"There is no option {sorted(unknown)[0]!r} of `reset`, expected target or effects.")
    return options


def _require_reset(cables: Cables) -> None:
    if None in cables.names:
        raise gymnasium.error.ResetNeeded("There is no cable yet: call `reset` before `step`.")


def _pictures(env: gymnasium.Env | gymnasium.vector.VectorEnv, cables: Cables) -> list[np.ndarray]:
    """A picture of each cable; none, and a warning, where the environment was made without a render mode."""
    if env.render_mode is None:
        gymnasium.logger.warn("`render` draws nothing without a render mode: make it with render_mode='rgb_array'.")
        return []
    _require_reset(cables)
    parts = zip(cables.keypoints, cables.gripper_pose, cables.target, strict=True)
    return [picture(*part, cables.config.cable.length) for part in parts]


class ShapeCableEnv(gymnasium.Env):
    """`cablejax/ShapeCable-v0`: bring a cable on a table to a shape by moving both of its ends.

    `info` has "error" [lengths of the cable], "executed_action", what of the last action was executed (see
    `Cables.executed`), and "target_name". `reset` takes the options "target" and "effects".

    Args:
        config: see `ShapeCableConfig`.
        render_mode: None, or "rgb_array" for `render`.
    """

    metadata = _METADATA
    """Gymnasium's description of the environment."""

    def __init__(self, config: ShapeCableConfig = ShapeCableConfig(), render_mode: str | None = None):
        self.config, self.render_mode = config, render_mode
        self.observation_space, self.action_space = _spaces(config, render_mode)
        self.cables = Cables(config, 1)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """A new cable; see `Cables.reset` for the options."""
        super().reset(seed=seed)
        self.cables.reset(0, self.np_random, **_known(options))
        return self._observation(), self._info()

    def step(self, action):
        """One action; see `Cables.step`."""
        if np.shape(action) != (2, 3):
            raise ValueError(
                f"The action has shape {np.shape(action)}, expected (2, 3): (vx, vy, omega) of both grippers."
            )
        _require_reset(self.cables)
        rewards, terminated, truncated = self.cables.step(np.asarray(action)[None], [self.np_random], np.array([True]))
        return self._observation(), float(rewards[0]), bool(terminated[0]), bool(truncated[0]), self._info()

    def render(self) -> np.ndarray | None:
        """The table from above as an image, shape [480, 480, 3]; None without a render mode."""
        return next(iter(_pictures(self, self.cables)), None)

    def _observation(self) -> dict[str, np.ndarray]:
        return {name: getattr(self.cables, name)[0].copy() for name in OBSERVED}

    def _info(self) -> dict[str, Any]:
        cables = self.cables
        return {
            "error": float(cables.error[0]),
            "executed_action": cables.executed[0].copy(),
            "target_name": cables.names[0],
        }


class ShapeCableVectorEnv(gymnasium.vector.VectorEnv):
    """Many of `ShapeCableEnv` in one compiled call. An environment that has ended is reset by the next step.

    Args:
        num_envs: cables side by side.
        config: see `ShapeCableConfig`.
        render_mode: None, or "rgb_array" for `render`.
    """

    metadata = _METADATA | {"autoreset_mode": AutoresetMode.NEXT_STEP}
    """Gymnasium's description of the environment."""

    def __init__(self, num_envs: int, config: ShapeCableConfig = ShapeCableConfig(), render_mode: str | None = None):
        require(num_envs, "count", "num_envs")
        self.num_envs, self.config, self.render_mode = num_envs, config, render_mode
        self.single_observation_space, self.single_action_space = _spaces(config, render_mode)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.cables = Cables(config, num_envs)
        self._randoms = [np_random()[0] for _ in range(num_envs)]
        self._ended = np.zeros(num_envs, bool)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None):
        """New cables everywhere; environment i has the seed `seed + i`. The options are those of `Cables.reset`.

        Raises:
            ValueError: another number of seeds than of environments, or see `Cables.reset`.
        """
        one = isinstance(seed, int | np.integer)
        seeds = [int(seed) + row for row in range(self.num_envs)] if one else seed
        if seeds is not None and np.shape(seeds) != (self.num_envs,):
            count = len(seeds) if np.ndim(seeds) else "no whole"
            raise ValueError(f"There are {count} seeds, expected one number, or one for each of {self.num_envs}.")
        for row, own in enumerate([] if seeds is None else seeds):
            if own is not None:
                self._randoms[row] = np_random(int(own))[0]
        options = _known(options)
        for row, random in enumerate(self._randoms):
            self.cables.reset(row, random, **options)
        self._ended[:] = False
        return self._observation(), self._info()

    def step(self, actions):
        """One action of each; those that ended before are reset instead, with a reward of 0."""
        _require_reset(self.cables)
        ended = self._ended
        rewards, terminated, truncated = self.cables.step(actions, self._randoms, ~ended)
        for row in np.flatnonzero(ended).tolist():
            self.cables.reset(row, self._randoms[row])
        terminated, truncated, rewards = terminated & ~ended, truncated & ~ended, np.where(ended, 0.0, rewards)
        self._ended = terminated | truncated
        return self._observation(), rewards, terminated, truncated, self._info()

    def render(self) -> tuple[np.ndarray, ...] | None:
        """An image of each environment's table, as of `ShapeCableEnv`; None without a render mode."""
        return tuple(_pictures(self, self.cables)) or None

    def _observation(self) -> dict[str, np.ndarray]:
        return {name: getattr(self.cables, name).copy() for name in OBSERVED}

    def _info(self) -> dict[str, Any]:
        cables = self.cables
        return {
            "error": cables.error.copy(),
            "executed_action": cables.executed.copy(),
            "target_name": np.array(cables.names),
        }
