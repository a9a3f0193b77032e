"""Settings of a link, its state between two steps, and its replies."""

from __future__ import annotations

import dataclasses
import enum
import math
from typing import Any

import numpy as np
from jaxtyping import Float

from cablejax.control.command_limits import CommandLimits
from cablejax.limits import check
from cablejax.simulate.table_plant import Observation


class Status(enum.StrEnum):
    """Activity of a link. The grippers move only in `SHAPING`."""

    WAITING = "waiting"
    """No usable observation has come yet."""
    RESTING = "resting"
    """The grippers hold for a while, before the first command and after every pause."""
    SHAPING = "shaping"
    """The controller commands."""
    PAUSED = "paused"
    """The watchdog holds the grippers: the newest usable observation is too old."""
    DONE = "done"
    """All commands were sent, or the error has settled."""
    STOPPED = "stopped"
    """Ended early; the reason says why."""

    @property
    def ended(self) -> bool:
        """No command will follow."""
        return self in (Status.DONE, Status.STOPPED)


@dataclasses.dataclass(frozen=True)
class LinkConfig:
    """Settings of a link.

    Attributes:
        interval: time between two commands [s].
        rest: time without motion before the first command and after a pause [s].
        steps: commands after which the run is done; None = goes on.
        patience: the run is done once the error has stayed within `RESTING_CM`, or its noise, for so many commands;
            None = never.
        watchdog: age of the newest usable observation at which the grippers are held [s].
        grace: time for which a command holds beyond the interval while the next one is awaited [s].
        min_seen: share of the keypoints that a usable observation shows.
        limits: of every command; None = the controller's own and the plant's.
    """

    interval: float = 1.0
    rest: float = 1.0
    steps: int | None = None
    patience: int | None = None
    watchdog: float = 0.5
    grace: float = 0.2
    min_seen: float = 0.5
    limits: CommandLimits | None = CommandLimits()

    def __post_init__(self):
        check(self, "interval", rest="duration", watchdog="interval", grace="duration")
        check(self, min_seen="probability")
        check(self, **{name: "count" for name in ("steps", "patience") if getattr(self, name) is not None})


@dataclasses.dataclass(frozen=True)
class Instant:
    """One control instant: a measurement, and the command that answers it unless the run ended.

    Attributes:
        observation: that the controller was given.
        twist: the command [m/s, rad/s], shape [Q, 3].
        residual_share: the controller's report, NaN where it makes none.
        radius: likewise, its bound on one step's motion [m].
        action: likewise, the `mpc.Action` of the command.
        mpc_ms: wall time of the controller's call [ms].
        limited: the command was shortened to stay within its limits.
    """

    observation: Observation
    twist: np.ndarray | None = None
    residual_share: float = math.nan
    radius: float = math.nan
    action: float = math.nan
    mpc_ms: float = math.nan
    limited: bool = False


@dataclasses.dataclass(frozen=True)
class Reply:
    """What a step of the link commands and reports.

    Attributes:
        twist: to hold now [m/s, rad/s], shape [Q, 3]: within the limits, zero unless the status is `SHAPING`.
        since: time stamp from which it holds [s].
        until: time stamp at which the robot stops by itself unless another command has come [s].
        status: what the link does.
        reason: of a pause or an end, why the link still waits, or that the limits leave no motion; else empty.
        accepted: observations of this step for the log, cleaned; none before the first usable one.
        refused: why the others were refused.
        settled: the cable has not been moved yet.
        instant: the control instant in this step, if there was one.
    """

    twist: Float[np.ndarray, "Q 3"]
    since: float
    until: float
    status: Status
    reason: str
    accepted: tuple[Observation, ...]
    refused: tuple[str, ...]
    settled: bool
    instant: Instant | None


@dataclasses.dataclass(frozen=True)
class LinkState:
    """State of a link between two steps.

    Attributes:
        status: see `Status`.
        reason: see `Reply`.
        controller: the controller's state; None before its first command.
        newest: the newest usable observation.
        unchanged: keypoints as last seen to change, and the poses at that time.
        offset: smallest difference of the link's clock and a time stamp [s]: that of the quickest message.
        now: the link's clock at the last step [s].
        behind: how far that clock was set back so far, in all [s].
        due: time stamp of the next control instant, or of the end of a rest [s].
        command: twist in force, since, and until when.
        commands: given so far.
        errors: the last ones at control instants [cm], as many as `patience` needs.
        at_rest: errors in the last observations before the first command [cm], which tell the noise.
    """

    status: Status
    reason: str
    controller: Any
    newest: Observation | None
    unchanged: Observation | None
    offset: float
    now: float
    due: float
    command: tuple[np.ndarray, float, float]
    commands: int
    errors: tuple[float, ...]
    at_rest: tuple[float, ...] = ()
    behind: float = 0.0
