"""Progress of an identification in a file, so that an interrupted one resumes."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import pathlib
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from cablejax.diagnose.protocol import Explanation, Term
from cablejax.spatial.cable import SpatialCable
from cablejax.spatial.effects import Layout
from cablejax.spatial.estimate import Estimate
from cablejax.spatial.search import Step
from cablejax.text_file import read_json
from cablejax.whole_file import whole_file


def fingerprint(cable: SpatialCable, names: Sequence[str]) -> str:
    """Inputs that a stored state must have been made from."""
    layout, windows = cable.layout, cable.windows
    digest = hashlib.sha256(
        repr((cable.rod, layout.nominal_stiffness, list(names), windows.name, layout.effects)).encode()
    )
    # what coordinates and values mean is among the inputs: those of another version may mean something else
    meaning = [np.asarray(part, np.float32) for part in jax.tree.leaves(layout.physics(layout.null + 0.5))]
    arrays = (windows.keypoints, windows.position, windows.frames, windows.valid, windows.group)
    for array in (*arrays, np.float64(windows.interval), *meaning):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


class Memory:
    """Progress in one JSON file that is written atomically."""

    def __init__(self, path: pathlib.Path | None, fingerprint: str, layout: Layout):
        self._path, self._layout = path, layout
        self._held: dict[str, Any] = {"fingerprint": fingerprint}
        if path is not None and path.exists():
            # what cannot be read is found again
            before = self._held
            try:
                found = read_json(path)
                if isinstance(found, dict) and found.get("fingerprint") == fingerprint:
                    self._held = found
                    self.estimates()
                    for name in found.keys() - {"fingerprint", "estimates"}:
                        self.steps(name)
            except (ValueError, TypeError, KeyError, IndexError, AttributeError):
                self._held = before

    def steps(self, name: str) -> list[Step]:
        """Steps of a search that was begun."""
        return [
            Step(
                s["effect"],
                s["accepted"],
                (self._read(s["halves"][0]), self._read(s["halves"][1])),
                np.array(s["error"]),
                s["chance"],
                s["counts"],
            )
            for s in self._held.get(name, [])
        ]

    def keep(self, name: str, steps: Sequence[Step]) -> None:
        """Keeps the steps of a search."""
        plain = [
            {
                **{f.name: getattr(s, f.name) for f in dataclasses.fields(s)},
                "halves": [_plain(half) for half in s.halves],
                "error": s.error.tolist(),
            }
            for s in steps
        ]
        self._write(name, plain)

    def estimates(self) -> list[Estimate]:
        """Estimates that are done."""
        return [
            Estimate(
                self._layout,
                self._read(e["explanation"]),
                # the number of columns holds also where there are no rows
                moves=np.array(e["moves"]).reshape(-1, self._layout.size),
                shifts=np.array(e["shifts"]).reshape(-1, self._layout.size),
                speed=e["speed"],
                settled=e["settled"],
            )
            for e in self._held.get("estimates", [])
        ]

    def keep_estimates(self, estimates: Sequence[Estimate]) -> None:
        """Keeps the estimates."""
        plain = [
            {
                "explanation": _plain(e.explanation),
                "moves": e.moves.tolist(),
                "shifts": e.shifts.tolist(),
                "speed": e.speed,
                "settled": e.settled,
            }
            for e in estimates
        ]
        self._write("estimates", plain)

    def _read(self, kept: dict[str, Any]) -> Explanation:
        own = np.array(kept["own"], float)
        terms = tuple(Term(self._layout.named(name), 0) for name in kept["effects"])
        return Explanation(terms, np.array(kept["z"], float), own if own.size else np.zeros((0, 0)))

    def _write(self, name, value):
        self._held[name] = value
        if self._path is None:
            return
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(self._path) as stream:
            stream.write(json.dumps(self._held).encode())


def _plain(one: Explanation) -> dict[str, Any]:
    return {"effects": list(one.names), "z": one.z.tolist(), "own": one.own.tolist()}
