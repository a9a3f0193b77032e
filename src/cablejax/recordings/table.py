"""A laboratory's own csv: one row per sample, columns named in a layout file."""

from __future__ import annotations

import csv
import dataclasses
import io
import itertools
import math
import os
import pathlib
from collections.abc import Callable

import numpy as np

from cablejax.limits import counted, require, shown
from cablejax.recordings.layout import Fields, Layout, read_layout
from cablejax.recordings.take import Take, require_increasing
from cablejax.text_file import read_text
from cablejax.types import GapLog

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Seconds in one of each unit of time."""

_ANGLES = {"rad": 1.0, "deg": math.pi / 180}
_EMPTY = ("", "nan", "null", "none", "na", "n/a")
_OTHER_DELIMITERS = {";": "semicolons", "\t": "tabs", "|": "bars"}


@dataclasses.dataclass(frozen=True)
class _Table:
    """A csv file.

    Attributes:
        path: of the file.
        columns: cells of each column, by its name in the header.
        lines: at which each row is in the file.
    """

    path: pathlib.Path
    columns: dict[str, list[str]]
    lines: list[int]

    def place(self, row: int) -> str:
        """Where a row is, for messages."""
        return f"{self.path}, line {self.lines[row]}"


def import_csv(path: str | os.PathLike[str], layout: str | os.PathLike[str]) -> tuple[GapLog, list[str]]:
    """Reads, checks and repairs a csv file with one row per sample.

    Args:
        path: comma-separated, with a header; empty or "nan" where nothing was observed.
        layout: TOML file that names the columns and units, see `docs/how_to/own_recording.md`.

    Returns:
        A gap log, planar or in space, and a sentence on each repair.

    Raises:
        ValueError: a file is missing, a column is missing or holds no numbers, or the recording cannot be used without
            guessing; names it.
    """
    how = read_layout(layout, "columns")
    return how.log_of(*_takes(pathlib.Path(path), how))


def _takes(path: pathlib.Path, how: Layout) -> tuple[tuple[Take, ...], list[str]]:
    """The recorded takes, and which keypoints were not read, in words."""
    table = _read(path)
    fields = how.place
    time_unit = fields.take("time_unit", str, "s, ms, us or ns", "s")
    if time_unit not in SECONDS:
        raise ValueError(f"{how.path}: [columns] time_unit is {time_unit!r}, expected one of {', '.join(SECONDS)}.")
    time = _numbers(table, [fields.take("time", str, "the name of a column")])[:, 0] * SECONDS[time_unit]
    if np.isnan(time).any():
        empty = int(np.isnan(time).argmax())
        raise ValueError(f"{table.place(empty)}: the time is empty, expected one for each row.")
    keypoints, unread = _keypoints(table, fields)
    pose = _poses(table, fields, keypoints.shape[2])
    episode = fields.take("episode", str, "the name of a column", None)
    motion = fields.take("motion", str, "the name of a column", None)
    fields.nothing_left()
    episodes = ["1"] * len(time) if episode is None else _column(table, episode)
    motions = ["recorded"] * len(time) if motion is None else _column(table, motion)
    named = list(zip(episodes, motions, strict=True))
    edges = [0, *(t for t in range(1, len(time)) if named[t] != named[t - 1]), len(time)]
    takes = []
    for a, b in itertools.pairwise(edges):
        if b - a < 2:
            raise ValueError(
                f"{path}: episode {episodes[a]!r} has one row only (line {table.lines[a]}), expected at least two."
            )
        require_increasing(time[a:b], lambda row, begin=a: table.place(begin + row))
        takes.append(
            Take(
                name=episodes[a],
                time=time[a:b],
                keypoints=keypoints[a:b],
                gripper_pose=None if pose is None else pose[a:b],
                labels={"motion": motions[a]},
            )
        )
    return tuple(takes), unread


def _read(path: pathlib.Path) -> _Table:
    try:
        text = read_text(path)
        reader = csv.reader(io.StringIO(text, newline=""))
        rows = [(reader.line_num, row) for row in reader if row]
    except (csv.Error, FileNotFoundError) as error:
        raise ValueError(f"{path} could not be read as csv: {error}") from None
    if len(rows) < 3:
        raise ValueError(f"{path} has {counted(len(rows), 'row')}, expected a header and at least two samples.")
    header = [name.strip() for name in rows[0][1]]
    for delimiter, name in _OTHER_DELIMITERS.items():
        if len(header) == 1 and delimiter in header[0]:
            raise ValueError(
                f"{path} has cells between {name}, expected commas, and decimal points: save it in that format."
            )
    if header[0].startswith("#"):
        raise ValueError(f"{path} begins with a comment, expected the names of the columns in its first line.")
    if len(set(header)) < len(header):
        twice = next(name for name in header if header.count(name) > 1)
        raise ValueError(f"{path} has the column {twice!r} twice: give each column a name of its own.")
    for line, row in rows[1:]:
        if len(row) != len(header):
            raise ValueError(f"{path}, line {line}: {len(row)} cells, expected {len(header)} as in the header.")
    columns = {name: [row[index].strip() for _, row in rows[1:]] for index, name in enumerate(header)}
    return _Table(path, columns, [line for line, _ in rows[1:]])


def _column(table: _Table, name: str) -> list[str]:
    if name not in table.columns:
        known = shown(", ".join(table.columns))
        raise ValueError(f"{table.path} has no column {shown(name)}; it has {known}. Correct the name in the layout.")
    return table.columns[name]


def _numbers(table: _Table, names: list[str]) -> np.ndarray:
    """The named columns, shape [T, number of names]."""
    values = np.empty((len(table.lines), len(names)))
    for place, name in enumerate(names):
        for row, cell in enumerate(_column(table, name)):
            try:
                # Python reads 1_0 as ten
                values[row, place] = np.nan if cell.lower() in _EMPTY else float(cell.replace("_", "?"))
            except ValueError:
                raise ValueError(f"{table.place(row)}: column {shown(name)} is {shown(cell)}, no number.") from None
    return values


def _keypoints(table: _Table, fields: Fields) -> tuple[np.ndarray, list[str]]:
    templates = fields.names("keypoint", (2, 3), "two or three names such as 'm{i}_x', where {i} counts the keypoints")
    first = fields.take("first", int, "the number of the first keypoint", 0)
    count = fields.take("count", int, "how many keypoints there are")
    if bad := [name for name in templates if "{i}" not in name]:
        raise ValueError(f"{fields.path}: [columns] keypoint has {bad[0]!r}, expected a name with {{i}} in it.")
    if len(set(templates)) < len(templates):
        raise ValueError(
            f"{fields.path}: [columns] keypoint is {shown(templates)}, expected another column for each coordinate."
        )
    require(count, "keypoints", f"{fields.path}: [columns] count")
    require(abs(first), "count_from_zero", f"{fields.path}: [columns] first")
    names = [name.replace("{i}", str(i)) for i in range(first, first + count) for name in templates]
    around = [i for i in (first - 1, first + count) if templates[0].replace("{i}", str(i)) in table.columns]
    unread = [
        f"Keypoint {i} has columns that were not read: the layout has first = {first}, count = {count}." for i in around
    ]
    return _numbers(table, names).reshape(-1, count, len(templates)), unread


def _poses(table: _Table, fields: Fields, dimension: int) -> np.ndarray | None:
    width = 3 if dimension == 2 else 7
    what = "x, y and the angle" if dimension == 2 else "x, y, z, qw, qx, qy and qz"
    names = [fields.names(f"gripper_{q}", (width,), f"the {width} columns of {what}", None) for q in (0, 1)]
    # a quaternion has no unit: left where it is, the field is refused
    unit = fields.take("angle_unit", str, "rad or deg", "rad") if dimension == 2 else "rad"
    if unit not in _ANGLES:
        raise ValueError(f"{fields.path}: [columns] angle_unit is {unit!r}, expected rad or deg.")
    if names[0] is None and names[1] is None:
        return None
    if None in names:
        missing = names.index(None)
        raise ValueError(
            f"{fields.path}: [columns] names gripper_{1 - missing} but not gripper_{missing}: both grippers must be "
            "known. Leave both out to find them from two markers on each."
        )
    pose = np.stack([_numbers(table, row) for row in names], axis=1)
    if dimension == 2:
        pose[..., 2] *= _ANGLES[unit]
        return pose
    return unit_quaternions(pose, table.place)


def unit_quaternions(pose: np.ndarray, place: Callable[[int], str]) -> np.ndarray:
    """Poses with quaternions of exactly unit length.

    Args:
        pose: (x, y, z, qw, qx, qy, qz), shape [T, Q, 7].
        place: says where a sample is, for the message.

    Raises:
        ValueError: one is far from it, so that it is no quaternion.
    """
    norm = np.linalg.norm(pose[..., 3:], axis=-1, keepdims=True)
    if (np.abs(norm[np.isfinite(norm)] - 1) > 0.02).any():
        sample = int(np.argmax(np.nan_to_num(np.abs(norm - 1)).max(axis=(1, 2))))
        length = float(norm[sample].ravel()[np.nan_to_num(np.abs(norm[sample] - 1)).argmax()])
        raise ValueError(
            f"{place(sample)}: the quaternion of a gripper has the length {length:.3g}, expected 1. Check what is "
            "given as qw, qx, qy and qz."
        )
    return np.concatenate([pose[..., :3], pose[..., 3:] / norm], axis=-1)
