"""`cablejax diagnose`: finds where a simulator is wrong on a recorded run, and which effect causes it."""

from __future__ import annotations

import dataclasses
import hashlib
import pathlib
import shlex
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import tyro

from cablejax.commands.options import Command, UsageError, say

if TYPE_CHECKING:
    from cablejax.diagnose import CableDiagnosis
    from cablejax.diagnose.motion_bounds import Bounds
    from cablejax.types import GapLog


@dataclasses.dataclass(frozen=True, kw_only=True)
class Diagnose(Command):
    """Diagnose the gap between the simulator and a recorded run: where it lies, what causes it, how far it shrinks.

    Reads a gap log (`cablejax-gap-log/1`, as `cablejax shape` writes it) and writes report.html, verdict.json and the
    figures. A log of six episodes on a table takes about half a minute. A log in space takes some minutes and resumes
    if interrupted.

    Attributes:
        logs: The recorded run, an .npz file. Several of one set-up are diagnosed together, in the order in which they
            were recorded, and on a table the verdict says what each one added.
        out: Folder of the report.
        commissioning: Logs of the same set-up without any effect: they separate the simulator's own error from the gap.
            For planar logs only.
        only: Names of the effects to look for. By default all, in space all but intrinsic_curvature, which takes four
            times as long as the others together.
        bounds: Bounds of a motion, a TOML file: designs the motion to record next within these bounds, instead of
            choosing one of a few safe motions. For planar logs only.
        overwrite: Replace an existing report.
    """

    logs: Annotated[tuple[pathlib.Path, ...], tyro.conf.Positional]
    out: pathlib.Path = pathlib.Path("runs/diagnosis")
    commissioning: tuple[pathlib.Path, ...] = ()
    only: tuple[str, ...] = ()
    bounds: pathlib.Path | None = None
    overwrite: bool = False

    def execute(self):
        """Diagnoses a log, on a table or in space, and writes its verdict and page."""
        from cablejax.commands.resuming import unfinished
        from cablejax.diagnose import verdict_json
        from cablejax.diagnose.motion_bounds import read_bounds
        from cablejax.gaplog import read_gap_log
        from cablejax.gaplog_join import joined

        if not self.logs:
            raise UsageError("Nothing to diagnose: name a gap log, or several of one set-up.")
        for path in self.logs:
            if path.is_dir() or path.suffix.lower() == ".mcap":
                raise UsageError(
                    f"{path} is {'a folder' if path.is_dir() else 'an MCAP file'}, expected a gap log (.npz). Import "
                    f"it first: cablejax import {'lerobot' if path.is_dir() else 'mcap'} {shlex.quote(str(path))}"
                )
        read = [read_gap_log(path) for path in self.logs]
        log = read[0] if len(read) == 1 else joined(read, [str(path) for path in self.logs])
        self._check_options(log)
        bounds = None if self.bounds is None else read_bounds(self.bounds)
        commissioning = [read_gap_log(path) for path in self.commissioning]
        settings = {
            "diagnosis": [hashlib.sha256(path.read_bytes()).hexdigest() for path in (*self.logs, *self.commissioning)],
            "only": self.only,
            "bounds": None if bounds is None else dataclasses.asdict(bounds),
        }
        with unfinished(self.out, settings, overwrite=self.overwrite) as parts:
            result, page = diagnose_and_report(
                log, self.out, only=self.only, commissioning=commissioning, bounds=bounds, state=parts.state
            )
        return {**verdict_json(result), "report": str(page)}, f"{result.verdict}: {result.sentence}\n{page}"

    def _check_options(self, log: GapLog) -> None:
        """Rejects effects that such a log is not searched for, and options that do not apply to one in space."""
        from cablejax.diagnose import LIBRARY
        from cablejax.diagnose.actuation import ARMS

        known, where = [effect.name for effect in LIBRARY], "on a table"
        if log.in_space:
            from cablejax.spatial.effects import effect_names

            known, where = effect_names(), "in space"
        for name in self.only:
            if name in ARMS and not log.in_space:
                raise UsageError(f"--only names {name!r}, which is looked for in any case: leave it out.")
            if name not in known:
                raise UsageError(
                    f"--only names the effect {name!r}, but {self.logs[0]} is a log {where}, which is searched for "
                    f"{', '.join(known)}: name some of these."
                )
        if not log.in_space:
            return
        if self.commissioning:
            raise UsageError(
                f"--commissioning is given, but {self.logs[0]} is a log in space, where the gap is judged by "
                "recordings that no fit has seen and commissioning logs are not used: leave it out."
            )
        if self.bounds is not None:
            raise UsageError(
                f"--bounds is given, but {self.logs[0]} is a log in space, for which no motion is evaluated: "
                "leave it out."
            )


def diagnose_and_report(
    log: GapLog,
    folder: pathlib.Path,
    *,
    only: Sequence[str] = (),
    commissioning: Sequence[GapLog] = (),
    bounds: Bounds | None = None,
    state: pathlib.Path | None = None,
) -> tuple[CableDiagnosis, pathlib.Path]:
    """Diagnoses a log, reports progress, and writes verdict.json, report.html and the figures into an existing folder.

    The motion to record next, where there is one, is written as next_motion.npz and next_motion.csv.

    Args:
        log: in the plane or in space.
        folder: that exists.
        only: names of the effects to look for; by default all.
        commissioning: logs known to have no effect; none for a log in space.
        bounds: for a next motion that is designed; none for a log in space.
        state: file from which an interrupted diagnosis in space goes on.

    Returns:
        The diagnosis and its page.
    """
    from cablejax.diagnose import LIBRARY, diagnose
    from cablejax.diagnose.motion_file import write_motion
    from cablejax.report.diagnosis_page import write_diagnosis_page

    if log.in_space:
        from cablejax.spatial.diagnose import diagnose_space

        spatial = diagnose_space(log, only=only or None, state=state, progress=say)
        write_motion(folder, None, log)  # that of an earlier diagnosis goes
        return spatial, write_diagnosis_page(spatial, folder)
    result = diagnose(
        log,
        effects=[effect for effect in LIBRARY if effect.name in only] or LIBRARY,
        commissioning=commissioning,
        bounds=bounds,
        progress=lambda text: say(f"{text} ..."),
    )
    write_motion(folder, result.next_motion, result.log)
    return result, write_diagnosis_page(result, folder)
