"""Recognises files of this package by their content: gap logs, data sets, weights, verdicts, runs and cables."""

from __future__ import annotations

import json
import pathlib
import tomllib
import zipfile
from typing import Literal

from cablejax.commands.options import UsageError
from cablejax.limits import LIMITS, shown

Kind = Literal["log", "store", "weights", "verdict", "run", "cable", "mcap", "lerobot"]
"""A gap log; a data set; trained weights; a verdict; a run's folder with its page; a cable file; exported gap logs."""

PAGE = "report.html"
"""Name of the page in a run's folder."""

_FOLDERS: tuple[tuple[tuple[str, ...], Kind], ...] = (
    (("zarr.json",), "store"),
    (("weights.safetensors",), "weights"),
    ((PAGE, "summary.json"), "run"),
    ((PAGE, "verdict.json"), "run"),
    (("meta/info.json",), "lerobot"),
    (("verdict.json",), "verdict"),
    (("log.npz",), "log"),
    # a training that has not ended
    (("run.json",), "weights"),
)
_SUFFIXES: dict[str, Kind] = {
    ".npz": "log",
    ".toml": "cable",
    ".safetensors": "weights",
    ".json": "verdict",
    ".mcap": "mcap",
}


def kind_of(source: str | pathlib.Path) -> tuple[Kind, pathlib.Path]:
    """The kind of a file or folder of this package, and the file or folder to read it from.

    The content decides. A file whose content says nothing, such as a damaged one, is what its name says, so that the
    reader of that kind can say what is wrong with it. A plain name of no file is that of released weights.

    Raises:
        UsageError: it is none of this package's files; says what it is, what was expected and what to do.
        FileNotFoundError: there is no such file or folder.
    """
    from cablejax.dataset.bucket import Bucket, place_of

    path = pathlib.Path(source)
    if isinstance(place_of(source), Bucket):  # which holds data sets only
        return "store", path
    if path.is_dir():
        for names, kind in _FOLDERS:
            if all((path / name).is_file() for name in names):
                return kind, path / names[0] if kind in ("verdict", "log") else path
        if (path / "parts").is_dir():
            raise UsageError(f"{path} is an unfinished run without a page: run its command again, which resumes it.")
        raise UsageError(_none_of_ours(path, "a folder, and holds nothing that this package has written"))
    if not path.exists():
        if path.suffix or len(path.parts) != 1:
            raise FileNotFoundError(f"There is no file or folder {path}.")
        return "weights", path
    if not path.is_file():
        raise UsageError(f"{path} is no regular file.")
    kind, what = _content(path)
    kind = kind or _SUFFIXES.get(path.suffix.lower())
    if kind is None:
        raise UsageError(_none_of_ours(path, what))
    return kind, path


def _none_of_ours(path: pathlib.Path, what: str) -> str:
    return (
        f"{path} is {what}. Expected a gap log (.npz, .mcap or a LeRobot data set's folder), a data set's folder, "
        "weights, a verdict.json, the folder of a finished run, or a cable file. A recording by another program is "
        "imported first: cablejax import --help."
    )


def _content(path: pathlib.Path) -> tuple[Kind | None, str]:
    """The kind of a file by its content, and its content in words."""
    with path.open("rb") as stream:
        head = stream.read(16)
    if head.startswith(b"\x89MCAP"):
        return "mcap", "an MCAP file"
    if head[8:9] == b"{" and int.from_bytes(head[:8], "little") < path.stat().st_size:
        return "weights", "a safetensors file"
    if zipfile.is_zipfile(path):
        try:
            with zipfile.ZipFile(path) as archive:
                ours = "meta.npy" in archive.namelist()
        except (OSError, ValueError, zipfile.BadZipFile, NotImplementedError):
            ours = False
        return ("log" if ours else None), "an archive without the array 'meta'"
    if not head:
        return None, "an empty file"
    if path.stat().st_size not in LIMITS["text_bytes"]:
        return None, f"a file that begins with {shown(head)}"
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError:
        return None, f"a file that begins with {shown(head)}"
    return _text(text)


def _text(text: str) -> tuple[Kind | None, str]:
    try:
        tree = json.loads(text)
    except (ValueError, RecursionError):
        pass
    else:
        schema = tree.get("schema") if isinstance(tree, dict) else None
        ours = isinstance(schema, str) and schema.startswith("cablejax-verdict/")
        return ("verdict" if ours else None), f"a JSON file of schema {shown(schema)}"
    try:
        fields = tomllib.loads(text)
    except (ValueError, RecursionError):
        return None, f"a text that begins with {shown(text[:40])}"
    return ("cable" if "length_m" in fields else None), f"a TOML file with the keys {shown(sorted(fields))}"
