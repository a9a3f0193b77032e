"""A controller as a policy of the environment: the same link that drives plants and robots."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float

from cablejax.control.link import Controller, RobotLink
from cablejax.control.link_state import LinkConfig, Status
from cablejax.control.targets import Target
from cablejax.environment.cables import ShapeCableConfig
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

    def begin(self, target: Target) -> None:
        """Begins an episode with this target, the one whose keypoints the environment shows."""
        self._link = RobotLink(self._controller(target), target, self._settings)
        self._state, self._steps = self._link.init(), 0

    def __call__(self, observation: Mapping[str, np.ndarray]) -> Float[np.ndarray, "2 3"]:
        """The action for an observation of the environment.

        Raises:
            ValueError: the controller has failed.
        """
        now = self._steps * self._config.interval
        seen = Observation(observation["keypoints"], observation["gripper_pose"], now)
        self._state, reply = self._link.step(self._state, now, [seen])
        self._steps += 1
        if reply.reason and reply.status != Status.WAITING:
            raise ValueError(reply.reason)
        return np.clip(reply.twist / self._config.scale, -1.0, 1.0).astype(np.float32)
