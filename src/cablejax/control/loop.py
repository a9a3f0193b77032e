"""A controller shaping the plant's cable: observe, command, wait one interval, and record all of it."""

from __future__ import annotations

import dataclasses
import time
from typing import Any, Protocol

import numpy as np
from jaxtyping import Array, Float

from cablejax.control.run import ClosedLoopRun, shape_error_cm
from cablejax.control.targets import Target
from cablejax.gaplog import Episode
from cablejax.simulate.table_plant import Observation, PlantError
from cablejax.types import History, Measurement

RESTING_CM = 0.01
"""Range of the error [cm] over `patience` commands in which nothing more is expected to happen."""


class ObservedCable(Protocol):
    """The cable to shape: a plant, or a robot behind the same two calls; see `Plant`."""

    def reset(self, gripper_pose: Float[np.ndarray, "Q 3"]) -> Observation:
        """Lays the cable at rest between these poses and observes it."""
        ...

    def record(self, twist: Float[np.ndarray, "Q 3"], interval: float, *, samples: int) -> list[Observation]:
        """Executes a twist for `interval` seconds and observes `samples` times, evenly spaced, the last at its end."""
        ...


class Controller(Protocol):
    """A controller: an object with two pure functions. `mpc.MPC` is one.

    For `control.batched` it is a pytree with a leaf `target` as well, the keypoints [N, 2] that it steers towards.
    """

    def init(self, history: History) -> Any:
        """The state before the first step, a pytree, from the last observations of the cable."""
        ...

    def step(self, state: Any, measurement: Measurement) -> tuple[Any, Float[Array | np.ndarray, "Q 3"], Any]:
        """The next state, the twist to hold until then [m/s, rad/s], and a report.

        Of the report the fields `residual_share` and `radius` are recorded, where it has them.
        """
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
    history_length: int = 6,
    rest: int = 1,
    patience: int | None = None,
) -> ClosedLoopRun:
    """Lays a new cable between the grippers and lets a controller shape it.

    A controller or plant that fails ends the run early but loses nothing: what was recorded comes back with the reason.

    Args:
        plant: what is shaped.
        controller: what shapes it.
        target: the wanted shape.
        steps: number of commands.
        start: gripper poses (x, y, theta) [m, rad] of the cable at the beginning, shape [Q, 3].
        interval: time that each command is held [s].
        record_hz: samples per second of the recorded episode.
        history_length: samples H of the history that the controller starts from, all of them the cable at rest.
        rest: intervals without motion recorded before the first command, for the noise floor.
        patience: end the run once the error has stayed within `RESTING_CM` for so many commands; None = never.

    Raises:
        ValueError: `steps` is not positive, `record_hz` does not divide the interval, the target has another number of
            keypoints than the plant shows, or the plant refuses `start`.
    """
    samples = round(interval * record_hz)
    if steps < 1 or rest < 0 or samples < 1 or abs(samples - interval * record_hz) > 1e-9:
        raise ValueError(
            f"A run of {steps} steps after {rest} at rest, with {record_hz} samples per second in intervals of "
            f"{interval} s, is not possible: give at least one step and a whole number of samples in an interval."
        )
    log = _laid_out(plant, target, np.asarray(start, float))
    still = np.zeros_like(log.observations[0].gripper_pose)
    for _ in range(rest):
        log.extend(plant.record(still, interval, samples=samples), still)
    resting, observation = len(log.observations), log.observations[-1]
    seen = _filled(observation.keypoints)
    history = History(
        keypoints=np.repeat(seen[None], history_length, axis=0),  # pyright: ignore[reportArgumentType]
        gripper_pose=observation.gripper_pose,  # pyright: ignore[reportArgumentType]
    )
    state = controller.init(history)
    controller.step(state, _measurement(observation))  # compiles; the result is not used

    rows, stopped = [_Row(observation)], None
    for _ in range(steps):
        row = rows[-1]
        began = time.perf_counter()
        try:
            state, twist, info = controller.step(state, _measurement(row.observation))
            row.twist = np.asarray(twist, float)  # waits for the result
            row.mpc_ms = 1e3 * (time.perf_counter() - began)
            row.residual_share = float(getattr(info, "residual_share", np.nan))
            row.radius = float(getattr(info, "radius", np.nan))
            observations = plant.record(row.twist, interval, samples=samples)
        except (ValueError, PlantError) as error:
            stopped = str(error)
            row.forget_command()
            break
        log.extend(observations, row.twist)
        rows.append(_Row(observations[-1]))
        if patience is not None and _at_rest(rows[-patience - 1 :], patience, target):
            break
    return _finished(target, rows, stopped, log.episode(f"approach_{target.name.lower()}", resting))


@dataclasses.dataclass
class _Row:
    """Measurement at one control instant."""

    observation: Observation
    twist: np.ndarray | None = None
    residual_share: float = np.nan
    radius: float = np.nan
    mpc_ms: float = np.nan

    def forget_command(self) -> None:
        """For a command that was not carried out."""
        self.twist, self.residual_share, self.radius, self.mpc_ms = None, np.nan, np.nan, np.nan


class _Log:
    """Samples at the camera's rate and the command that led away from each."""

    def __init__(self, first: Observation):
        self.observations = [first]
        self._commands: list[np.ndarray] = []

    def extend(self, observations: list[Observation], twist: np.ndarray) -> None:
        self.observations += observations
        self._commands += [twist] * len(observations)

    def episode(self, motion: str, resting: int) -> Episode:
        """The whole recording; `resting` samples at its beginning are of the settled cable."""
        first = self.observations[0]
        commands = [*self._commands, np.zeros_like(first.gripper_pose)]
        return Episode(
            motion=motion,
            time=np.array([observation.time - first.time for observation in self.observations]),
            keypoints=np.stack([observation.keypoints for observation in self.observations]),
            gripper_pose=np.stack([observation.gripper_pose for observation in self.observations]),
            gripper_command=np.stack(commands),
            hold=np.arange(len(commands)) < resting,
        )


def _laid_out(plant: ObservedCable, target: Target, start: np.ndarray) -> _Log:
    """A new cable's recording, which holds its first observation; raises where the target is none for this cable."""
    log = _Log(plant.reset(start))
    shape = log.observations[0].keypoints.shape
    if shape != target.keypoints.shape:
        raise ValueError(
            f"Target {target.name!r} has keypoints of shape {target.keypoints.shape}, but the cable is seen at "
            f"{shape}: use a target with as many keypoints as the cable."
        )
    return log


def _finished(target: Target, rows: list[_Row], stopped: str | None, episode: Episode) -> ClosedLoopRun:
    """The run that these control instants make."""
    keypoints = np.stack([row.observation.keypoints for row in rows])
    known = [row.observation.true_keypoints for row in rows]
    truth = np.stack([seen if true is None else true for true, seen in zip(known, keypoints, strict=True)])
    none = np.full_like(rows[0].observation.gripper_pose, np.nan)
    return ClosedLoopRun(
        target=target,
        times=np.array([row.observation.time for row in rows]) - rows[0].observation.time,
        keypoints=keypoints,
        gripper_pose=np.stack([row.observation.gripper_pose for row in rows]),
        twist=np.stack([none if row.twist is None else row.twist for row in rows]),
        error_cm=shape_error_cm(truth, target.keypoints),
        residual_share=np.array([row.residual_share for row in rows]),
        radius=np.array([row.radius for row in rows]),
        mpc_ms=np.array([row.mpc_ms for row in rows]),
        unobserved=int(np.isnan(keypoints).any(axis=-1).sum()),
        stopped=stopped,
        observed_error_cm=shape_error_cm(keypoints, target.keypoints),
        episode=episode,
    )


def _measurement(observation: Observation) -> Measurement:
    return Measurement(observation.keypoints, observation.gripper_pose)


def _at_rest(last: list[_Row], patience: int, target: Target) -> bool:
    error = shape_error_cm(np.stack([row.observation.keypoints for row in last]), target.keypoints)
    return len(last) > patience and bool(np.ptp(error) <= RESTING_CM)


def _filled(keypoints: np.ndarray) -> np.ndarray:
    """Keypoints with the ones not observed interpolated along the cable: a history has to start complete."""
    seen = np.isfinite(keypoints).all(axis=1)
    if not seen.any():
        raise ValueError("No keypoint of the cable was observed at the start: check the camera.")
    index = np.arange(len(keypoints))
    return np.stack([np.interp(index, index[seen], keypoints[seen, axis]) for axis in range(2)], axis=1)
