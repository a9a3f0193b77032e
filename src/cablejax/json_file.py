"""Reads and writes JSON files; writes are atomic, and damaged files raise an error that names them."""

from __future__ import annotations

import json
import pathlib
from collections.abc import Mapping
from typing import Any

from cablejax.whole_file import whole_file


def write_json(path: pathlib.Path, value: Mapping[str, Any]) -> None:
    """Writes a JSON file whole or not at all.

    Raises:
        ValueError: a number is not finite, for which JSON has no word.
    """
    with whole_file(path) as stream:
        stream.write((json.dumps(value, indent=2, allow_nan=False) + "\n").encode())


def read_json(path: pathlib.Path) -> Any:
    """Reads a JSON file.

    Raises:
        ValueError: it is no JSON, or nested too deep.
        OSError: it cannot be read.
    """
    try:
        return parse_json(path.read_bytes())
    except ValueError as error:
        raise ValueError(f"{path} {error}") from error


def parse_json(text: str | bytes) -> Any:
    """Parses a JSON text.

    Raises:
        ValueError: "is no JSON" or "is nested too deep", to be put after what it is.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("is nested too deep for a JSON file.") from error
    except ValueError as error:
        raise ValueError(f"is no JSON: {error}") from error
