"""Which effects the gap needs: forward selection, scored on the half of the recordings that no fit has seen.

Recordings are split into two halves. Both halves are fitted separately all along, and every window is scored with the
fit of the other half. At each step the effect is tried with which unseen windows are simulated best
from the start; it stays if the error on unseen recordings falls by more than a hundredth, and in more than 84 % of
resamples of the recordings, one standard error. After two effects in a row that did not, the search ends.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from cablejax.spatial.fit import Simulator, errors
from cablejax.spatial.newton import RodFit, fit_at, improve, moved_by, newton_step
from cablejax.spatial.values import Values, shared_by_all
from cablejax.spatial.windows import Windows, dealt

_FAILURES = 2
_LEAST = 0.01
_CHANCE = 0.84


@dataclasses.dataclass(frozen=True)
class Step:
    """One effect that was tried on top of those before it.

    Attributes:
        effect: its name; "" for the nominal simulator.
        accepted: whether it stayed.
        values: of both halves' fits.
        error: mean absolute error of each window's free coordinates, from the fit that has not seen it [m], shape [W].
        chance: share of resamples of the recordings in which the error falls.
    """

    effect: str
    accepted: bool
    values: tuple[Values, Values]
    error: Float[np.ndarray, "W"]
    chance: float


def halves(group: Int[np.ndarray, "W"]) -> Bool[np.ndarray, "W"]:
    """A split of the recordings into two parts of about as many windows; of windows, where there is one recording."""
    if len(np.unique(group)) < 2:
        return np.arange(len(group)) < (len(group) + 1) // 2
    return dealt(group, 2) == 0


def falls(before: Float[np.ndarray, "W"], after: Float[np.ndarray, "W"], group) -> tuple[bool, float]:
    """Whether an error falls beyond chance, and the share of resamples of the recordings in which it does."""
    chance = float((resampled(before - after, group) > 0).mean())
    return bool(chance > _CHANCE and after.mean() < (1 - _LEAST) * before.mean()), chance


def resampled(
    change: Float[np.ndarray, "W"], group: Int[np.ndarray, "W"], *, draws: int = 2000
) -> Float[np.ndarray, "D"]:
    """Means over windows of recordings drawn anew, with a fixed seed."""
    names = np.unique(group)
    total = np.array([change[group == g].sum() for g in names])
    count = np.array([(group == g).sum() for g in names])
    pick = np.random.default_rng(0).integers(len(names), size=(draws, len(names)))
    return total[pick].sum(axis=1) / count[pick].sum(axis=1)


def search(
    simulator: Simulator,
    windows: Windows,
    candidates: Sequence[str],
    *,
    begun: Sequence[Step] = (),
    save: Callable[[Sequence[Step]], None] = lambda steps: None,
    progress: Callable[[str], None] = lambda text: None,
) -> list[Step]:
    """Adds effects one by one as long as recordings that no fit has seen are simulated better.

    Args:
        simulator: of the cable.
        windows: to explain.
        candidates: names of the effects to try.
        begun: steps of an earlier call that was interrupted.
        save: called with all steps after each.
        progress: called with a line of text.

    Returns:
        All steps, the nominal simulator first.
    """
    layout, first = simulator.layout, halves(windows.group)
    parts = (first, ~first)
    steps = list(begun)
    if not steps:
        nothing = shared_by_all(np.zeros(layout.size), windows.group)
        sums = simulator.sums(nothing, windows)
        steps = [Step("", True, (nothing, nothing), sums.error, 0.0)]
        progress(f"nominal simulator: {1e3 * sums.error.mean():.1f} mm from the free markers")
    fits = _again(simulator, windows, steps)
    while True:
        chosen = accepted_effects(steps)
        # what did not help before another effect came in may help now
        tried = [step.effect for step in steps[max(i for i, step in enumerate(steps) if step.accepted) :]][1:]
        rest = [effect for effect in candidates if effect not in chosen and effect not in tried]
        if not rest or len(tried) == _FAILURES:
            break
        starts = {effect: _starts(simulator, fits, windows, parts, [*chosen, effect]) for effect in rest}
        effect = min(starts, key=lambda name: starts[name][1])
        trial = [
            improve(simulator, values, [*chosen, effect], windows, use=part)
            for values, part in zip(starts[effect][0], parts, strict=True)
        ]
        error, before = _unseen(trial, first), _last(steps).error
        accepted, chance = falls(before, error, windows.group)
        steps.append(Step(effect, accepted, (trial[0].values, trial[1].values), error, chance))
        save(steps)
        word = "stays" if accepted else "does not help"
        progress(f"{effect}: {1e3 * before.mean():.2f} -> {1e3 * error.mean():.2f} mm on unseen recordings, {word}")
        if accepted:
            fits = trial
    return steps


def accepted_effects(steps: Sequence[Step]) -> list[str]:
    return [step.effect for step in steps if step.accepted and step.effect]


def _last(steps):
    return [step for step in steps if step.accepted][-1]


def _again(simulator, windows, steps) -> list[RodFit]:
    return [fit_at(simulator, values, accepted_effects(steps), windows) for values in _last(steps).values]


def _unseen(fits: Sequence[RodFit], first):
    """Every window's error from the fit of the other half."""
    return np.where(first, fits[1].sums.error, fits[0].sums.error)


def _starts(simulator: Simulator, fits: Sequence[RodFit], windows: Windows, parts, effects):
    """Where fits with the last effect may begin, per half, and the error on what each has not seen.

    Tried are the step that the quadratic model promises, in parts, and the effect's templates: far from the solution
    the model says little.
    """
    layout, result, error = simulator.layout, [], np.zeros(len(windows))
    for fit, part in zip(fits, parts, strict=True):
        active = layout.active(effects)
        step = newton_step(fit, layout, part, damping=1e-3, active=active)
        trials = [moved_by(layout, fit.values, active, step * scale) for scale in (1.0, 0.4)]
        for where, value in layout.templates(effects[-1]):
            shared = fit.values.shared.copy()
            shared[where] = value
            trials.append(dataclasses.replace(fit.values, shared=shared))
        own, other = windows.chosen(np.flatnonzero(part)), windows.chosen(np.flatnonzero(~part))
        best = min(trials, key=lambda values: errors(simulator.predict(values, own), own).mean())
        result.append(best)
        error[~part] = errors(simulator.predict(best, other), other)
    return result, float(error.mean())
