"""The closed loop on a plant: observe, command, wait one interval, and record everything."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from jaxtyping import Float

from cablejax.control.controller import Controller
from cablejax.control.link import RobotLink
from cablejax.control.link_state import LinkConfig, Status
from cablejax.control.run import ClosedLoopRun
from cablejax.control.run_log import RunLog
from cablejax.control.targets import Target
from cablejax.limits import require
from cablejax.simulate.table_plant import Observation


class ObservedCable(Protocol):
    """The cable to shape: a plant, or a robot behind the same two calls; see `Plant`."""

    def reset(self, gripper_pose: Float[np.ndarray, "Q 3"]) -> Observation:
        """Lays the cable at rest between these poses and observes it."""
        ...

    def record(self, twist: Float[np.ndarray, "Q 3"], interval: float, *, samples: int) -> list[Observation]:
        """Executes a twist for `interval` seconds and observes `samples` times, evenly spaced, the last at its end."""
        ...


def run_closed_loop(
    plant: ObservedCable,
    controller: Controller,
    target: Target,
    steps: int,
    *,
    start: Float[np.ndarray, "Q 3"],
    interval: float = 1.0,
    record_hz: float = 10.0,
    patience: int | None = None,
) -> ClosedLoopRun:
    """Lays a new cable between the grippers and lets a controller shape it.

    One interval without motion is recorded before the first command, for the noise floor.

    A controller or plant that fails ends the run early but loses nothing: what was recorded comes back with the reason.

    Args:
        plant: what is shaped.
        controller: what shapes it.
        target: the wanted shape.
        steps: number of commands.
        start: gripper poses (x, y, theta) [m, rad] of the cable at the beginning, shape [Q, 3].
        interval: time that each command is held [s].
        record_hz: samples per second of the recorded episode.
        patience: as in `LinkConfig`.

    Raises:
        ValueError: `steps` is not positive or more than an episode of a log holds, `record_hz` does not divide the
            interval, the target has another number of keypoints than the plant shows, or the plant refuses `start`.
    """
    samples = round(interval * record_hz)
    if steps < 1 or samples < 1 or abs(samples - interval * record_hz) > 1e-9:
        raise ValueError(
            f"A run of {steps} steps with {record_hz} samples per second, in intervals of {interval} s, is not "
            "possible: give at least one step, and a whole number of samples in each interval."
        )
    require(
        (steps + 1) * interval, "duration", "The time of a run", "A log's episode cannot be longer: make several runs."
    )
    first = plant.reset(np.asarray(start, float))
    if first.keypoints.shape != target.keypoints.shape:
        raise ValueError(
            f"Target {target.name!r} has keypoints of shape {target.keypoints.shape}, but the cable is seen at "
            f"{first.keypoints.shape}: use a target with as many keypoints as the cable."
        )
    config = LinkConfig(
        interval=interval,
        rest=interval,
        steps=steps,
        patience=patience,
        # a plant never keeps its controller waiting, and sets its own bounds
        watchdog=interval,
        min_seen=0.0,
        limits=None,
    )
    link, log, observations, stopped = RobotLink(controller, target, config), RunLog(), [first], None
    link.warm_up(first)
    state = link.init()
    while True:
        state, reply = link.step(state, observations[-1].time, observations)
        log.add(reply)
        if reply.status in (Status.WAITING, Status.PAUSED):
            stopped = f"The observations of the plant cannot be used: {reply.refused or reply.reason}"
            if not log.instants:
                raise ValueError(stopped)
            break
        if reply.status.ended:
            stopped = reply.reason if reply.status == Status.STOPPED else None
            break
        try:
            observations = plant.record(reply.twist, interval, samples=samples)
        except ValueError as error:
            if not log.instants:
                raise
            stopped = str(error)
            log.forget_command()
            break
    return log.run(target, stopped)
