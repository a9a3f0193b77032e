"""Finished runs of an unfinished command, kept so that an interrupted demo goes on where it stopped."""

from __future__ import annotations

import dataclasses
import json
import os
import pathlib
import shutil
from collections.abc import Mapping
from typing import Any

import numpy as np

from cablejax.closed_loop import ClosedLoopRun
from cablejax.gaplog import Episode
from cablejax.targets import Target

_NESTED = {"target": Target, "episode": Episode}


class Parts:
    """A folder of runs made under the same settings, one `.npz` each."""

    def __init__(self, folder: pathlib.Path, settings: Mapping[str, Any]):
        self.folder = folder
        self._settings = json.loads(json.dumps(settings))

    def match(self) -> bool:
        """Whether the folder holds runs made under these settings."""
        file = self.folder / "settings.json"
        return file.is_file() and json.loads(file.read_text(encoding="utf-8")) == self._settings

    def begin(self) -> None:
        """Makes the folder ready: runs under these settings stay, others are removed."""
        if not self.match():
            self.remove()
            self.folder.mkdir(parents=True)
            (self.folder / "settings.json").write_text(json.dumps(self._settings), encoding="utf-8")

    def save(self, name: str, run: ClosedLoopRun) -> None:
        """Keeps a run, whole or not at all."""
        fields = _flatten(run)
        text = {key: value for key, value in fields.items() if isinstance(value, (str, int)) or value is None}
        arrays = {key: value for key, value in fields.items() if key not in text}
        draft = self.folder / f"{name}.draft.npz"
        np.savez_compressed(draft, text=np.array(json.dumps(text)), **arrays)
        os.replace(draft, self.folder / f"{name}.npz")

    def load(self, name: str) -> ClosedLoopRun | None:
        """A run that was kept, or None."""
        file = self.folder / f"{name}.npz"
        if not file.is_file():
            return None
        with np.load(file, allow_pickle=False) as archive:
            fields = {key: archive[key] for key in archive.files if key != "text"}
            fields |= json.loads(str(archive["text"]))
        nested = {
            name: cls(**{f.name: fields.pop(f"{name}.{f.name}") for f in dataclasses.fields(cls)})
            for name, cls in _NESTED.items()
        }
        return ClosedLoopRun(**fields, **nested)

    def remove(self) -> None:
        """Deletes the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


def _flatten(run: ClosedLoopRun) -> dict[str, Any]:
    """The fields of a run, those of its target and episode as "target.name" and so on."""
    flat = {}
    for field in dataclasses.fields(run):
        value = getattr(run, field.name)
        if field.name in _NESTED:
            flat |= {f"{field.name}.{inner.name}": getattr(value, inner.name) for inner in dataclasses.fields(value)}
        else:
            flat[field.name] = value
    return flat
