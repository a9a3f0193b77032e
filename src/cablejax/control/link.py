"""Runs a controller on a cable that sends observations and takes commands: a state machine without a transport.

Simulated plants (`control.loop`), a socket (`robot.server`) and ROS (`robot.ros_node`) all drive this one.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from cablejax.arrays import filled
from cablejax.control.controller import Controller, check_interval, resting
from cablejax.control.link_state import Instant, LinkConfig, LinkState, Reply, Status
from cablejax.control.run import shape_error_cm
from cablejax.control.targets import Target
from cablejax.limits import LIMITS, require
from cablejax.log_geometry import MOVED, ends_exchanged, out_of_reach
from cablejax.simulate.table_plant import Observation
from cablejax.types import Measurement

RESTING_CM = 0.01
"""Range of the error [cm] over `patience` commands in which nothing more is expected to happen."""
EARLY = 0.02
"""By how much an observation may come before a control instant and count as its own, in intervals."""
DRIFT = 1e-3
"""Rate at which the two clocks may drift apart; a delay that grows more slowly is not noticed."""

_KIND = 16
"""Letters by which reasons of one kind agree."""
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
        self.controller.step(self._initial(seen), Measurement(seen.keypoints, seen.gripper_pose))

    def init(self) -> LinkState:
        """The state before the first observation."""
        still = (_STILL, -math.inf, math.inf)
        return LinkState(Status.WAITING, "", None, None, None, math.inf, -math.inf, -math.inf, still, 0, ())

    def step(self, state: LinkState, now: float, observations: Sequence[Observation] = ()) -> tuple[LinkState, Reply]:
        """Processes observations and returns what the grippers must do.

        If a controller rejects its input, the reply states the reason. The link waits for another first history; later,
        the run stops.

        Args:
            state: from the last step.
            now: the link's clock [s]. Where it is set back, time goes on from where it was: a watchdog has to run out.
            observations: that have come since the last step, in the order in which they came.
        """
        settled, behind = state.commands == 0, max(state.behind, state.now - now)
        now = now + behind
        state = dataclasses.replace(
            state, now=now, behind=behind, offset=state.offset + DRIFT * max(now - state.now, 0.0)
        )
        accepted, refused = [], []
        for observation in observations:
            try:
                state, cleaned = self._take(state, observation)
                accepted.append(cleaned)
            except (ValueError, TypeError, OverflowError) as error:
                refused.append(str(error))
                if state.newest is None:
                    state = dataclasses.replace(state, reason=refused[-1])
        state, instant = self._decide(state)
        twist, since, until = state.command
        if now - state.offset >= until:
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

    def _take(self, state: LinkState, observation: Observation) -> tuple[LinkState, Observation]:
        """The state with an observation, and the observation as it is logged; raises where it cannot be used at all."""
        stamp = float(observation.time)
        require(stamp, "stamp", "The time stamp", "Is it in seconds?")
        keypoints, pose = np.array(observation.keypoints, float), np.array(observation.gripper_pose, float)
        shape = self.target.keypoints.shape
        if keypoints.shape != shape or pose.shape != (2, 3):
            raise ValueError(
                f"An observation has keypoints of shape {keypoints.shape} and poses of shape {pose.shape}, expected "
                f"{shape} as the target and (2, 3)."
            )
        offset = state.now - stamp
        if math.isfinite(state.offset) and state.offset - offset > self.config.watchdog:
            raise ValueError(
                f"The time stamp {stamp:.9g} s is {state.offset - offset:.3g} s ahead of the robot's clock."
            )
        last = state.newest
        largest = LIMITS["coordinate"].high
        if not (np.abs(pose) <= largest).all():
            pose[:] = np.nan
        elif last is not None:  # readings of an angle may be wrapped
            pose[:, 2] += 2 * np.pi * np.round((last.gripper_pose[:, 2] - pose[:, 2]) / (2 * np.pi))
        # an absent pose can only be judged by the last one
        near = pose if np.isfinite(pose).all() or last is None else last.gripper_pose
        keypoints[~(np.abs(keypoints) <= largest)] = np.nan
        if last is not None and ends_exchanged(pose[:, :2], last.gripper_pose[:, :2], self.target.length):
            raise ValueError(
                "Each gripper is at the other one's last position: their order has changed. Start the run again."
            )
        if ends_exchanged(keypoints, near[:, :2], self.target.length):
            raise ValueError(
                "The first keypoint is at gripper 1 and the last at gripper 0: exchange the grippers, or reverse the "
                "order of the keypoints."
            )
        keypoints[out_of_reach(keypoints, near[:, :2], self.target.length)] = np.nan
        cleaned = dataclasses.replace(observation, keypoints=keypoints, gripper_pose=pose, time=stamp)
        unchanged = state.unchanged
        if unchanged is None or not np.array_equal(keypoints, unchanged.keypoints, equal_nan=True):
            unchanged = cleaned
        elif not np.isfinite(unchanged.gripper_pose).all():  # where the grippers were when it stopped is not known
            unchanged = dataclasses.replace(unchanged, gripper_pose=pose)
        elif np.linalg.norm((pose - unchanged.gripper_pose)[:, :2], axis=1).max() > MOVED * self.target.length:
            # a tracker that has stopped repeats its last frame
            cleaned = dataclasses.replace(cleaned, keypoints=np.full_like(keypoints, np.nan))
        state = dataclasses.replace(state, offset=min(state.offset, offset), unchanged=unchanged)
        share = np.isfinite(cleaned.keypoints).all(axis=1).mean()
        newer = last is None or stamp > last.time
        if last is not None and state.status == Status.PAUSED and last.time - stamp > self.config.watchdog:
            behind = (
                f"The newest time stamp is {last.time - stamp:.3g} s before an earlier one: was the clock set back?"
            )
            state = _for_reason(state, behind)
        elif newer and state.status == Status.PAUSED and (old := offset - state.offset) > self.config.watchdog:
            state = _for_reason(state, f"Observations are {old:.3g} s old: do they arrive late, or was a clock set?")
        if newer and share >= self.config.min_seen and np.isfinite(pose).all():
            state = dataclasses.replace(state, newest=cleaned)
        elif state.newest is None:
            state = dataclasses.replace(state, reason=self._unusable(pose, share))
        return state, cleaned

    def _unusable(self, pose: np.ndarray, share: float) -> str:
        """Why there is nothing to begin with in an observation."""
        apart = float(np.linalg.norm(pose[1, :2] - pose[0, :2]))
        if not np.isfinite(pose).all():
            return "The grippers' poses are not known yet."
        if apart > 2 * self.target.length:
            return (
                f"The grippers are {apart:.3g} m apart, but the cable is {self.target.length:.3g} m long: are poses "
                "and keypoints in metres?"
            )
        return (
            f"{100 * share:.0f} % of the keypoints are known and within reach of the grippers, expected "
            f"{100 * self.config.min_seen:.0f} %: are they in metres, in the grippers' frame?"
        )

    def _decide(self, state: LinkState) -> tuple[LinkState, Instant | None]:
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
        return self._command(dataclasses.replace(state, status=Status.SHAPING), newest)

    def _command(self, state: LinkState, seen: Observation) -> tuple[LinkState, Instant]:
        """A control instant."""
        config, instant = self.config, Instant(seen)
        if config.patience is not None:
            error = float(shape_error_cm(seen.keypoints, self.target.keypoints))
            state = dataclasses.replace(state, errors=(*state.errors, error)[-config.patience - 1 :])
            if len(state.errors) > config.patience and np.ptp(state.errors) <= RESTING_CM:
                return self._held(state, Status.DONE, "The error has settled."), instant
        if state.commands == config.steps:
            return self._held(state, Status.DONE, f"All {config.steps} commands were sent."), instant
        began = time.perf_counter()
        try:
            controller, twist, info = self.controller.step(
                state.controller, Measurement(seen.keypoints, seen.gripper_pose)
            )
            twist = np.asarray(twist, float)  # waits for the result
            if twist.shape != _STILL.shape or not np.isfinite(twist).all():
                raise ValueError(f"The controller's command is not finite or not of shape (2, 3): {twist.tolist()}.")
        except ValueError as error:
            return self._held(state, Status.STOPPED, str(error)), instant
        spent = 1e3 * (time.perf_counter() - began)
        allowed = twist
        if config.limits is not None:
            held = config.interval + config.grace
            allowed = config.limits.shortened(twist, seen.gripper_pose, held, self.target.length)
        share, radius, action = (float(getattr(info, n, math.nan)) for n in ("residual_share", "radius", "action"))
        instant = Instant(seen, allowed, share, radius, action, spent, limited=allowed is not twist)
        state = dataclasses.replace(
            state,
            reason="" if allowed.any() or not twist.any() else "The limits reduce the controller's command to zero.",
            controller=controller,
            due=seen.time + config.interval,
            # what comes late is commanded late
            command=(allowed, max(seen.time, state.now - state.offset), seen.time + config.interval + config.grace),
            commands=state.commands + 1,
        )
        return state, instant

    def _initial(self, seen: Observation) -> Any:
        """The controller's state for a cable at rest, as it is seen now."""
        return self.controller.init(resting(self.controller, _complete(seen.keypoints), seen.gripper_pose))


def _for_reason(state: LinkState, reason: str) -> LinkState:
    """The state with this reason; one of the same kind, whose number alone changes, stays as it was first."""
    return state if state.reason[:_KIND] == reason[:_KIND] else dataclasses.replace(state, reason=reason)


def _complete(keypoints: np.ndarray) -> np.ndarray:
    """Keypoints with the ones not observed interpolated along the cable: a history has to start complete."""
    if not np.isfinite(keypoints).all(axis=1).any():
        raise ValueError("No keypoint of the cable was observed at the start: check the camera.")
    return filled(keypoints)
