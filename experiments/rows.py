"""Rows of results in a file, one JSON object per line: appended when finished, so that an interrupted run resumes.

A line is written by one call and flushed to the disk before the next row is computed, so that a run that was killed
loses at most the rows that were not finished: readers ignore a torn last line, and the next writer cuts it off. Other
processes or hosts may compute rows (`executors`), and several processes may append to one file. Infinity and NaN, which
JSON has no numbers for, are the strings "inf", "-inf" and "nan". A row keeps the versions and the machine that made it:
whoever prints a page of it later may have others.
"""

from __future__ import annotations

import dataclasses
import fcntl
import functools
import json
import math
import os
import pathlib
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from typing import Any

from tqdm import tqdm

from cablejax.provenance import machine, versions
from executors import results

MADE_ON = "made_on"
"""Field of a row: versions and machine that made it, in words."""
_NO_NUMBERS = ("inf", "-inf", "nan")


@dataclasses.dataclass(frozen=True)
class Rows:
    """A file of rows that are known by some of their fields.

    Attributes:
        path: the file; it need not exist yet.
        key: names of the fields that make a row the one it is.
    """

    path: pathlib.Path
    key: tuple[str, ...]

    def read(self) -> list[dict[str, Any]]:
        """The rows in the order of their first appearance, without `MADE_ON`; of two with one key the later one counts.

        Raises:
            ValueError: a line is not a JSON object, or lacks a field of the key.
        """
        rows = {}
        for number, row in enumerate(read_rows(self.path), start=1):
            if absent := [name for name in self.key if name not in row]:
                raise ValueError(f"{self.path}, line {number} has no field {absent}: remove that line to go on.")
            row.pop(MADE_ON, None)
            rows[tuple(row[name] for name in self.key)] = row
        return list(rows.values())

    def missing(self, wanted: Iterable[tuple]) -> list[tuple]:
        """The wanted keys that have no row yet."""
        done = {tuple(row[name] for name in self.key) for row in self.read()}
        return [key for key in wanted if key not in done]

    def run(
        self,
        keys: Iterable[tuple],
        make: Callable[..., Any],
        *,
        executor: Executor | None = None,
        keep: Callable[[Any], Mapping[str, Any]] = lambda made: made,
        seconds: float = math.inf,
        progress: bool = True,
    ) -> None:
        """Makes rows and appends each once it is finished.

        Args:
            keys: of the rows, in order.
            make: called with a key's elements, returns the row's other fields. For an executor it can be pickled.
            executor: where `make` is called; None = here, one row after the other.
            keep: called here with what `make` returned, if that is not the row's other fields yet.
            seconds: no other row is begun after this time.
            progress: show a bar with the time left.

        Raises:
            ExecutorError: a process or the cluster was lost. The rows that were finished are kept.
        """
        began, keys = time.perf_counter(), list(keys)
        with tqdm(total=len(keys), unit="row", disable=not progress, dynamic_ncols=True) as bar:
            stamped = functools.partial(_made, make)
            for key, (made, where) in results(
                executor, stamped, keys, going=lambda: time.perf_counter() - began <= seconds
            ):
                bar.set_postfix_str(" ".join(map(str, key)))
                append_row(self.path, {**dict(zip(self.key, key, strict=True)), **keep(made), MADE_ON: where})
                bar.update()


def _made(make: Callable[..., Any], *key: Any) -> tuple[Any, str]:
    """What `make` returns, and where it was called."""
    return make(*key), f"{versions()}; {machine()}"


def made_on(path: str | os.PathLike[str], by: Callable[[dict[str, Any]], str] | None = None) -> str:
    """Versions and machine that made the rows of a file, in a sentence.

    Where there are several, each comes with its count, and with what `by` says of its rows.
    """
    rows = [(row.get(MADE_ON, "versions and machine were not kept"), by and by(row)) for row in read_rows(path)]
    counts = Counter(where for where, _ in rows)
    if len(counts) == 1:
        return f"{next(iter(counts))}."

    def whose(where: str) -> str:
        values = sorted({value for other, value in rows if other == where and value})
        return f" ({'; '.join(values)})" if values else ""

    return " ".join(f"{count} rows{whose(where)}: {where}." for where, count in counts.most_common())


def append_row(path: str | os.PathLike[str], row: Mapping[str, Any]) -> None:
    """Adds one row to a file, which is made if need be; on return the row is on the disk."""
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    line = json.dumps(_encoded(dict(row)), allow_nan=False) + "\n"
    with open(path, "a+b", buffering=0) as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # until the file is closed
        end = file.seek(0, os.SEEK_END)
        file.seek(max(end - 1, 0))
        if end and file.read(1) != b"\n":
            file.seek(0)
            file.truncate(file.read().rfind(b"\n") + 1)
        file.write(line.encode())
        os.fsync(file.fileno())


def read_rows(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """The rows of a file, one for each line; none if there is no file.

    Raises:
        ValueError: a line, other than a torn last one, is not a JSON object.
    """
    path = pathlib.Path(path)
    if not path.exists():
        return []
    rows = []
    lines = path.read_bytes().split(b"\n")[:-1]  # what follows the last line break was torn off
    for number, line in enumerate(lines, start=1):
        try:
            row = json.loads(line)
        except ValueError as error:
            raise ValueError(f"{path}, line {number} is not JSON ({error}): remove that line to go on.") from error
        if not isinstance(row, dict):
            raise ValueError(f"{path}, line {number} is {type(row).__name__}, expected a JSON object.")
        rows.append(_decoded(row))
    return rows


def _encoded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _encoded(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_encoded(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def _decoded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _decoded(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_decoded(item) for item in value]
    return float(value) if isinstance(value, str) and value in _NO_NUMBERS else value
