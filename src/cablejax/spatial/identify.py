"""From windows of recordings to a simulator that explains them: effects, values, and predictions nobody fitted."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from cablejax.bounded import Result
from cablejax.simulate.rod import Rod
from cablejax.spatial.effects import Layout, blocks, effect_names
from cablejax.spatial.fit import Simulator, errors
from cablejax.spatial.memory import Memory, fingerprint
from cablejax.spatial.newton import improve
from cablejax.spatial.search import Step, accepted_effects, falls, halves, search
from cablejax.spatial.time_steps import TimeSteps, time_steps_for
from cablejax.spatial.values import Values, mean_of
from cablejax.spatial.windows import Windows

EDGES = 20
_SELECTED = 24
_TIMED = 8
_REFITTED = 24
_SHORTEST = 0.8
_MATERIAL = "intrinsic_curvature"
_RIVAL = "stiffness_profile"


@dataclasses.dataclass(frozen=True)
class Identified:
    """What was found.

    Attributes:
        simulator: of the rod with all effects.
        time_steps: that it makes between two samples.
        effects: that stayed, in the order in which they were found.
        tried: all effects that might have stayed.
        steps: of the search.
        values: fitted to all windows.
        half_values: fitted to either half of the recordings.
        first: windows of the first half, shape [W].
        results: how the fits to the two halves and to all windows ended.
    """

    simulator: Simulator
    time_steps: TimeSteps
    effects: tuple[str, ...]
    tried: tuple[str, ...]
    steps: tuple[Step, ...]
    values: Values
    half_values: tuple[Values, Values]
    first: Float[np.ndarray, "W"] | np.ndarray
    results: tuple[Result, ...] = ()

    def stiffness(self, values: Values) -> float:
        """EI / rho, geometric mean along the cable, rho with the markers [m^4/s^2]."""
        layout = self.simulator.layout
        return float(layout.nominal_stiffness * np.exp(layout.log_stiffness(values.shared)))

    def unseen(self, windows: Windows) -> Float[np.ndarray, "W T F 3"]:
        """Predictions of the identified windows, each from the half of the recordings that it is not part of [m]."""
        one, other = self.half_values
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
        tuple(float(g) for g in windows.gravity),
    )


def selection(windows: Windows, count: int = _SELECTED) -> Int[np.ndarray, "S"]:
    """Windows for the search: whole ones, spread evenly over the recordings."""
    whole = np.flatnonzero(windows.valid.mean(axis=1) >= _SHORTEST)
    if not len(whole):
        whole = np.arange(len(windows))
    return whole[np.unique(np.linspace(0, len(whole) - 1, count).astype(int))]


def affordable(simulator: Simulator, windows: Windows) -> Bool[np.ndarray, "W"]:
    """Windows that values are fitted to: all, unless the material frame is followed, at four times the cost."""
    every = np.arange(len(windows))
    return np.isin(every, selection(windows, _REFITTED) if simulator.rod.twisting else every)


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

    Raises:
        ValueError: `only` names another effect.
    """
    if unknown := [name for name in only or () if name not in effect_names()]:
        raise ValueError(f"There is no effect {unknown[0]!r} in space, expected some of {', '.join(effect_names())}.")
    names = [name for name in effect_names() if (name != _MATERIAL if only is None else name in only)]
    picked = windows.chosen(selection(windows))
    layout = layout_of(windows, nominal_stiffness, twisting=False)
    time_steps = time_steps_for(windows.chosen(selection(windows, _TIMED)), layout, EDGES)
    progress(
        f"time steps of {1e3 * windows.interval / time_steps.substeps:.3g} ms; half of that changes the motion by "
        f"{1e3 * time_steps.error:.1f} mm"
    )
    plain = Simulator(Rod(EDGES, time_steps.substeps, twisting=False), layout)
    full = Simulator(
        Rod(EDGES, time_steps.substeps, twisting=True), layout_of(windows, nominal_stiffness, twisting=True)
    )
    memory = Memory(state, fingerprint(plain.rod, windows, nominal_stiffness, names))

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
    start = [values.of_size(simulator.layout.size) for values in last.values]

    finals = _final_fits(simulator, windows, effects, start, memory, progress)
    return Identified(
        simulator=simulator,
        time_steps=time_steps,
        effects=tuple(effects),
        tried=tuple(names),
        steps=tuple(steps),
        values=finals[2][0],
        half_values=(finals[0][0], finals[1][0]),
        first=halves(windows.group),
        results=tuple(result for _, result in finals),
    )


def _final_fits(simulator: Simulator, windows: Windows, effects, start, memory: Memory, progress):
    """Values and result of the fits to either half of the recordings and to all; `start` holds values for each half."""
    first, finals = halves(windows.group), memory.finals()
    use = [part & affordable(simulator, windows) for part in (first, ~first, np.ones(len(windows), bool))]
    begins, words = (*start, mean_of(*start)), ("one half", "the other half", "all")
    for part, begin, word in list(zip(use, begins, words, strict=True))[len(finals) :]:
        progress(f"fitting {word}: {int(part.sum())} windows")
        fit = improve(simulator, begin, effects, windows.chosen(np.flatnonzero(part)), progress=progress)
        assert fit.result is not None  # it was improved
        finals.append((fit.values, fit.result))
        memory.keep_finals(finals)
    return finals


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
            fits.append(improve(full, values.without(off), effects, windows.chosen(index)).values)
        predicted = [full.predict(values, windows) for values in fits]
        error = np.where(first, errors(predicted[1], windows), errors(predicted[0], windows))
        accepted, chance = falls(base.error, error, windows.group)
        word = "stays" if accepted else "does not help"
        progress(f"{name}: {1e3 * base.error.mean():.2f} -> {1e3 * error.mean():.2f} mm on unseen recordings, {word}")
        trials.append(Step(name, accepted, (fits[0], fits[1]), error, chance))
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
    one, other = (values.of_size(size) for values in step.values)
    return dataclasses.replace(step, values=(one, other))
