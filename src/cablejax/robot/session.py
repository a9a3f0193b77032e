"""One run on a robot: the link, its state and its log, whatever carries the messages."""

from __future__ import annotations

import contextlib
import itertools
import os
import pathlib
from collections.abc import Callable, Sequence

import numpy as np

from cablejax.cable import Cable
from cablejax.control.link import RobotLink
from cablejax.control.link_state import Reply, Status
from cablejax.control.run import ClosedLoopRun
from cablejax.control.run_log import RunLog, motion
from cablejax.gaplog import GapLogError, write_gap_log
from cablejax.interrupts import ended_by_sigterm
from cablejax.log_setup import setup_fault
from cablejax.simulate.table_plant import Observation
from cablejax.types import GapLog
from cablejax.whole_file import whole_file

_RAW = ".raw.npz"


class RobotRun:
    """Drives a link and records it; `finish` writes the gap log. The controller is compiled when it is made.

    Args:
        link: the controller, its target and settings.
        cable: as it is believed to be, for the log.
        path: of the gap log, an `.npz` file that does not exist yet.
        source: of the log, free text.

    Raises:
        ValueError: the controller does not fit its target, or the path does not end in `.npz`.
        FileExistsError: there is such a file.
        OSError: its folder cannot be written to.
    """

    def __init__(self, link: RobotLink, cable: Cable, path: pathlib.Path, source: str = "robot"):
        if path.suffix != ".npz":
            raise ValueError(f"The log's path is {path}, expected one that ends in .npz.")
        path.parent.mkdir(parents=True, exist_ok=True)
        if not os.access(path.parent, os.W_OK):
            raise PermissionError(f"{path.parent} cannot be written to: choose another folder for the run's log.")
        if path.exists():
            raise FileExistsError(f"{path} exists: give the log of this run another name.")
        self.link, self.cable, self.path, self.source = link, cable, path, source
        self.log = RunLog()
        link.warm_up()
        self._state = link.init()

    def exchange(
        self, now: float, observations: Sequence[Observation] = (), clock: Callable[[], float] | None = None
    ) -> Reply:
        """One step of the link. Before the first command the log so far is checked, so that it can be written later.

        Args:
            now: the link's clock [s].
            observations: that have come since the last call.
            clock: see `RobotLink.step`.
        """
        first = self._state.commands == 0
        self._state, reply = self.link.step(self._state, now, observations, clock)
        self.log.add(reply)
        if first and reply.status == Status.SHAPING:
            try:
                fault = setup_fault(self._log())
            except GapLogError as error:
                fault = str(error)
            if fault:
                self.log.forget_command()
                return self.stop(now, f"The observations so far do not show a cable between these grippers: {fault}")
        return reply

    def stop(self, now: float, reason: str) -> Reply:
        """Holds the grippers for good."""
        self._state = self.link.stop(self._state, reason)
        return self.exchange(now)

    def recorded(self, drive: Callable[[], None]) -> pathlib.Path:
        """Calls what drives the run to its end, and writes the log, see `finish`; after signals and errors as well."""
        try:
            with ended_by_sigterm():
                drive()
        except BaseException:
            # report the error that ended the run, even if there is no log to keep
            with contextlib.suppress(GapLogError):
                self.finish()
            raise
        return self.finish()

    def finish(self) -> pathlib.Path:
        """Writes the gap log and returns its path: a free one next to it if that of this run has been taken meanwhile.

        Raises:
            GapLogError: nothing usable was observed; or the recording violates the format, and its samples are written.
        """
        if not self.log.recorded:
            raise GapLogError(f"No log was written: nothing usable was observed. {self._state.reason}".strip())
        path, count = self.path, itertools.count(2)
        while path.exists() or path.with_suffix(_RAW).exists():
            path = self.path.with_stem(f"{self.path.stem}_{next(count)}")
        try:
            return write_gap_log(path, self._log())
        except GapLogError as error:
            kept = path.with_suffix(_RAW)
            pieces = enumerate(self.log.episodes(motion(self.link.target)))
            arrays = {f"{name}_{k}": array for k, (_, episode) in pieces for name, array in vars(episode).items()}
            with whole_file(kept) as stream:
                np.savez_compressed(stream, allow_pickle=False, **arrays)
            raise GapLogError(
                f"The recording is not a valid gap log: {error} Its samples are kept in {kept}."
            ) from None

    def _log(self) -> GapLog:
        return self.log.gap_log(self.link.target, self.cable, self.source)

    def result(self) -> ClosedLoopRun:
        """The run for reports: its error and commands at the control instants. Raises ValueError without any."""
        ended = self._state.reason if self._state.status == Status.STOPPED else None
        return self.log.run(self.link.target, ended)
