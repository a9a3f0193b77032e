"""Identifies a cable in space from windows of recordings: effects, values, and held-out predictions.

A search adds effects one by one, which brings fits close to the right minimum and shows how much each effect
contributes (`search`). From there, all effects that were tried are fitted together (`estimate`). Reported values and
predictions both come from this fit, not from the search's selection: whether an effect near the threshold stays depends
on chance, and leaving an effect out biases the others.

Before the search, the time steps are chosen from the recorded motion alone. One step per sample is enough at 100 Hz for
clamps that move like a hand. Clamps that swing by decimetres twice a second, or samples that are far apart, need more
steps. Steps are halved until halving them hardly changes the motion of a cable with the nominal stiffness and ordinary
damping.
"""

from __future__ import annotations

import dataclasses
import math
import pathlib
from collections.abc import Callable, Collection, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from cablejax.cable import GRAVITY
from cablejax.diagnose.protocol import Explanation, explanation
from cablejax.simulate.rod import Rod
from cablejax.spatial.accidents import moderated
from cablejax.spatial.cable import FINER, GOOD_FIT, TWISTED, SpatialCable, bounded
from cablejax.spatial.effects import Layout, effect_names, effects_of
from cablejax.spatial.estimate import Estimate, estimate, restarts, starts_from
from cablejax.spatial.memory import Memory, fingerprint
from cablejax.spatial.search import Step, accepted_effects, halves, search, tried_with, unseen_error
from cablejax.spatial.windows import Windows

EDGES = 20
"""Edges of the rod that is fitted."""
_SEARCHED = 24
_TIMED = 8
_RIVAL = "stiffness_profile"
# Of the time steps between two samples, at most.
_FINEST = 4
# For so long the simulated cable follows its markers in fits [s]: two samples of a few markers leave its motion between
# them open, and what that adds later hides small effects. Predictions begin with two samples.
_SHOWN = 0.1
# Errors of the time steps may be so large a part of what a good fit leaves, on half of the windows. The others may hold
# a cable that snaps through, as the believed one often does where the true one is stiffer: there any error grows.
_SHARE = 0.5
# Edges and time steps of predictions change so large a part of the error that is left, or less, on half of the windows.
_ADDS = 0.3
# A damping time [s] and a drag [1/s] as cables have them.
_ORDINARY = {"bending_damping": 0.03, "viscous_drag": 0.3}


@dataclasses.dataclass(frozen=True)
class TimeSteps:
    """Steps between two samples.

    Attributes:
        substeps: their number.
        error: by which half the steps would change the motion, as a mean over coordinates and samples, median over
            windows [m].
    """

    substeps: int
    error: float

    @property
    def fine_enough(self) -> bool:
        """Whether finer steps would change less than a part of what a good fit leaves."""
        return self.error <= _SHARE * GOOD_FIT


@dataclasses.dataclass(frozen=True)
class Identified:
    """Result of an identification.

    Attributes:
        cable: the simulator of what was found, in the windows that it was found from, and the weight of each in fits.
        time_steps: that it makes between two samples.
        effects: that stayed in the search, in the order in which they were found.
        tried: all effects that might have stayed; estimates have them all.
        steps: of the search.
        everything: fitted to all windows.
        halves: fitted to either half of the recordings.
        first: windows of the first half, shape [W].
    """

    cable: SpatialCable
    time_steps: TimeSteps
    effects: tuple[str, ...]
    tried: tuple[str, ...]
    steps: tuple[Step, ...]
    everything: Estimate
    halves: tuple[Estimate, Estimate]
    first: Bool[np.ndarray, "W"]

    @property
    def bends_over(self) -> float:
        """Length over which the cable bends under its own weight, (EI / (rho g))^(1/3), by its estimate [m]."""
        return float((self.everything.stiffness.value / GRAVITY) ** (1 / 3))

    @property
    def resolved(self) -> bool:
        """Whether that is more than an edge of the simulated cable, which hangs like a chain otherwise."""
        return self.bends_over >= self.cable.windows.arclength[-1] / EDGES

    def unseen(
        self, effects: Collection[str] | None = None
    ) -> tuple[Float[np.ndarray, "W T F 3"], Int[np.ndarray, "W"]]:
        """Predictions of all windows, each from the half of the recordings that it is not part of [m].

        And how the simulation of each ended: a `RodResult`.

        Args:
            effects: that are simulated, with their values from that half's fit of all effects; None = all.
        """
        ones = (half.explanation if effects is None else half.with_only(effects) for half in self.halves)
        return self.unseen_by(*ones)

    def unseen_by(
        self, one: Explanation, other: Explanation
    ) -> tuple[Float[np.ndarray, "W T F 3"], Int[np.ndarray, "W"]]:
        """What `unseen` returns, of other fits to the first half of the recordings and to the second."""
        (found, ended), (others, others_ended) = map(self.cable.rollouts, (one, other))
        return np.where(self.first[:, None, None, None], others, found), np.where(self.first, others_ended, ended)


def layout_of(windows: Windows, nominal_stiffness: float, nominal_damping: float = 0.0) -> Layout:
    """The parameters of a cable with these windows' markers, nominal EI / rho [m^4/s^2] and damping time [s]."""
    return Layout(
        effects_of(windows.keypoints.shape[2], nominal_damping),
        float(nominal_stiffness),
        tuple(float(s) for s in windows.arclength),
        tuple(float(g) for g in windows.gravity),
    )


def identify(
    windows: Windows,
    nominal_stiffness: float,
    nominal_damping: float = 0.0,
    *,
    only: Sequence[str] | None = None,
    state: pathlib.Path | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> Identified:
    """Searches for effects, and fits all of them to both halves of the recordings and to all windows.

    Args:
        windows: to explain; all of them may be fitted.
        nominal_stiffness: EI / rho believed true [m^4/s^2].
        nominal_damping: time of Kelvin-Voigt damping in bending believed true [s].
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
    layout = layout_of(windows, nominal_stiffness, nominal_damping)
    cable = SpatialCable(Rod(EDGES, 1, twisting=False), layout, windows)
    time_steps = time_steps_for(cable.some(_TIMED))
    progress(
        f"time steps of {1e3 * windows.interval / time_steps.substeps:.3g} ms; half of that changes the motion by "
        f"{1e3 * time_steps.error:.1f} mm"
    )
    cable = dataclasses.replace(cable.finer(time_steps.substeps), shown=2 + math.ceil(_SHOWN / windows.interval))
    # a recording is in the same half in the search and in the estimates: what has seen it is not scored on it
    first = halves(windows.group)
    searched = _searched(windows, first)
    picked = cable.chosen(searched)
    memory = Memory(state, fingerprint(cable, names, first), layout)
    steps = search(
        picked,
        first[searched],
        [name for name in names if name != TWISTED],
        begun=memory.done("search"),
        save=lambda found: memory.keep("search", found),
        progress=progress,
    )
    if TWISTED in names:
        found = memory.done("twisted")
        if not found:
            progress("rest curvature, which needs the material frame: slower")
            found = _twisted(picked, first[searched], steps, progress)
            memory.keep("twisted", found)
        steps += found
    last = [step for step in steps if step.accepted][-1]
    cable = cable.trusting(unseen_error(cable, first, last.halves))
    one, other, everything = _estimates(cable, first, last.halves, names, memory, progress)
    return Identified(
        cable=_for_predictions(dataclasses.replace(cable, shown=2), everything.explanation),
        time_steps=time_steps,
        effects=tuple(name for name in accepted_effects(steps) if name in last.halves[0].names),
        tried=tuple(names),
        steps=tuple(steps),
        everything=everything,
        halves=(one, other),
        first=first,
    )


def _searched(windows: Windows, first: Bool[np.ndarray, "W"]) -> Int[np.ndarray, "S"]:
    """Windows that the search sees, as many of either half where there are as many, at least one."""
    parts = (np.flatnonzero(part) for part in (first, ~first))
    return np.sort(np.concatenate([part[windows.chosen(part).whole(_SEARCHED // 2, 1)] for part in parts]))


def _estimates(cable: SpatialCable, first, begun, tried, memory: Memory, progress) -> list[Estimate]:
    """Of either half of the recordings, from the fits of the search, and of all."""
    done = memory.done("estimates")
    parts = ((first, "one half"), (~first, "the other half"), (np.ones(len(first), bool), "all recordings"))
    for part, word in parts[len(done) :]:
        progress(f"fitting {word}")
        own = cable.chosen(np.flatnonzero(part))
        starts = restarts(begun[len(done)]) if len(done) < 2 else starts_from(*(half.explanation for half in done))
        done.append(estimate(own, starts, tried, progress=progress))
        memory.keep("estimates", done)
    return done


def _for_predictions(cable: SpatialCable, one: Explanation) -> SpatialCable:
    """With so many edges and time steps that more change little.

    Values that were fitted with a correction are off by what it took out where predictions have the longer edges and
    steps of the fit.
    """
    *choices, exact = (c for e in map(cable.exact, (1, 2, FINER)) for c in (e.with_most_edges(), e))
    some = exact.some(_TIMED)
    motion, seen, valid = some.motion(one), some.windows.observed, some.windows.valid
    left = _typical(motion - seen, np.isfinite(seen))
    for choice in choices:
        if _typical(choice.on(some.windows).motion(one) - motion, valid) <= _ADDS * left:
            return choice
    return exact


def _twisted(cable: SpatialCable, first: Bool[np.ndarray, "W"], steps: Sequence[Step], progress) -> list[Step]:
    """Rest curvature on top of what was found, and in place of a stiffness profile, its look-alike."""
    before, effect = [step for step in steps if step.accepted][-1], cable.layout.named(TWISTED)
    trials = []
    for rival in ("", _RIVAL) if _RIVAL in before.halves[0].names else ("",):
        one, other = (base.without(rival).plus((effect, 0, effect.null)) for base in before.halves)
        trials.append(tried_with(cable, first, TWISTED, (one, other), before, progress, rival))
    best = min((t for t in trials if t.accepted), key=lambda t: moderated(t.error).mean(), default=None)
    # the better one of the two stays, and comes last
    return sorted((dataclasses.replace(t, accepted=t is best) for t in trials), key=lambda t: t.accepted)


def time_steps_for(cable: SpatialCable) -> TimeSteps:
    """The fewest steps that are fine enough, or `_FINEST`.

    Args:
        cable: with one step between two samples, in windows whose motion is to be simulated.
    """
    ordinary = [(cable.layout.named(name), 0, (value,)) for name, value in _ORDINARY.items()]

    def predicted(substeps):
        return cable.finer(substeps).motion(explanation(*ordinary))

    substeps, coarse = 1, predicted(1)
    while True:
        fine = predicted(2 * substeps)
        found = TimeSteps(substeps, _typical(coarse - fine, cable.windows.valid))
        if found.fine_enough or substeps >= _FINEST:
            return found
        substeps, coarse = 2 * substeps, fine


def _typical(off: Float[np.ndarray, "W T F 3"], counted: Bool[np.ndarray, "W *rest"]) -> float:
    """Median over windows of the mean size of the coordinates that count [m]: few windows may amplify differences."""
    each = [part[where] for part, where in zip(bounded(off), counted, strict=True)]
    return float(np.median([sizes.sum() / max(sizes.size, 1) for sizes in each]))
