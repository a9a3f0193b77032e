"""`cablejax export`: writes gap logs and runs in the formats of other programs."""

from __future__ import annotations

import dataclasses
import pathlib
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from cablejax.commands.artefacts import Kind, kind_of
from cablejax.commands.options import Command, UsageError, output_file
from cablejax.limits import counted

if TYPE_CHECKING:
    import numpy as np

    from cablejax.types import GapLog

_DEFAULTS = {"mcap": "log.mcap", "lerobot": "log-lerobot", "rerun": "run.rrd"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Export(Command):
    """Export a gap log, a run or a diagnosis for other programs: `cablejax import` reads mcap and lerobot back.

    mcap: an MCAP file with JSON messages, which Foxglove shows. lerobot: a LeRobot data set, version 3.0. rerun: a
    Rerun recording with grippers, keypoints, target and errors; of a diagnosis also with the simulated cables.

    Attributes:
        format: What to write.
        source: A gap log, the folder of a run or of a diagnosis, or an exported log.
        out: The file, or the data set's folder, to write. By default log.mcap, log-lerobot or run.rrd.
        overwrite: Replace a file that is there; a folder is never replaced.
    """

    format: Annotated[Literal["mcap", "lerobot", "rerun"], tyro.conf.Positional]
    source: Annotated[pathlib.Path, tyro.conf.Positional]
    out: pathlib.Path | None = None
    overwrite: bool = False

    def execute(self):
        """Reads the log, and writes it in the other format."""
        out = pathlib.Path(_DEFAULTS[self.format]) if self.out is None else self.out
        if self.format == "lerobot" and out.exists():
            raise UsageError(f"{out} exists. Give another folder with --out.")
        output_file(out, overwrite=self.overwrite)
        log, simulated, about = recorded(self.source)
        if self.format == "mcap":
            from cablejax.recordings.mcap_log import write_mcap

            write_mcap(out, log)
        elif self.format == "lerobot":
            from cablejax.recordings.lerobot import write_lerobot

            write_lerobot(out, log)
        else:
            from cablejax.report.rerun_file import write_rerun

            write_rerun(out, log, simulated=simulated, about=about)
        samples = int(log.episode_length.sum())
        result = {"out": str(out), "episodes": len(log.episode_length), "samples": samples, "simulated": [*simulated]}
        return result, f"{out}: {counted(len(log.episode_length), 'episode')}, {counted(samples, 'sample')}."


def recorded(source: pathlib.Path) -> tuple[GapLog, dict[str, np.ndarray], str]:
    """The log in a file or folder, its simulated keypoints if there are any, and its origin in Markdown.

    Raises:
        ValueError: it holds no log, or one that cannot be read.
    """
    from cablejax.gaplog import read_simulated

    kind, path = kind_of(source)
    if source.is_dir() and kind in ("run", "verdict", "log"):
        kind, path = "log", _log_of_run(source)
    if kind not in ("log", "mcap", "lerobot"):
        raise UsageError(f"{source} is a {kind}, not a recorded run. Give a gap log, or the folder of a run.")
    log = read_log(kind, path)
    simulated = read_simulated(path, log) if kind == "log" else {}
    verdict = path.with_name("verdict.json")
    about = f"# {path.name}\n\n{log.meta['source']}\n"
    if simulated and verdict.is_file():
        from cablejax.diagnose.verdict_json import read_verdict

        about += f"\n{read_verdict(verdict).sentence}\n"
    return log, simulated, about


def read_log(kind: Kind, path: pathlib.Path) -> GapLog:
    """The gap log in a file of our own, an MCAP file or a LeRobot data set.

    Raises:
        ValueError: it cannot be read.
    """
    if kind == "mcap":
        from cablejax.recordings.mcap_log import read_mcap

        return read_mcap(path)
    if kind == "lerobot":
        from cablejax.recordings.lerobot import read_lerobot

        return read_lerobot(path)
    from cablejax.gaplog import read_gap_log

    return read_gap_log(path)


def _log_of_run(folder: pathlib.Path) -> pathlib.Path:
    for name in ("log.npz", "simulated.npz"):
        if (folder / name).is_file():
            return folder / name
    raise UsageError(
        f"{folder} has neither log.npz nor simulated.npz. Give a gap log: of a study that in one of its folders, "
        "round_1 for instance."
    )
