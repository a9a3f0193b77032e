"""The interface of a controller of a cable."""

from __future__ import annotations

import math
from typing import Any, Protocol

import numpy as np
from jaxtyping import Array, Float

from cablejax.types import History, Measurement

_HISTORY = 6
"""Samples of a first history where the controller does not say."""


class Controller(Protocol):
    """A controller: an object with two pure functions. `mpc.MPC` is one.

    For `control.batched` it is a pytree with a leaf `target` as well, the keypoints [N, 2] that it steers towards. One
    that was made for a certain time between commands has it as `interval` [s], and one that wants another number of
    samples in its first history than 6 has that as `history_length`.
    """

    def init(self, history: History) -> Any:
        """The state before the first step, a pytree, from the last observations of the cable."""
        ...

    def step(self, state: Any, measurement: Measurement) -> tuple[Any, Float[Array | np.ndarray, "Q 3"], Any]:
        """The next state, the twist to hold until then [m/s, rad/s], and a report.

        Of the report the fields `residual_share`, `radius` and `action` are recorded, where it has them.
        """
        ...


def check_interval(controller: Controller, interval: float) -> None:
    """Raises ValueError if a controller was made for another time between commands [s]."""
    own = getattr(controller, "interval", interval)
    if not math.isclose(own, interval):
        raise ValueError(
            f"The controller plans for {own:g} s between commands, but the interval of this run is {interval:g} s. Set "
            "both to the same value: `interval` of the run, and of `MPCConfig.objective`."
        )


def resting(controller: Controller, keypoints: Array | np.ndarray, gripper_pose: Array | np.ndarray) -> History:
    """The history with which a controller begins, of a cable that rests at these keypoints [N, 2]."""
    samples = getattr(controller, "history_length", _HISTORY)
    repeated = keypoints.__array_namespace__().repeat(keypoints[None], samples, axis=0)
    return History(keypoints=repeated, gripper_pose=gripper_pose)  # pyright: ignore[reportArgumentType]
