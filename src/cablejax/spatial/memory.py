"""What an identification has done, kept in a file so that an interrupted one goes on where it was."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from cablejax.bounded import Result
from cablejax.json_file import read_json
from cablejax.simulate.rod import Rod
from cablejax.spatial.search import Step
from cablejax.spatial.values import Values, from_json, to_json
from cablejax.spatial.windows import Windows
from cablejax.whole_file import whole_file


def fingerprint(rod: Rod, windows: Windows, nominal_stiffness: float, names: Sequence[str]) -> str:
    """What a kept state must have been made from to be of use."""
    digest = hashlib.sha256(repr((rod, float(nominal_stiffness), list(names), windows.name)).encode())
    for array in (windows.keypoints, windows.position, windows.valid, windows.group):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


class Memory:
    """What is done, in one JSON file that is written whole."""

    def __init__(self, path: pathlib.Path | None, fingerprint: str):
        self._path = path
        self._held: dict[str, Any] = {"fingerprint": fingerprint}
        if path is not None and path.exists():
            # what cannot be read is found again
            with contextlib.suppress(ValueError):
                found = read_json(path)
                if isinstance(found, dict) and found.get("fingerprint") == fingerprint:
                    self._held = found

    def steps(self, name: str) -> list[Step]:
        return [
            Step(
                s["effect"],
                s["accepted"],
                (from_json(s["values"][0]), from_json(s["values"][1])),
                np.array(s["error"]),
                s["chance"],
            )
            for s in self._held.get(name, [])
        ]

    def keep(self, name: str, steps: Sequence[Step]) -> None:
        self._write(
            name,
            [
                {**dataclasses.asdict(s), "values": [to_json(v) for v in s.values], "error": s.error.tolist()}
                for s in steps
            ],
        )

    def finals(self) -> list[tuple[Values, Result]]:
        return [(from_json(kept), Result(kept["result"])) for kept in self._held.get("fits", [])]

    def keep_finals(self, finals: Sequence[tuple[Values, Result]]) -> None:
        self._write("fits", [{**to_json(values), "result": int(result)} for values, result in finals])

    def _write(self, name, value):
        self._held[name] = value
        if self._path is None:
            return
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(self._path) as stream:
            stream.write(json.dumps(self._held).encode())
