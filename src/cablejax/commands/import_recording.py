"""`cablejax import`: turns real recordings into gap logs."""

from __future__ import annotations

import abc
import dataclasses
import pathlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from tyro.conf import subcommand

from cablejax.commands.options import Command, UsageError, output_file
from cablejax.limits import counted

if TYPE_CHECKING:
    from cablejax.types import GapLog


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Import(Command, abc.ABC):
    """Common options of all kinds of recordings.

    Attributes:
        source: The recording.
        out: The gap log to write.
        overwrite: Replace a log that is there.
    """

    source: Annotated[pathlib.Path, tyro.conf.Positional]
    out: pathlib.Path = pathlib.Path("log.npz")
    overwrite: bool = False

    @abc.abstractmethod
    def imported(self) -> tuple[GapLog, Sequence[str]]:
        """The log, and its repairs."""

    def execute(self):
        from cablejax.gaplog import write_gap_log

        if self.out.suffix.lower() != ".npz":
            raise UsageError(f"--out is {self.out}, expected a file name that ends in .npz.")
        output_file(self.out, overwrite=self.overwrite)
        log, repairs = self.imported()
        write_gap_log(self.out, log, overwrite=self.overwrite)
        return _described(self.out, log, repairs)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Deform(_Import):
    """Import recordings of the DEFORM data set: three-dimensional motion capture of one cable.

    PATH is upstream's folder of one cable, with pickles in train/ and eval/, one such pickle, or an .npz. Pickles are
    read without running any of their code.

    Attributes:
        unit: Unit of length. By default metres, or another unit if the cable's length fits only that.
        up: The axis that points up.
        handedness: left: the coordinates are in a left-handed frame.
    """

    unit: Literal["m", "cm", "mm", "in"] | None = None
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "z"
    handedness: Literal["right", "left"] = "right"

    def imported(self):
        """The log of one cable of the data set, and its repairs."""
        from cablejax.recordings.deform import import_deform
        from cablejax.recordings.frames import Frame

        return import_deform(self.source, unit=self.unit, frame=Frame(self.up, self.handedness))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Csv(_Import):
    """Import a csv file of your own, one row per sample; a small TOML file names its columns and units.

    Attributes:
        layout: The TOML file; without one, the smallest is printed.
    """

    layout: pathlib.Path = pathlib.Path("layout.toml")

    def imported(self):
        """The log of the table, and its repairs."""
        from cablejax.recordings.table import import_csv

        return import_csv(self.source, self.layout)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mcap(_Import):
    """Import a ROS 2 bag or MCAP file with pose arrays; a small TOML file names its topics and units.

    A log that `cablejax export mcap` wrote needs no TOML file.

    Attributes:
        layout: The TOML file; without one, the smallest is printed.
    """

    layout: pathlib.Path = pathlib.Path("layout.toml")

    def imported(self):
        """The log of the bag, and its repairs; an exported log unchanged."""
        from cablejax.recordings.bags import import_mcap
        from cablejax.recordings.mcap_log import read_mcap, written_here

        if written_here(self.source):
            return read_mcap(self.source), ()
        return import_mcap(self.source, self.layout)


@dataclasses.dataclass(frozen=True, kw_only=True)
class LeRobot(_Import):
    """Import a LeRobot data set that `cablejax export lerobot` wrote."""

    def imported(self):
        """The log as it was exported; nothing is repaired."""
        from cablejax.recordings.lerobot import read_lerobot

        return read_lerobot(self.source), ()


@dataclasses.dataclass(frozen=True)
class Import:
    """Import a real recording as a gap log, which `cablejax diagnose` reads.

    Attributes:
        what: Format of the recording.
    """

    what: (
        Annotated[Deform, subcommand("deform")]
        | Annotated[Csv, subcommand("csv")]
        | Annotated[Mcap, subcommand("mcap")]
        | Annotated[LeRobot, subcommand("lerobot")]
    )


def _described(path: pathlib.Path, log: GapLog, repairs: Sequence[str]) -> tuple[dict[str, Any], str]:
    """What was imported and repaired, as the command's result and in words."""
    import numpy as np

    points, length = log.keypoints[log.valid], float(log.meta["cable"]["length_m"])
    seen = float(np.isfinite(points).all(axis=-1).mean())
    result = {
        "log": str(path),
        "episodes": len(log.keypoints),
        "samples": len(points),
        "keypoints": points.shape[1],
        "dimension": points.shape[2],
        "length_m": length,
        "observed": seen,
        "repairs": list(repairs),
    }
    rate = f" at {log.rate} Hz" if log.rate else ""
    line = (
        f"{path}: {counted(len(log.keypoints), 'episode')}, {counted(len(points), 'sample')} "
        f"({log.intervals.sum():.4g} s{rate}) of {points.shape[1]} "
        f"keypoints in {'space' if log.in_space else 'the plane'}, {100 * seen:.4g} % of them observed; the cable is "
        f"{length:.4g} m long."
    )
    return {"logs": [result]}, "\n".join([line, *(repairs or ["Nothing had to be repaired."])])
