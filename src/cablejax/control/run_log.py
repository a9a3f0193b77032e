"""Collects what a link accepted and commanded, and makes a closed-loop run and a gap log of it."""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence

import numpy as np

from cablejax.arrays import positions_at
from cablejax.cable import Cable
from cablejax.control.link_state import Instant, Reply, Status
from cablejax.control.run import ClosedLoopRun, shape_error_cm
from cablejax.control.targets import Target
from cablejax.gaplog import TARGETS, Episode, gap_log_from_episodes
from cablejax.limits import LIMITS
from cablejax.simulate.table_plant import Observation
from cablejax.types import GapLog

# A pause longer than this [s], and than so many usual intervals, ends an episode.
_PAUSE, _INTERVALS = 1.0, 3.0


def motion(target: Target) -> str:
    """What the grippers do, in the words of a gap log."""
    return f"approach_{target.name.lower()}"


class RunLog:
    """All reports of a link's replies, in the order of the observations' time stamps.

    An observation that comes late takes its place; one that comes twice is counted and kept once.

    Attributes:
        instants: control instants in their order.
        events: (time stamp, status, reason) of every change of the status.
        refused: why observations were refused.
        counts: of "received", "doubled" and "refused" observations, and of "limited" commands.
    """

    def __init__(self):
        self.instants: list[Instant] = []
        self.events: list[tuple[float, str, str]] = []
        self.refused: list[str] = []
        self.counts = {"received": 0, "doubled": 0, "refused": 0, "limited": 0}
        self._samples: dict[float, tuple[Observation, bool]] = {}
        self._commands: list[tuple[float, float, np.ndarray]] = []

    def add(self, reply: Reply) -> None:
        """Adds the report of one step of the link."""
        self.counts["received"] += len(reply.accepted)
        self.refuse(reply.refused)
        if reply.status == Status.WAITING:  # the link has forgotten what came before its first command
            self._samples.clear()
            self._commands.clear()
        for observation in reply.accepted:
            self.counts["doubled"] += observation.time in self._samples
            self._samples.setdefault(observation.time, (observation, reply.settled))
        if not self._commands or self._commands[-1][0] != reply.since:
            self._commands.append((reply.since, reply.until, reply.twist))
        if reply.instant is not None:
            self.instants.append(reply.instant)
            self.counts["limited"] += reply.instant.limited
        if not self.events or self.events[-1][1:] != (reply.status, reply.reason):
            self.events.append((reply.since, str(reply.status), reply.reason))

    @property
    def recorded(self) -> bool:
        """Whether there is any observation."""
        return bool(self._samples)

    def refuse(self, reasons: Sequence[str]) -> None:
        """Records messages that are not observations."""
        self.counts["received"] += len(reasons)
        self.counts["refused"] += len(reasons)
        self.refused += reasons

    def forget_command(self) -> None:
        """Removes the last command, which was not carried out."""
        self.instants[-1] = Instant(self.instants[-1].observation)
        since, _, twist = self._commands[-1]
        self._commands[-1] = (since, math.inf, np.zeros_like(twist))

    def episodes(self, name: str, *, longest_pause: float = math.inf) -> list[tuple[float, Episode]]:
        """The recording in pieces without a pause between samples longer than `longest_pause` [s], none beyond a log's.

        A pose that was not measured is interpolated; a piece without any is left out.

        Returns:
            The time stamp at which each begins, and the episode.
        """
        pieces: list[list[float]] = []
        for time in sorted(self._samples):
            if not pieces or time - pieces[-1][-1] > longest_pause or time - pieces[-1][0] > LIMITS["duration"].high:
                pieces.append([])
            pieces[-1].append(time)
        made = [(piece[0], self._episode(name, piece)) for piece in pieces]
        return [(start, episode) for start, episode in made if episode is not None]

    def _episode(self, name: str, times: Sequence[float]) -> Episode | None:
        samples = [self._samples[time][0] for time in times]
        poses = np.stack([sample.gripper_pose for sample in samples])
        known = np.isfinite(poses).all(axis=(1, 2))
        if not known.any():
            return None
        stamps = np.array(times)
        poses[~known] = positions_at(stamps[~known], stamps[known], poses[known])
        return Episode(
            motion=name,
            time=stamps - stamps[0],
            keypoints=np.stack([sample.keypoints for sample in samples]),
            gripper_pose=poses,
            gripper_command=np.stack([self._command(time) for time in times]),
            hold=np.array([self._samples[time][1] for time in times]),
        )

    def _command(self, time: float) -> np.ndarray:
        """The twist that was in force."""
        index = bisect.bisect_right(self._commands, time, key=lambda command: command[0]) - 1
        _, until, twist = self._commands[max(index, 0)]
        return twist if index >= 0 and time < until else np.zeros_like(twist)

    def run(self, target: Target, stopped: str | None) -> ClosedLoopRun:
        """The closed-loop run that the control instants make, and the whole recording as its episode.

        Raises:
            ValueError: there was no control instant.
        """
        rows = self.instants
        if not rows:
            raise ValueError(f"The run ended before its first command: {stopped or 'no usable observation came'}")
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
            action=np.array([row.action for row in rows]),
            mpc_ms=np.array([row.mpc_ms for row in rows]),
            unobserved=int(np.isnan(keypoints).any(axis=-1).sum()),
            stopped=stopped,
            episode=self.episodes(motion(target))[0][1],
        )

    def gap_log(self, target: Target, cable: Cable, source: str) -> GapLog:
        """The recording as a gap log; a pause of more than a second, or three usual intervals, begins another episode.

        `meta` has the target of each episode, and the field "robot_link": counts, the time stamps at which episodes
        begin, changes of the status, and the first reasons of refusals.

        Raises:
            GapLogError: nothing was recorded, or the recording violates the format.
        """
        steps = np.diff(sorted(self._samples))
        usual = float(np.median(steps)) if len(steps) else 0.0
        pieces = self.episodes(motion(target), longest_pause=max(_PAUSE, _INTERVALS * usual))
        report = {
            "counts": self.counts,
            "starts_s": [start for start, _ in pieces],
            "events": [(since if math.isfinite(since) else None, *rest) for since, *rest in self.events],
            "refused": self.refused[:100],
        }
        episodes = [episode for _, episode in pieces]
        extra = {TARGETS: [target.keypoints.tolist()] * len(episodes), "robot_link": report}
        return gap_log_from_episodes(episodes, cable, source=source, extra=extra)
