"""From windows of recordings to a simulator that explains them: effects, values, and predictions nobody fitted."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import pathlib
import tempfile
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from cablejax.spatial.effects import Layout, blocks
from cablejax.spatial.fit import Fit, Simulator, errors, improve, newton_step, slopes
from cablejax.spatial.rod import Rod
from cablejax.spatial.search import Step, accepted_effects, falls, halves, search
from cablejax.spatial.windows import Windows

EDGES = 20
_SELECTED = 16
_REFITTED = 24
_SHORTEST = 0.8
_MATERIAL = "intrinsic_curvature"
_RIVAL = "stiffness_profile"


@dataclasses.dataclass(frozen=True)
class Identified:
    """What was found.

    Attributes:
        simulator: of the rod with all effects.
        effects: that stayed, in the order in which they were found.
        steps: of the search.
        values: fitted to all windows, shape [P].
        half_values: fitted to either half of the recordings, shape [2, P].
        spread: standard error of the values, by leaving out recordings, shape [P].
        first: windows of the first half, shape [W].
    """

    simulator: Simulator
    effects: tuple[str, ...]
    steps: tuple[Step, ...]
    values: Float[np.ndarray, "P"]
    half_values: Float[np.ndarray, "2 P"]
    spread: Float[np.ndarray, "P"]
    first: Float[np.ndarray, "W"] | np.ndarray

    def unseen(self, windows: Windows, *, values=None) -> Float[np.ndarray, "W T F 3"]:
        """Predictions of the identified windows, each from the half of the recordings that it is not part of [m]."""
        one, other = self.half_values if values is None else values
        return np.where(
            self.first[:, None, None, None],
            self.simulator.predict(other, windows),
            self.simulator.predict(one, windows),
        )


def layout_of(windows: Windows, nominal_stiffness: float, *, twisting: bool) -> Layout:
    """The parameters of a cable with these windows' markers; `nominal_stiffness` is EI / rho [m^4/s^2]."""
    return Layout(
        blocks(windows.keypoints.shape[2], twisting=twisting),
        float(nominal_stiffness),
        tuple(float(s) for s in windows.arclength),
    )


def selection(windows: Windows, count: int = _SELECTED) -> Int[np.ndarray, "S"]:
    """Windows for the search: whole ones, spread evenly over the recordings."""
    whole = np.flatnonzero(windows.valid.mean(axis=1) >= _SHORTEST)
    if not len(whole):
        whole = np.arange(len(windows))
    return whole[np.unique(np.linspace(0, len(whole) - 1, count).astype(int))]


def identify(
    windows: Windows,
    nominal_stiffness: float,
    *,
    only: Sequence[str] | None = None,
    state: pathlib.Path | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> Identified:
    """Searches for effects, fits them to all windows and to both halves of the recordings.

    Args:
        windows: to explain; all of them may be fitted.
        nominal_stiffness: EI / rho believed true [m^4/s^2].
        only: names of the effects to try; by default all but `intrinsic_curvature`, whose derivatives follow the
            material frame and take four times as long as all others together.
        state: file that keeps what is done, so that an interrupted call goes on where it was.
        progress: called with a line of text.
    """
    names = [block.effect for block in blocks(1, twisting=True)]
    names = [name for name in dict.fromkeys(names) if (name != _MATERIAL if only is None else name in only)]
    memory = _Memory(state, _fingerprint(windows, nominal_stiffness, names))
    picked = windows.chosen(selection(windows))
    plain = Simulator(Rod(EDGES, twisting=False), layout_of(windows, nominal_stiffness, twisting=False))
    full = Simulator(Rod(EDGES, twisting=True), layout_of(windows, nominal_stiffness, twisting=True))

    steps = search(
        plain,
        picked,
        [name for name in names if name != _MATERIAL],
        begun=memory.steps("search"),
        save=lambda found: memory.keep("search", found),
        progress=progress,
    )
    simulator = plain
    if _MATERIAL in names:
        found = memory.steps("material")
        if not found:
            progress("rest curvature, which needs the material frame: slower")
            found = _material(full, picked, steps, progress)
            memory.keep("material", found)
        if any(step.accepted for step in found):
            simulator = full
        steps = [_padded(step, full.layout.size) for step in steps] + found
    effects = accepted_effects(steps)
    if _MATERIAL in effects and any(s.effect == f"{_MATERIAL} for {_RIVAL}" and s.accepted for s in steps):
        effects.remove(_RIVAL)
    last = [step for step in steps if step.accepted][-1]
    start = last.values[:, : simulator.layout.size]

    first = halves(windows.group)
    finals = memory.arrays("final")
    if not finals:
        use = [first, ~first, np.ones(len(windows), bool)]
        if simulator.rod.twisting:
            # derivatives with the material frame cost four times as much
            use = [part & np.isin(np.arange(len(windows)), selection(windows, _REFITTED)) for part in use]
        values = []
        for part, begin, word in zip(
            use, [*start, start.mean(axis=0)], ("one half", "the other half", "all"), strict=True
        ):
            progress(f"fitting {word}: {int(part.sum())} windows")
            index = np.flatnonzero(part)
            fit = improve(simulator, begin, effects, windows.chosen(index), iterations=4, progress=progress)
            values.append(fit.values)
        finals = {"values": np.stack(values), "spread": _jackknife(fit, simulator.layout, windows.group[index])}
        memory.keep_arrays("final", finals)
    return Identified(
        simulator=simulator,
        effects=tuple(effects),
        steps=tuple(steps),
        values=finals["values"][2],
        half_values=finals["values"][:2],
        spread=finals["spread"],
        first=first,
    )


def _material(full: Simulator, windows: Windows, steps, progress) -> list[Step]:
    """Rest curvature on top of what was found, and in place of a stiffness profile, its look-alike."""
    chosen, base = accepted_effects(steps), [step for step in steps if step.accepted][-1]
    first = halves(windows.group)
    start = _padded(base, full.layout.size).values
    trials = []
    variants = [(_MATERIAL, [*chosen, _MATERIAL])]
    if _RIVAL in chosen:
        variants.append((f"{_MATERIAL} for {_RIVAL}", [*(c for c in chosen if c != _RIVAL), _MATERIAL]))
    for name, effects in variants:
        off = ~full.layout.active(effects)
        fits = []
        for values, part in zip(start, (first, ~first), strict=True):
            index = np.flatnonzero(part)
            fits.append(improve(full, np.where(off, 0.0, values), effects, windows.chosen(index), iterations=4).values)
        predicted = [full.predict(values, windows) for values in fits]
        error = np.where(first, errors(predicted[1], windows), errors(predicted[0], windows))
        accepted, chance = falls(base.error, error, windows.group)
        word = "stays" if accepted else "does not help"
        progress(f"{name}: {1e3 * base.error.mean():.2f} -> {1e3 * error.mean():.2f} mm on unseen recordings, {word}")
        trials.append(Step(name, accepted, np.stack(fits), error, chance))
    best = min((t for t in trials if t.accepted), key=lambda t: t.error.mean(), default=None)
    # the better one of the two stays, and comes last
    result = [dataclasses.replace(t, accepted=False) for t in trials if t is not best]
    if best is not None:
        result.append(best)
        if best.effect != _MATERIAL:
            # both names: what went out, and what came in
            result.append(dataclasses.replace(best, effect=_MATERIAL))
    return result


def _padded(step: Step, size: int) -> Step:
    missing = size - step.values.shape[1]
    return dataclasses.replace(step, values=np.pad(step.values, ((0, 0), (0, missing))))


def _jackknife(fit: Fit, layout: Layout, group) -> Float[np.ndarray, "P"]:
    """Standard error of the values by one Gauss-Newton step without each recording (Miller 1974)."""
    names = np.unique(group) if len(np.unique(group)) > 1 else np.arange(len(group))
    label = group if len(np.unique(group)) > 1 else names
    moved = np.array([newton_step(fit, layout, label != name) for name in names])
    full = newton_step(fit, layout, np.ones(len(label), bool))
    steps = (moved - full) * slopes(layout, fit.values)
    count = len(names)
    return np.where(fit.active, np.sqrt((count - 1) / count * (steps**2).sum(axis=0)), 0.0)


def _fingerprint(windows: Windows, nominal_stiffness: float, names: Sequence[str]) -> str:
    """What a kept state must have been made from to be of use."""
    digest = hashlib.sha256(repr((EDGES, float(nominal_stiffness), list(names), windows.name)).encode())
    for array in (windows.keypoints, windows.position, windows.valid, windows.group):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


class _Memory:
    """What is done, in one JSON file that is written whole."""

    def __init__(self, path: pathlib.Path | None, fingerprint: str):
        self._path = path
        self._held: dict[str, Any] = json.loads(path.read_text()) if path is not None and path.exists() else {}
        if self._held.get("fingerprint") != fingerprint:
            self._held = {"fingerprint": fingerprint}

    def steps(self, name: str) -> list[Step]:
        return [
            Step(s["effect"], s["accepted"], np.array(s["values"]), np.array(s["error"]), s["chance"])
            for s in self._held.get(name, [])
        ]

    def keep(self, name: str, steps: Sequence[Step]) -> None:
        self._write(
            name,
            [{**dataclasses.asdict(s), "values": s.values.tolist(), "error": s.error.tolist()} for s in steps],
        )

    def arrays(self, name: str) -> dict[str, np.ndarray]:
        return {k: np.array(v) for k, v in self._held.get(name, {}).items()}

    def keep_arrays(self, name: str, arrays: dict[str, np.ndarray]) -> None:
        self._write(name, {k: v.tolist() for k, v in arrays.items()})

    def _write(self, name, value):
        self._held[name] = value
        if self._path is None:
            return
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile("w", dir=self._path.parent, delete=False) as file:
            json.dump(self._held, file)
        os.replace(file.name, self._path)
