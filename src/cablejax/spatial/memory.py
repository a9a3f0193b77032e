"""Progress of an identification in a file, so that an interrupted one resumes."""

from __future__ import annotations

import contextlib
import hashlib
import json
import pathlib
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool

from cablejax.diagnose.protocol import Explanation, Term
from cablejax.spatial.cable import SpatialCable
from cablejax.spatial.effects import Layout
from cablejax.spatial.estimate import Estimate
from cablejax.spatial.search import Step
from cablejax.text_file import read_json
from cablejax.whole_file import whole_file


def fingerprint(cable: SpatialCable, names: Sequence[str], first: Bool[np.ndarray, "W"]) -> str:
    """Inputs that a stored state must have been made from; `first` are the windows of the first half."""
    layout, windows = cable.layout, cable.windows
    simulated = (cable.rod, cable.exact().edges, cable.shown)
    digest = hashlib.sha256(
        repr((*simulated, layout.nominal_stiffness, list(names), windows.name, layout.effects)).encode()
    )
    # what coordinates and values mean is among the inputs: those of another version may mean something else
    meaning = [np.asarray(part, np.float32) for part in jax.tree.leaves(layout.physics(layout.null + 0.5))]
    arrays = (windows.keypoints, windows.position, windows.frames, windows.valid, windows.group, first)
    for array in (*arrays, np.float64(windows.interval), *meaning):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


class Memory:
    """Progress in one JSON file that is written atomically: steps of searches by their names, and "estimates"."""

    def __init__(self, path: pathlib.Path | None, fingerprint: str, layout: Layout):
        self._path, self._layout, self._fingerprint = path, layout, fingerprint
        self._done: dict[str, list[Any]] = {}
        if path is not None and path.exists():
            # what cannot be read is found again
            with contextlib.suppress(ValueError, TypeError, KeyError, IndexError, AttributeError):
                found = read_json(path)
                if found.pop("fingerprint") == fingerprint:
                    self._done = {
                        name: [self._estimate(one) if name == "estimates" else self._step(one) for one in kept]
                        for name, kept in found.items()
                    }

    def done(self, name: str) -> list[Any]:
        """The `Step`s of a search that was begun, or each `Estimate` that is done."""
        return list(self._done.get(name, []))

    def keep(self, name: str, done: Sequence[Step] | Sequence[Estimate]) -> None:
        """Keeps what is done of a search, or the estimates."""
        self._done[name] = list(done)
        if self._path is None:
            return
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(self._path) as stream:
            stream.write(json.dumps({"fingerprint": self._fingerprint, **self._done}, default=_plain).encode())

    def _step(self, kept: dict[str, Any]) -> Step:
        one, other = map(self._explanation, kept["halves"])
        kept["halves"], kept["error"] = (one, other), np.array(kept["error"])
        return Step(**kept)

    def _estimate(self, kept: dict[str, Any]) -> Estimate:
        kept["explanation"] = self._explanation(kept["explanation"])
        for name in ("moves", "shifts"):
            # the number of columns holds also where there are no rows
            kept[name] = np.array(kept[name]).reshape(-1, self._layout.size)
        return Estimate(self._layout, **kept)

    def _explanation(self, kept: dict[str, Any]) -> Explanation:
        own = np.array(kept["own"], float)
        terms = tuple(Term(self._layout.named(name), 0) for name in kept["effects"])
        return Explanation(terms, np.array(kept["z"], float), own if own.size else np.zeros((0, 0)))


def _plain(one: Any) -> Any:
    """What JSON has in the place of an array, an explanation, a step or an estimate."""
    if isinstance(one, np.ndarray):
        return one.tolist()
    if isinstance(one, Explanation):
        return {"effects": one.names, "z": one.z, "own": one.own}
    return {name: value for name, value in vars(one).items() if name != "layout"}
