"""Times a control call."""

from __future__ import annotations

import dataclasses
import time

import jax
import numpy as np
from jaxtyping import Float

from cablejax.mpc.controller import MPC
from cablejax.types import History, Measurement


@dataclasses.dataclass(frozen=True)
class ControlTiming:
    """Wall times of one control call.

    Attributes:
        first_call_s: the first call, compilation included [s].
        call_ms: each later call [ms], shape [repeats].
    """

    first_call_s: float
    call_ms: Float[np.ndarray, " repeats"]

    @property
    def p50_ms(self) -> float:
        """Median [ms]."""
        return float(np.percentile(self.call_ms, 50))

    @property
    def p95_ms(self) -> float:
        """95th percentile [ms]."""
        return float(np.percentile(self.call_ms, 95))


def time_control(controller: MPC, history: History, repeats: int = 30) -> ControlTiming:
    """Times `controller.step`, from the observation to the command on the host.

    The loop is closed through the controller's own prediction, so that its window fills, its plans are warm and the
    work is that of a real run.

    Raises:
        ValueError: if `repeats` is not positive.
    """
    if repeats < 1:
        raise ValueError(f"time_control got repeats={repeats}, expected at least 1.")
    state = controller.init(history)
    measurement = Measurement(np.asarray(history.keypoints[-1]), np.asarray(history.gripper_pose))
    seconds = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        state, twist, _ = jax.block_until_ready(controller.step(state, measurement))
        seconds.append(time.perf_counter() - start)
        pose = measurement.gripper_pose + controller.config.objective.interval * np.asarray(twist)
        measurement = Measurement(np.asarray(state.last.predicted), pose)
    return ControlTiming(first_call_s=seconds[0], call_ms=1e3 * np.asarray(seconds[1:]))
