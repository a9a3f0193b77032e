"""The layout of a laboratory's own recording, read from a small TOML file.

Tables `[cable]`, `[table]`, `[frame]` and `[source]` are the same for every kind of file; `[columns]` is for csv and
`[topics]` for bags. `docs/how_to/own_recording.md` has a full example of each.
"""

from __future__ import annotations

import dataclasses
import os
import pathlib
from collections.abc import Sequence
from typing import Any

from cablejax.limits import LIMITS, require, shown
from cablejax.recordings.assemble import Nominal, gap_log_from_takes
from cablejax.recordings.frames import Frame
from cablejax.recordings.prepare import Setup, prepare
from cablejax.recordings.take import Take
from cablejax.text_file import read_toml
from cablejax.types import GapLog

_ANY = """[cable]
diameter_m = 0.006
linear_density_kg_per_m = 0.04
bending_stiffness_n_m2 = 6e-4
[frame]
unit = "mm"
"""
SMALLEST = {
    "columns": _ANY + '[columns]\ntime = "t"\nkeypoint = ["m{i}_x", "m{i}_y", "m{i}_z"]\ncount = 9\n',
    "topics": _ANY + '[topics]\nkeypoints = "/cable/keypoints"\n',
}
"""The smallest layout of a csv and of a bag, with two keypoints on each gripper."""


@dataclasses.dataclass(frozen=True)
class Layout:
    """Content of a layout file.

    Attributes:
        nominal: what is believed of the cable.
        setup: unit, frame, and which keypoints are on the grippers.
        source: free text.
        place: the table `[columns]` or `[topics]`, as it is.
        path: of the layout file, for messages.
    """

    nominal: Nominal
    setup: Setup
    source: str
    place: Fields
    path: pathlib.Path

    def log_of(self, takes: tuple[Take, ...], repairs: Sequence[str]) -> tuple[GapLog, list[str]]:
        """The gap log of takes as read, checked and repaired, and a sentence on each repair, after those given.

        Raises:
            ValueError: the takes cannot be repaired without guessing, or the layout's numbers are not those of a cable
                that they show.
        """
        measured = all(take.gripper_pose is not None for take in takes)
        takes, more = prepare(takes, self.setup)
        repairs = [*repairs, *more]
        try:
            log = gap_log_from_takes(takes, self.nominal, source=self.source, repairs=repairs, measured=measured)
        except ValueError as error:
            raise ValueError(f"{self.path}: {error}") from None
        return log, repairs


class Fields:
    """A table of a TOML file that is read field by field; unread fields are an error.

    Args:
        path: of the file, for messages.
        name: of the table.
        values: its fields.
    """

    def __init__(self, path: pathlib.Path, name: str, values: Any):
        if not isinstance(values, dict):
            raise ValueError(f"{path}: [{name}] is {shown(values)}, expected a table.")
        self.path, self.name, self._left = path, name, dict(values)

    def __contains__(self, field: str) -> bool:
        return field in self._left

    def take(self, field: str, kind: type | tuple[type, ...], what: str, default: Any = ...) -> Any:
        """Removes a field and returns its value.

        Raises:
            ValueError: it is missing and has no default, or is of another kind.
        """
        if field not in self._left:
            if default is ...:
                raise ValueError(f"{self.path}: [{self.name}] lacks {field}, expected {what}.")
            return default
        value = self._left.pop(field)
        if not isinstance(value, kind) or isinstance(value, bool):
            raise ValueError(f"{self.path}: [{self.name}] {field} is {shown(value)}, expected {what}.")
        return value

    def number(self, field: str, limit: str, default: Any = ...) -> Any:
        """Removes a field with a number within a limit of `cablejax.limits`."""
        value = self.take(field, (int, float), str(LIMITS[limit]), default)
        if value is not default:
            require(value, limit, f"{self.path}: [{self.name}] {field}")
        return value

    def names(self, field: str, counts: tuple[int, ...], what: str, default: Any = ...) -> Any:
        """Removes a field with a list of strings, of one of some lengths."""
        value = self.take(field, list, what, default)
        if value is not default and (len(value) not in counts or not all(isinstance(name, str) for name in value)):
            raise ValueError(f"{self.path}: [{self.name}] {field} is {shown(value)}, expected {what}.")
        return value

    def nothing_left(self) -> None:
        """Raises an error if fields are left that were not read.

        Raises:
            ValueError: names them.
        """
        if self._left:
            raise ValueError(f"{self.path}: [{self.name}] has the unknown fields {shown(sorted(self._left))}.")


def read_layout(path: str | os.PathLike[str], place: str) -> Layout:
    """Reads a layout file.

    Args:
        path: of the TOML file.
        place: the table that says where things are: "columns" or "topics".

    Raises:
        ValueError: there is no such file, it is no TOML, or a field is missing, unknown or of another kind.
    """
    path = pathlib.Path(path)
    try:
        values = read_toml(path)
    except (ValueError, OSError) as error:
        raise ValueError(f"The layout could not be read. {error} The smallest layout is\n{SMALLEST[place]}") from None
    if unknown := set(values) - {"cable", "table", "frame", "source", place}:
        raise ValueError(
            f"{path} has the unknown tables {shown(sorted(unknown))}, expected [cable], [table], [frame], [source] "
            f"and [{place}]."
        )
    if place not in values:
        raise ValueError(f"{path} lacks the table [{place}], which says where the keypoints are.")
    cable = Fields(path, "cable", values.get("cable", {}))
    table = Fields(path, "table", values["table"]) if "table" in values else None
    frame = Fields(path, "frame", values.get("frame", {}))
    source = Fields(path, "source", values.get("source", {}))
    arclength = cable.take("keypoint_arclength_m", list, "a list of numbers", None)
    if arclength is not None and not all(s in LIMITS["not_negative"] for s in arclength):
        raise ValueError(f"{path}: [cable] keypoint_arclength_m is {shown(arclength)}, expected a list of numbers.")
    known = ("diameter_m", "linear_density_kg_per_m", "bending_stiffness_n_m2", "bending_damping_s")
    guessed = cable.take("guessed", list, "a list of names", [])
    if not all(name in known for name in guessed):
        raise ValueError(f"{path}: [cable] guessed is {shown(guessed)}, expected some of {', '.join(known)}.")
    nominal = Nominal(
        diameter=cable.number("diameter_m", "diameter"),
        linear_density=cable.number("linear_density_kg_per_m", "linear_density"),
        bending_stiffness=cable.number("bending_stiffness_n_m2", "bending_stiffness"),
        damping_time=cable.number("bending_damping_s", "damping_time", 0.0),
        friction_coefficient=None if table is None else table.number("friction_coefficient", "friction_coefficient"),
        arclength=None if arclength is None else tuple(map(float, arclength)),
        guessed=tuple(guessed),
    )
    try:
        setup = Setup(
            unit=frame.take("unit", str, "m, cm, mm or in"),
            frame=Frame(frame.take("up", str, "an axis", "z"), frame.take("handedness", str, "right or left", "right")),
            on_grippers=cable.take("keypoints_on_grippers", str, "pairs or ends", "pairs"),
            hangs=table is None,
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    text = source.take("text", str, "a sentence", f"Imported by the layout {path.name}.")
    for fields in (cable, frame, source, *([] if table is None else [table])):
        fields.nothing_left()
    return Layout(nominal, setup, text, Fields(path, place, values[place]), path)
