"""Malformed inputs: edits of valid files, drawn by hypothesis, and what counts as an answer to them."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import io
import linecache
import math
import pathlib
import re
import sys
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st

from cablejax import cli
from cablejax.commands.options import Command

VALUES = (
    None, True, 0, -1, 1, 2, 7, 0.5, 1e-30, 1e30, -1e30, 1e308, math.nan, math.inf, 10**50, 10**400, 2**63,
    "", "7", "nan", "x" * 5000, "\udc80", "\x00", "../..", [], [[]], [1], [1, "a"], [[1.0, 2.0]] * 3, {}, {"a": 1},
)  # fmt: skip
"""What no field of a file is meant to hold, and some that are only unusual."""

TEXTS = (
    "nan",
    "inf",
    "-inf",
    "1e400",
    "-1",
    "0",
    "1e30",
    "x",
    "",
    '"',
    "[",
    "]]",
    "\n",
    "=",
    "9" * 5000,
    "1_0",
    "\x00",
    ",",
)


class Accepted(BaseException):
    """A command went past the checks of its input, which are what is tested."""

    def __init__(self, *given: Any):
        super().__init__()
        self.given = given


# Edits of bytes, of text, of trees as JSON and TOML have them, and of arrays.

BYTES = st.lists(
    st.tuples(
        st.sampled_from(("flip", "cut", "insert", "double", "zero")), st.integers(0, 10**6), st.binary(max_size=8)
    ),
    min_size=1,
    max_size=3,
)
WORDS = st.lists(st.tuples(st.integers(0, 10**6), st.sampled_from(TEXTS)), min_size=1, max_size=3)
TREE = st.lists(
    st.tuples(
        st.integers(0, 10**6), st.sampled_from(("put", "put", "put", "drop", "more")), st.integers(0, len(VALUES) - 1)
    ),
    min_size=1,
    max_size=2,
)
CHANGES = ("drop", "none", "empty", "nan", "inf", "huge", "negative", "text", "complex", "objects", "turned", "flat",
    "bytes", "small", "scalar", "twice", "zero", "backwards", "x1000", "one", "wide")  # fmt: skip
ARRAYS = st.lists(
    st.tuples(st.integers(0, 100), st.sampled_from(CHANGES), st.integers(0, 10**6)), min_size=1, max_size=2
)


def edited_bytes(content: bytes, edits) -> bytes:
    data = bytearray(content)
    for kind, place, new in edits:
        at = place % (len(data) + 1)
        if kind == "flip" and at < len(data):
            data[at] ^= 1 + place % 255
        elif kind == "cut":
            del data[at:]
        elif kind == "insert":
            data[at:at] = new
        elif kind == "double":
            data[at:at] = data[at : at + 64]
        elif kind == "zero":
            data[at : at + 16] = bytes(len(data[at : at + 16]))
    return bytes(data)


def edited_words(text: str, edits) -> str:
    """The text with some of its words, numbers or signs replaced."""
    for place, new in edits:
        words = list(re.finditer(r"[-+.\w]+|[\[\]=,\"]", text))
        if words:
            word = words[place % len(words)]
            text = text[: word.start()] + new + text[word.end() :]
    return text


def edited_tree(tree: Any, edits) -> Any:
    tree = copy.deepcopy(tree)
    for place, kind, value in edits:
        places = list(_places(tree))
        if not places:
            return copy.deepcopy(VALUES[value])
        holder, key = places[place % len(places)]
        if kind == "put":
            holder[key] = copy.deepcopy(VALUES[value])
        elif kind == "drop":
            del holder[key]
        elif isinstance(holder, dict):
            holder[f"{key}x"] = copy.deepcopy(VALUES[value])
        else:
            holder.append(copy.deepcopy(VALUES[value]))
    return tree


def _places(tree: Any):
    for key, entry in list(tree.items()) if isinstance(tree, dict) else enumerate(tree):
        yield tree, key
        if isinstance(entry, (dict, list)):
            yield from _places(entry)


def edited_archive(arrays: Mapping[str, Any], edits) -> bytes:
    """An `.npz` of the arrays, some of them replaced."""
    arrays = {name: np.asarray(array) for name, array in arrays.items()}
    raw: dict[str, bytes] = {}
    for which, kind, place in edits:
        name = sorted(arrays)[which % len(arrays)] if arrays else "a"
        array = arrays.pop(name, np.zeros(3))
        if kind == "bytes":
            raw[name] = b"no array"
        elif kind != "drop":
            arrays[name] = _changed(array, kind, place)
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=True, **arrays)
    with zipfile.ZipFile(stream, "a") as archive:
        for name, content in raw.items():
            archive.writestr(name, content)
    return stream.getvalue()


def _changed(array: np.ndarray, kind: str, place: int) -> np.ndarray:
    number = array.dtype.kind in "iufb"
    filled = array.astype(float) if number else np.zeros(array.shape)
    values = {"nan": np.nan, "inf": np.inf, "huge": 1e30, "negative": -7.0, "zero": 0.0}
    if kind in values:
        return np.full(array.shape, values[kind]).astype(array.dtype if array.dtype.kind == "f" else float)
    if kind == "one":
        filled.reshape(-1)[place % max(filled.size, 1) :][:1] = (np.nan, np.inf, 1e30, -1e9, 1e-9)[place % 5]
        return filled.astype(array.dtype) if array.dtype.kind == "f" else filled
    return {
        "none": lambda: np.array(None),
        "empty": lambda: array[:0] if array.ndim else np.zeros(0),
        "text": lambda: np.full(array.shape, "a"),
        "complex": lambda: filled + 1j,
        "objects": lambda: np.array([{}, None], object),
        "turned": lambda: array.T,
        "flat": lambda: array.reshape(-1),
        "small": lambda: np.nan_to_num(filled).clip(-100, 100).astype(np.int8),
        "scalar": lambda: np.array(3.0),
        "twice": lambda: np.concatenate([array, array]) if array.ndim else np.stack([array, array]),
        "backwards": lambda: array[::-1] if array.ndim else array,
        "x1000": lambda: (1000 * filled).astype(array.dtype) if number else array,
        "wide": lambda: np.stack([array] * 3, axis=-1),
    }[kind]()


# What counts as an answer.

ANSWER = 5.0
"""Most time of an answer [s], on the processor and on the clock."""


@contextlib.contextmanager
def soon() -> Iterator[None]:
    """Fails if the block takes longer than an answer may.

    On the clock, what this thread has waited for a processor does not count: a loaded machine is no hang.
    """

    def waited() -> float:
        return 1e-9 * int(pathlib.Path("/proc/thread-self/schedstat").read_text().split()[1])

    computed, passed = time.process_time(), time.monotonic() - waited()
    yield
    for seconds, kind in (
        (time.process_time() - computed, "of processor time"),
        (time.monotonic() - waited() - passed, "on the clock"),
    ):
        assert seconds < ANSWER, f"answered after {seconds:.1f} s {kind}"


def answer(read: Callable[[], Any]) -> Any:
    """The result of a reader, or None for an error that the package raised itself; anything else fails the test."""
    with soon():
        try:
            result = read()
        except (ValueError, OSError) as error:
            require_own(error)
            assert len(str(error)) < 3000
            result = None
    require_sensible(result)
    return result


def require_own(error: BaseException) -> None:
    """Fails unless a statement of the package itself raised the error, and said something."""
    last = error.__traceback__
    assert last is not None
    while last.tb_next is not None:
        last = last.tb_next
    file, line = last.tb_frame.f_code.co_filename, last.tb_lineno
    raised = linecache.getline(file, line).strip()
    assert "/cablejax/" in file and raised.startswith("raise"), f"{file}:{line}: {raised}: {error!r}"
    assert len(str(error)) > 10


def require_sensible(value: Any, where: str = "result") -> None:
    """Fails if an accepted object holds an infinite number, or one that is larger than anything here may be."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        for key, entry in value.items():
            require_sensible(entry, f"{where}.{key}")
    elif isinstance(value, (list, tuple)):
        for index, entry in enumerate(value):
            require_sensible(entry, f"{where}[{index}]")
    elif isinstance(value, np.ndarray) and value.dtype.kind in "iufc":
        # what was not observed is NaN
        assert value.dtype.kind != "c" and (np.abs(value[~np.isnan(value)]) < 1e7).all(), where
    elif isinstance(value, (int, float)):
        assert math.isfinite(value) and abs(value) <= 2**32, f"{where} is {value}"


def command(*arguments: str | pathlib.Path) -> Any:
    """Runs the command line in this process: None for a message and exit code 2, else what was accepted."""
    said: list[str] = []
    refused: list[BaseException] = []

    def kept(run):
        def keep(command):
            try:
                run(command)
            except (ValueError, OSError) as error:
                refused.append(error)
                raise

        return keep

    def spy(text: object = "", *_, file=None, **__) -> None:
        if file is sys.stderr:
            said.append(str(text))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "print", spy, raising=False)
        patch.setattr(Command, "run", kept(Command.run))
        accepted: Accepted | None = None
        with soon():
            try:
                code = cli.main([str(argument) for argument in arguments])
            except SystemExit as stop:  # tyro's answer to what is no option or of another type
                code = stop.code
            except Accepted as stop:
                accepted, code = stop, 0
    if accepted is not None:
        require_sensible(accepted.given)
        return accepted.given
    assert code in (0, 2)
    assert all(10 < len(text) < 3000 and "Traceback" not in text for text in said)
    for error in refused:
        # what the operating system refuses is reported in its words
        if not isinstance(error, OSError) or error.errno is None:
            require_own(error)
    return None if code else ()
