"""Reads and writes text, JSON and TOML files, with errors that name the file; Markdown tables; schema versions."""

from __future__ import annotations

import difflib
import json
import os
import pathlib
import tomllib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cablejax.limits import require, shown
from cablejax.whole_file import whole_file


def write_json(path: pathlib.Path, value: Mapping[str, Any]) -> None:
    """Writes a JSON file whole or not at all.

    Raises:
        ValueError: a number is not finite, or something else for which JSON has no word.
    """
    text = json_text(value, indent=2, allow_nan=False)
    with whole_file(path) as stream:
        stream.write(f"{text}\n".encode())


def json_text(value: Mapping[str, Any], **options: Any) -> str:
    """JSON of an object, NumPy's numbers and arrays included.

    Half of a character, as the name of a Latin-1 file has, becomes a question mark, since `parse_json` refuses it.

    Raises:
        ValueError: something for which JSON has no word.
    """

    def plain(one: Any) -> Any:
        if isinstance(one, (np.ndarray, np.generic)):
            return one.tolist()
        raise ValueError(f"{shown(one)} is no value that JSON has, expected text, numbers, lists or objects of these.")

    try:
        return json.dumps(value, default=plain, ensure_ascii=False, **options).encode(errors="replace").decode()
    except TypeError as error:  # a key that is no text
        raise ValueError(f"it is no JSON: {error}.") from error


def markdown_table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table whose first row is its title: the first column to the left, the others to the right."""
    title, *rest = ["| " + " | ".join(row) + " |" for row in rows]
    return [title, "| --- |" + " ---: |" * (len(rows[0]) - 1), *rest]


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """The content of a regular file that is not too large to be read at once.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is a folder, a device or the like, larger than the limit, or cannot be read.
    """
    path = pathlib.Path(path)
    try:
        # what is neither file nor folder may never end
        if path.exists() and not path.is_file():
            raise ValueError(f"{path} is {'a folder' if path.is_dir() else 'no regular file'}, expected a file.")
        require(path.stat().st_size, "text_bytes", f"The size of {path}")
        return path.read_bytes()
    except FileNotFoundError:
        raise FileNotFoundError(f"There is no file {path}.") from None
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}.") from error


def read_text(path: str | os.PathLike[str]) -> str:
    """The content of a UTF-8 file, without a byte order mark, line breaks as they are.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no text, or see `read_bytes`.
    """
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not text in UTF-8: {error.reason} at byte {error.start}.") from error


def read_json(path: str | os.PathLike[str]) -> Any:
    """Reads a JSON file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no JSON, nested too deep, or see `read_bytes`.
    """
    content = read_bytes(path)
    try:
        return parse_json(content)
    except ValueError as error:
        raise ValueError(f"{path} {error}") from error


def parse_json(text: str | bytes) -> Any:
    """Parses a JSON text.

    Raises:
        ValueError: "is no JSON", "is nested too deep" or "holds half of a character", to be put after what it is.
    """
    try:
        value = json.loads(text)
        # a surrogate without its other half can be written nowhere
        json.dumps(value, ensure_ascii=False).encode()
        return value
    except UnicodeEncodeError as error:
        half = ascii(error.object[error.start])
        raise ValueError(f"holds half of a character ({half}), which is no text: leave it out.") from error
    except RecursionError as error:
        raise ValueError("is nested too deep for a JSON file.") from error
    except ValueError as error:
        raise ValueError(f"is no JSON: {error}") from error


def differences(*records: Mapping[str, Any], prefix: str = "") -> dict[str, list[Any]]:
    """The leaves in which several JSON objects differ, as `outer.inner`, with each one's value or "absent"."""
    found: dict[str, list[Any]] = {}
    for key in sorted(set().union(*records)):
        values = [record.get(key, "absent") for record in records]
        if all(isinstance(value, Mapping) for value in values):
            found |= differences(*values, prefix=f"{prefix}{key}.")
        elif any(value != values[0] for value in values):
            found[f"{prefix}{key}"] = values
    return found


def read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Reads a TOML file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no TOML, nested too deep, or see `read_text`.
    """
    text = read_text(path)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # numbers of too many digits are plain ValueErrors
        raise ValueError(f"{path} is no TOML: {error}") from error


def unknown_key(key: str, units: Mapping[str, str]) -> str:
    """Says that a file has a key that is unknown, and which one may be meant, to be put after "the file has".

    Args:
        key: that is unknown.
        units: of every key that is known; keys of quantities end in their unit.
    """
    if bare := [known for known, unit in units.items() if unit and known == f"{key}_{_in_key(unit)}"]:
        return f"{key} without its unit: write {bare[0]}, in {units[bare[0]]}."
    near = [known for known in units if key and key in known]
    near = near or difflib.get_close_matches(key, units, 1, 0.5)
    known = f"Did you mean {near[0]}?" if near else f"Expected {', '.join(units)}."
    return f"the unknown key {shown(key)}. {known}"


def _in_key(unit: str) -> str:
    """A unit as the end of a key has it: "n_m2" of "N m^2", "per_m" of "1/m"."""
    return unit.lower().replace("1/", "per_").replace("/", "_per_").replace(" ", "_").replace("^", "")


def version_of(schema: object, known: str, where: object) -> int:
    """The version of a file's schema, at most the known one; the caller migrates what is older.

    Args:
        schema: what the file says, such as "cablejax-weights/1".
        known: name and newest version of the schema that is read.
        where: the file, for messages.

    Raises:
        ValueError: the file has another schema, or a newer version of it.
    """
    name, _, newest = known.partition("/")
    came, _, number = schema.partition("/") if isinstance(schema, str) else ("", "", "")
    if came != name or not number.isascii() or not number.isdecimal() or not 0 < len(number) < 6 or int(number) < 1:
        raise ValueError(f"{where} has schema {shown(schema)}, expected {known!r}: is it another kind of file?")
    if int(number) > int(newest):
        raise ValueError(
            f"{where} has schema {shown(schema)}, expected {known!r} or older: a newer version of cablejax wrote it. "
            "Read it with that version: `pip install --upgrade cablejax`."
        )
    return int(number)
