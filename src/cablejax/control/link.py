"""Runs a controller on a cable that sends observations and takes commands: a state machine without a transport.

Simulated plants (`control.loop`), a socket (`robot.server`) and ROS (`robot.ros_node`) all drive this one.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from cablejax.arrays import filled
from cablejax.control.controller import Controller, check_interval, resting
from cablejax.control.link_observation import held_ends, take
from cablejax.control.link_state import Instant, LinkConfig, LinkState, Reply, Status
from cablejax.control.run import shape_error_cm
from cablejax.control.targets import Target
from cablejax.simulate.table_plant import Observation
from cablejax.types import Measurement

RESTING_CM = 0.01
"""Range of the error [cm] over `patience` commands in which nothing more is expected to happen."""
NOISE_RANGE = 5.0
"""The same in standard deviations of the error's noise, where that is more: a dozen normal deviates range over 3.3."""
_FEWEST = 5
"""Observations at rest from which that noise is estimated, at least."""
EARLY = 0.02
"""By how much an observation may come before a control instant and count as its own, in intervals."""
DRIFT = 1e-3
"""Rate at which the two clocks may drift apart; a delay that grows more slowly is not noticed."""

_STILL = np.zeros((2, 3))


@dataclasses.dataclass(frozen=True)
class RobotLink:
    """A controller's side of a robot: observations in, commands out, with a watchdog and limits.

    `init` once, then `step` whenever observations have come, and often enough for the watchdog where none have. Both
    are pure: the transport owns the state, and `RunLog` collects the replies. Observations may be lost, late, doubled,
    out of order, not finite or nonsense. Time stamps are the robot's; its clock need not be the link's.

    Attributes:
        controller: what shapes the cable.
        target: the wanted shape.
        config: see `LinkConfig`.

    Raises:
        ValueError: the controller was made for another interval.
    """

    controller: Controller
    target: Target
    config: LinkConfig = LinkConfig()

    def __post_init__(self):
        check_interval(self.controller, self.config.interval)

    def warm_up(self, observation: Observation | None = None) -> None:
        """Compiles the controller, half a minute or more, before anything moves.

        Args:
            observation: like those to come; by default the target itself.
        """
        seen = observation or Observation(self.target.keypoints, self.target.gripper_pose, 0.0)
        self.controller.step(self._initial(seen), self._measured(seen, _STILL))

    def init(self) -> LinkState:
        """The state before the first observation."""
        still = (_STILL, -math.inf, math.inf)
        return LinkState(Status.WAITING, "", None, None, None, math.inf, -math.inf, -math.inf, still, 0, ())

    def step(
        self,
        state: LinkState,
        now: float,
        observations: Sequence[Observation] = (),
        clock: Callable[[], float] | None = None,
    ) -> tuple[LinkState, Reply]:
        """Processes observations and returns what the grippers must do.

        If a controller rejects its input, the reply states the reason. The link waits for another first history; later,
        the run stops.

        Args:
            state: from the last step.
            now: the link's clock [s]. Where it is set back, time goes on from where it was: a watchdog has to run out.
            observations: that have come since the last step, in the order in which they came.
            clock: reads the link's clock when a command has been computed, since which it holds; None = the clock
                stands still meanwhile, as a simulated one does.
        """
        settled, behind = state.commands == 0, max(state.behind, state.now - now)
        now = now + behind
        state = dataclasses.replace(
            state, now=now, behind=behind, offset=state.offset + DRIFT * max(now - state.now, 0.0)
        )
        accepted, refused = [], []
        for observation in observations:
            try:
                state, cleaned = take(self.target, self.config, state, observation)
                accepted.append(cleaned)
            except (ValueError, TypeError, OverflowError) as error:
                refused.append(str(error))
                if state.newest is None:
                    state = dataclasses.replace(state, reason=refused[-1])
        state, instant = self._decide(state, clock)
        twist, since, until = state.command
        if state.now - state.offset >= until:
            twist, since, until = _STILL, until, math.inf
        reply = Reply(
            twist,
            since,
            until,
            state.status,
            state.reason,
            () if state.status == Status.WAITING else tuple(accepted),
            tuple(refused),
            settled,
            instant,
        )
        return state, reply

    def stop(self, state: LinkState, reason: str) -> LinkState:
        """The state in which the grippers hold for good; a run that has already ended stays as it ended."""
        return state if state.status.ended else self._held(state, Status.STOPPED, reason)

    def _waiting(self, state: LinkState, reason: str) -> LinkState:
        """Holds until there are usable observations; before the first command as if there had been none."""
        if state.commands == 0:  # the first time stamps may have been wrong
            return dataclasses.replace(self.init(), now=state.now, behind=state.behind, reason=reason)
        return self._held(state, Status.PAUSED, reason)

    def _held(self, state: LinkState, status: Status, reason: str) -> LinkState:
        command = (_STILL, state.now - state.offset, math.inf)
        return dataclasses.replace(state, status=status, reason=reason, command=command)

    def _decide(self, state: LinkState, clock: Callable[[], float] | None) -> tuple[LinkState, Instant | None]:
        config, newest = self.config, state.newest
        if state.status.ended or newest is None:
            return state, None
        age = state.now - state.offset - newest.time
        if age > config.watchdog:
            if state.status == Status.PAUSED:
                return state, None
            expected = f", expected one every {config.watchdog:g} s or sooner" if state.commands == 0 else ""
            return self._waiting(state, f"No usable observation for {age:.2f} s{expected}."), None
        if state.status in (Status.WAITING, Status.PAUSED):
            state = dataclasses.replace(
                self._held(state, Status.RESTING, ""), due=newest.time + config.rest, controller=None
            )
        if newest.time < state.due - EARLY * config.interval:
            return state, None
        if state.controller is None:  # what happened in a pause is not the model's error
            try:
                state = dataclasses.replace(state, controller=self._initial(newest))
            except ValueError as error:
                return self._waiting(state, str(error)), None
        return self._command(dataclasses.replace(state, status=Status.SHAPING), newest, clock)

    def _command(
        self, state: LinkState, seen: Observation, clock: Callable[[], float] | None
    ) -> tuple[LinkState, Instant]:
        """A control instant."""
        config, instant = self.config, Instant(seen)
        if config.patience is not None:
            error = float(shape_error_cm(seen.keypoints, self.target.keypoints))
            state = dataclasses.replace(state, errors=(*state.errors, error)[-config.patience - 1 :])
            if len(state.errors) > config.patience and np.ptp(state.errors) <= _resting_cm(state.at_rest):
                return self._held(state, Status.DONE, "The error has settled."), instant
        if state.commands == config.steps:
            return self._held(state, Status.DONE, f"All {config.steps} commands were sent."), instant
        began = time.perf_counter()
        try:
            controller, twist, info = self.controller.step(state.controller, self._measured(seen, state.command[0]))
            twist = np.asarray(twist, float)  # waits for the result
            if twist.shape != _STILL.shape or not np.isfinite(twist).all():
                raise ValueError(f"The controller's command is not finite or not of shape (2, 3): {twist.tolist()}.")
        except ValueError as error:
            return self._held(state, Status.STOPPED, str(error)), instant
        spent = 1e3 * (time.perf_counter() - began)
        now = state.now if clock is None else max(state.now, clock() + state.behind)
        allowed = self._allowed(twist, seen, state.command)
        share, radius, action = (float(getattr(info, n, math.nan)) for n in ("residual_share", "radius", "action"))
        instant = Instant(seen, allowed, share, radius, action, spent, limited=allowed is not twist)
        state = dataclasses.replace(
            state,
            now=now,
            reason="" if allowed.any() or not twist.any() else "The limits reduce the controller's command to zero.",
            controller=controller,
            due=seen.time + config.interval,
            # what comes late is commanded late
            command=(allowed, max(seen.time, now - state.offset), seen.time + config.interval + config.grace),
            commands=state.commands + 1,
        )
        return state, instant

    def _allowed(self, twist: np.ndarray, seen: Observation, last: tuple[np.ndarray, float, float]) -> np.ndarray:
        """The command within the limits, whenever it begins between its observation and the end of the last one."""
        limits, length = self.config.limits, self.target.length
        if limits is None:
            return twist
        held = self.config.interval + self.config.grace
        going_on = float(np.clip(last[2] - seen.time, 0.0, held)) if last[0].any() else 0.0
        at_once = limits.shortened(twist, seen.gripper_pose, held, length)
        return limits.shortened(at_once, seen.gripper_pose + going_on * last[0], held - going_on, length)

    def _measured(self, seen: Observation, commanded: np.ndarray) -> Measurement:
        """What the controller gets: where the link has limits, with the twist that they left of its last command."""
        keypoints = held_ends(seen)
        if self.config.limits is None:
            return Measurement(keypoints, seen.gripper_pose)
        return Measurement(keypoints, seen.gripper_pose, commanded)

    def _initial(self, seen: Observation) -> Any:
        """The controller's state for a cable at rest, as it is seen now."""
        if not np.isfinite(seen.keypoints).all(axis=1).any():
            raise ValueError("No keypoint of the cable was observed at the start: check the camera.")
        # a history has to start complete
        return self.controller.init(resting(self.controller, filled(held_ends(seen)), seen.gripper_pose))


def _resting_cm(at_rest: Sequence[float]) -> float:
    """Range of the error [cm] in which nothing more is expected to happen: `RESTING_CM`, or what noise alone makes.

    Args:
        at_rest: the error [cm] in observations of the cable at rest, whose changes from one to the next are noise.
    """
    noise = float(np.std(np.diff(at_rest))) / math.sqrt(2) if len(at_rest) >= _FEWEST else 0.0
    return max(RESTING_CM, NOISE_RANGE * noise)
