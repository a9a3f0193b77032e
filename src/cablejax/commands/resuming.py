"""Resumes commands: stores the finished runs of an unfinished command until it ends."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from cablejax.commands.options import UsageError, output_folder, say
from cablejax.control.run import ClosedLoopRun
from cablejax.control.targets import Target
from cablejax.gaplog import Episode
from cablejax.npz import read_npz
from cablejax.text_file import differences, parse_json, read_json, version_of, write_json
from cablejax.whole_file import DRAFT, sole_writer, whole_file

SCHEMA = "cablejax-parts/1"
"""Marks the folder as ours; a folder of that name without it belongs to somebody else."""

_FIELDS = {
    group: [field.name for field in dataclasses.fields(cls) if field.name not in ("target", "episode")]
    for group, cls in (("", ClosedLoopRun), ("target.", Target), ("episode.", Episode))
}
"""Names of the fields of a run by what is put before them in its file."""
_SETTINGS, _STATE, _RUN = "settings.json", "state.json", ".run.npz"


class Parts:
    """The folder of an unfinished command: its settings, which identify it, and one `.run.npz` per finished run."""

    def __init__(self, folder: pathlib.Path, settings: Mapping[str, Any]):
        self.folder = folder
        self._settings = {"schema": SCHEMA, **json.loads(json.dumps(settings))}

    @property
    def state(self) -> pathlib.Path:
        """A file for further progress to resume from."""
        return self.folder / _STATE

    def differing(self) -> list[str] | None:
        """Names of the settings in which the unfinished command of this folder differs; None if there is none.

        Raises:
            UsageError: the folder is not one that a command made, or its settings cannot be read.
        """
        # a kill may leave settings that were never finished, or progress of results that were
        if not self.folder.exists() or (self.folder.is_dir() and self._left()):
            return None
        try:
            found = read_json(self.folder / _SETTINGS)
        except (FileNotFoundError, NotADirectoryError):
            found = None
        except ValueError as error:
            raise UsageError(f"{error} Delete {self.folder} to start again.") from error
        if isinstance(found, dict) and str(found.get("schema")).startswith("cablejax-parts/"):
            version_of(found["schema"], SCHEMA, self.folder / _SETTINGS)
        else:
            raise UsageError(
                f"{self.folder} was not made by this command, which needs a folder of that name for what is "
                "unfinished. Move it elsewhere, or give another folder with --out."
            )
        return list(differences(self._settings, found))

    def begin(self) -> None:
        """Prepares the folder; deletes the progress of a command with other settings."""
        self._discard()
        self.folder.mkdir(parents=True, exist_ok=True)
        write_json(self.folder / _SETTINGS, self._settings)

    def save(self, name: str, run: ClosedLoopRun) -> None:
        """Stores a run, whole or not at all."""
        groups = {"": run, "target.": run.target, "episode.": run.episode}
        fields = {f"{group}{name}": getattr(groups[group], name) for group, names in _FIELDS.items() for name in names}
        text = {key: value for key, value in fields.items() if isinstance(value, (str, int)) or value is None}
        arrays = {key: value for key, value in fields.items() if key not in text}
        with whole_file(self.folder / f"{name}{_RUN}") as stream:
            np.savez_compressed(stream, text=np.array(json.dumps(text)), **arrays)

    def load(self, name: str) -> ClosedLoopRun | None:
        """A stored run; None if it is missing or damaged and has to be made again."""
        try:
            every = [f"{group}{name}" for group, names in _FIELDS.items() for name in names]
            arrays = read_npz(self.folder / f"{name}{_RUN}", ["text"], every, text=["text"])
            fields = {**parse_json(str(arrays["text"])), **arrays}
            run, target, episode = ({n: fields[f"{group}{n}"] for n in names} for group, names in _FIELDS.items())
            return ClosedLoopRun(**run, target=Target(**target), episode=Episode(**episode))
        except FileNotFoundError:
            return None
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            say(f"The run {name} was kept, but is damaged and made again: {error}")
            return None

    @property
    def empty(self) -> bool:
        """Whether nothing but the settings was kept."""
        return self._files() == {_SETTINGS}

    def _files(self) -> set[str]:
        return {file.name for file in self.folder.iterdir()}

    def remove(self) -> None:
        """Deletes the command's progress, and the folder unless it holds something else."""
        # without its settings the command has ended
        with contextlib.suppress(FileNotFoundError):
            (self.folder / _SETTINGS).replace(self.folder / f"{_SETTINGS}{DRAFT}")
        self._discard()
        with contextlib.suppress(OSError):
            self.folder.rmdir()

    def _discard(self) -> None:
        for name in self._own():
            (self.folder / name).unlink()

    def _left(self) -> bool:
        """Whether nothing is there but what a kill left of a command that had not begun, or that had ended."""
        files, draft = self._files(), f"{_SETTINGS}{DRAFT}"
        return not files or (draft in files and _SETTINGS not in files and set(self._own()) == files)

    def _own(self) -> list[str]:
        """The command's files, the settings last: until they are gone the same command goes on."""
        patterns = (f"*{_RUN}", _STATE, _SETTINGS)
        every = [self.folder.glob(name) for pattern in patterns for name in (f"{pattern}{DRAFT}", pattern)]
        return [file.name for files in every for file in files]


@contextlib.contextmanager
def unfinished(out: pathlib.Path, settings: Mapping[str, Any], *, overwrite: bool) -> Iterator[Parts]:
    """A folder for results that is marked as unfinished until the block has ended.

    However the block was left, the same command goes on in the folder, with or without `overwrite`; another one is
    refused, as it is by any folder that is not empty.

    Args:
        out: the folder.
        settings: identify this command, as for JSON.
        overwrite: whether results that are there may be replaced.

    Raises:
        UsageError: the folder holds other results and `overwrite` is false, or is a file.
        ValueError: another process is at work in the folder.
    """
    parts, new = Parts(out / "parts", settings), not out.exists()
    differing = parts.differing()
    begun = differing == []
    if not begun:
        if differing and not overwrite:
            raise UsageError(
                f"{out} holds an unfinished run with other options ({', '.join(differing)}): run it with these to "
                "finish it, give another folder with --out, or add --overwrite."
            )
        if differing is None and parts.folder.is_dir():
            parts.remove()  # nothing but what a kill left
        output_folder(out, overwrite=overwrite)
        parts.folder.mkdir(exist_ok=True)
    with sole_writer(parts.folder):
        if not begun:
            parts.begin()
        # what is there of an unfinished command is not finished by refusing this one
        before = _stamps(out) if differing is None else {parts.folder.name: 0}
        try:
            yield parts
        except ValueError:
            # input that is refused before anything was made of it leaves the folder as it was
            if parts.empty and _stamps(out) == before:
                parts.remove()
                if new and not any(out.iterdir()):
                    out.rmdir()
            raise
        parts.remove()


def _stamps(folder: pathlib.Path) -> dict[str, int]:
    """When each file in a folder was last written, 0 for folders."""
    return {file.name: 0 if file.is_dir() else file.stat().st_mtime_ns for file in folder.iterdir()}
