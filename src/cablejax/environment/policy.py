"""A controller as a policy of the environment: the same link that drives plants and robots."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float

from cablejax.control.controller import Controller
from cablejax.control.link import RobotLink
from cablejax.control.link_state import LinkConfig
from cablejax.control.targets import Target
from cablejax.environment.config import ShapeCableConfig
from cablejax.simulate.table_plant import Observation


class LinkPolicy:
    """Actions of a controller for one environment.

    Args:
        config: of the environment.
        controller: makes the controller for a target, for example `lambda target: make_controller(model, target,
            method="residual", solver="two-trials")`.
    """

    def __init__(self, config: ShapeCableConfig, controller: Callable[[Target], Controller]):
        self._config, self._controller = config, controller
        interval = config.interval
        self._settings = LinkConfig(interval=interval, rest=0.0, watchdog=interval, limits=None)
        self._link: RobotLink | None = None

    def begin(self, target: Target) -> None:
        """Begins an episode with this target, whose keypoints the environment must show."""
        self._link = RobotLink(self._controller(target), target, self._settings)
        self._state, self._steps = self._link.init(), 0

    def __call__(self, observation: Mapping[str, np.ndarray]) -> Float[np.ndarray, "2 3"]:
        """The action for an observation of the environment.

        Raises:
            ValueError: no episode has begun, the link has no use for the observation, or the controller has failed.
        """
        if self._link is None:
            raise ValueError("No episode has begun: call `begin` with the target before asking for an action.")
        now = self._steps * self._config.interval
        seen = Observation(observation["keypoints"], observation["gripper_pose"], now)
        self._state, reply = self._link.step(self._state, now, [seen])
        self._steps += 1
        if wrong := (*reply.refused, *filter(None, [reply.reason])):
            raise ValueError(wrong[0])
        return np.clip(reply.twist / self._config.scale, -1.0, 1.0).astype(np.float32)
