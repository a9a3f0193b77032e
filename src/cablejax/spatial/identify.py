"""Identifies a cable in space from windows of recordings: effects, values, and held-out predictions."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from cablejax.bounded import Result
from cablejax.diagnose.fit import evaluate, improved
from cablejax.diagnose.protocol import Explanation
from cablejax.simulate.rod import Rod
from cablejax.spatial.accidents import moderated
from cablejax.spatial.cable import TWISTED, SpatialCable
from cablejax.spatial.effects import Layout, effect_names, effects_of
from cablejax.spatial.memory import Memory, fingerprint
from cablejax.spatial.search import Step, accepted_effects, halves, search, tried_with, unseen_error, with_effect
from cablejax.spatial.time_steps import TimeSteps, time_steps_for
from cablejax.spatial.windows import Windows

EDGES = 20
"""Edges of the rod that is fitted."""
_SELECTED = 24
_TIMED = 8
_REFITTED = 24
_SHORTEST = 0.8
_RIVAL = "stiffness_profile"


@dataclasses.dataclass(frozen=True)
class Identified:
    """Result of an identification.

    Attributes:
        cable: the simulator, in the windows that it was found from, and the weight of each in the fits.
        time_steps: that it makes between two samples.
        effects: that stayed, in the order in which they were found.
        tried: all effects that might have stayed.
        steps: of the search.
        everything: fitted to all windows.
        halves: fitted to either half of the recordings.
        first: windows of the first half, shape [W].
        results: how the fits to the two halves and to all windows ended.
    """

    cable: SpatialCable
    time_steps: TimeSteps
    effects: tuple[str, ...]
    tried: tuple[str, ...]
    steps: tuple[Step, ...]
    everything: Explanation
    halves: tuple[Explanation, Explanation]
    first: Bool[np.ndarray, "W"]
    results: tuple[Result, ...] = ()

    def stiffness(self, one: Explanation) -> float:
        """EI / rho, geometric mean along the cable [m^4/s^2]."""
        layout = self.cable.layout
        return float(layout.nominal_stiffness * np.exp(layout.log_stiffness(one.vector(layout.effects))))

    def unseen(self) -> tuple[Float[np.ndarray, "W T F 3"], Int[np.ndarray, "W"]]:
        """Predictions of all windows, each from the half of the recordings that it is not part of [m].

        And how the simulation of each ended: a `RodResult`.
        """
        (one, ended), (other, other_ended) = (self.cable.rollouts(half) for half in self.halves)
        return np.where(self.first[:, None, None, None], other, one), np.where(self.first, other_ended, ended)


def layout_of(windows: Windows, nominal_stiffness: float) -> Layout:
    """The parameters of a cable with these windows' markers; `nominal_stiffness` is EI / rho [m^4/s^2]."""
    return Layout(
        effects_of(windows.keypoints.shape[2]),
        float(nominal_stiffness),
        tuple(float(s) for s in windows.arclength),
        tuple(float(g) for g in windows.gravity),
    )


def selection(windows: Windows, count: int = _SELECTED) -> Int[np.ndarray, "S"]:
    """Windows for the search: whole ones that can be simulated, spread evenly over the recordings."""
    whole = np.flatnonzero((windows.valid.mean(axis=1) >= _SHORTEST) & ~windows.torn)
    if not len(whole):
        whole = np.arange(len(windows))
    return whole[np.unique(np.linspace(0, len(whole) - 1, count).astype(int))]


def affordable(one: Explanation, windows: Windows) -> Bool[np.ndarray, "W"]:
    """Windows that values are fitted to: all, unless the material frame is followed, at four times the cost."""
    every = np.arange(len(windows))
    return np.isin(every, selection(windows, _REFITTED) if TWISTED in one.names else every)


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
    names = [name for name in effect_names() if (name != TWISTED if only is None else name in only)]
    layout = layout_of(windows, nominal_stiffness)
    cable = SpatialCable(Rod(EDGES, 1, twisting=False), layout, windows)
    time_steps = time_steps_for(cable.on(windows.chosen(selection(windows, _TIMED))))
    progress(
        f"time steps of {1e3 * windows.interval / time_steps.substeps:.3g} ms; half of that changes the motion by "
        f"{1e3 * time_steps.error:.1f} mm"
    )
    cable = cable.finer(time_steps.substeps)
    picked = cable.on(windows.chosen(selection(windows)))
    memory = Memory(state, fingerprint(cable, names), layout)
    steps = search(
        picked,
        [name for name in names if name != TWISTED],
        begun=memory.steps("search"),
        save=lambda found: memory.keep("search", found),
        progress=progress,
    )
    if TWISTED in names:
        found = memory.steps("twisted")
        if not found:
            progress("rest curvature, which needs the material frame: slower")
            found = _twisted(picked, steps, progress)
            memory.keep("twisted", found)
        steps += found
    last = [step for step in steps if step.accepted][-1]
    cable = cable.trusting(unseen_error(cable, last.halves))
    finals = _final_fits(cable, last.halves, memory, progress)
    return Identified(
        cable=cable,
        time_steps=time_steps,
        effects=tuple(name for name in accepted_effects(steps) if name in last.halves[0].names),
        tried=tuple(names),
        steps=tuple(steps),
        everything=finals[2][0],
        halves=(finals[0][0], finals[1][0]),
        first=halves(windows.group),
        results=tuple(result for _, result in finals),
    )


def _final_fits(cable: SpatialCable, start: tuple[Explanation, Explanation], memory: Memory, progress):
    """Explanation and result of the fits to either half of the recordings, from those of the search, and to all."""
    windows, finals = cable.windows, memory.finals()
    first = halves(windows.group)
    use = [part & affordable(start[0], windows) for part in (first, ~first, np.ones(len(windows), bool))]
    words = ("one half", "the other half", "all")
    for part, word in list(zip(use, words, strict=True))[len(finals) :]:
        progress(f"fitting {word}: {int(part.sum())} windows")
        evidence = cable.on(windows.chosen(np.flatnonzero(part))).evidence()
        begins = begins_for_all(finals[0][0], finals[1][0]) if len(finals) == 2 else [start[len(finals)]]
        # what another part of the recordings was fitted with says nothing here
        kept = np.isin(np.arange(len(begins[0].own)), windows.group[part])[:, None]
        begins = [begin.moved(begin.z, np.where(kept, begin.own, 0.0)) for begin in begins]
        best = min(evaluate(evidence, begins), key=lambda fit: fit.cost(evidence))
        (fit,) = improved(evidence, [best], evidence.simulator.plan.last_steps)
        finals.append((fit.explanation, fit.result))
        memory.keep_finals(finals)
    return finals


def begins_for_all(one: Explanation, other: Explanation) -> list[Explanation]:
    """Where a fit to all recordings may begin: the mean of the fits to both halves, and either of them.

    The mean of two fits that went to different places may be worse than both. Each recording keeps what the fit to its
    own half found for it.
    """
    mean = mean_of(one, other)
    return [mean, mean.moved(one.z, mean.own), mean.moved(other.z, mean.own)]


def mean_of(one: Explanation, other: Explanation) -> Explanation:
    """Of fits to two parts of the same recordings: mean of what is shared, and of what was found for a recording."""
    rows = max(len(one.own), len(other.own))
    both = [np.pad(part.own, ((0, rows - len(part.own)), (0, 0))) for part in (one, other)]
    found = (both[0] != 0).astype(int) + (both[1] != 0)
    return one.moved((one.z + other.z) / 2, (both[0] + both[1]) / np.maximum(found, 1))


def _twisted(cable: SpatialCable, steps: Sequence[Step], progress) -> list[Step]:
    """Rest curvature on top of what was found, and in place of a stiffness profile, its look-alike."""
    before = [step for step in steps if step.accepted][-1]
    variants = {TWISTED: before.halves}
    if _RIVAL in before.halves[0].names:
        variants[f"{TWISTED} for {_RIVAL}"] = (before.halves[0].without(_RIVAL), before.halves[1].without(_RIVAL))
    trials = []
    for name, bases in variants.items():
        effect = cable.layout.named(TWISTED)
        one, other = (with_effect(cable, base, effect, effect.null) for base in bases)
        trials.append(tried_with(cable, name, (one, other), before, progress))
    best = min((t for t in trials if t.accepted), key=lambda t: moderated(t.error).mean(), default=None)
    # the better one of the two stays, and comes last
    result = [dataclasses.replace(t, accepted=False) for t in trials if t is not best]
    if best is not None:
        result.append(best)
        if best.effect != TWISTED:
            # both names: what went out, and what came in
            result.append(dataclasses.replace(best, effect=TWISTED))
    return result
