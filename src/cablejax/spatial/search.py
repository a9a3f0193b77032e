"""Forward selection of effects, scored on the held-out half of the recordings.

Recordings are split into two halves that are fitted separately throughout, and every window is scored with the fit of
the other half. Each step tries the effect that is expected to reduce this error most. The effect stays if the error
falls by more than a fiftieth, and in more than 84 % of resamples of the recordings, one standard error, and if it is
not at its null value in both fits. The search ends after four effects in a row that do not stay. Windows that are lost
or far off in every way are left out of the comparison, and effects that lose many do not count as failures
(`accidents`). The search brings fits close to the right minimum and shows how much each effect contributes; from there
all effects are fitted together (`estimate`).

Fits, priors, losses and parameters of single recordings are those of every diagnosis, but the search differs.
`cablejax.diagnose.search` fits all candidates of a step and uses the likelihood of whole episodes, calibrated on
labelled logs. Here one fit takes as long as that whole search, and there are no labelled logs. Candidates are therefore
ordered by what one Gauss-Newton step achieves in the beginnings of the windows (`growing`), and judged by resampling.
This gives no probabilities, so none are reported.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from cablejax.bounded import solve_arrow
from cablejax.diagnose.evidence import Evidence
from cablejax.diagnose.fit import evaluate, improve
from cablejax.diagnose.protocol import Explanation, explanation
from cablejax.diagnose.refits import dealt, independent
from cablejax.spatial.accidents import compared, moderated, off
from cablejax.spatial.cable import SpatialCable, mean_error, typical_error
from cablejax.spatial.effects import SpatialEffect
from cablejax.spatial.growing import beginning, early

_FAILURES = 4
_LEAST = 0.02
_CHANCE = 0.84
_DRAWS = 2000
_DAMPING, _LARGEST_STEP = 1e-3, 1.0
# Windows of either half that effects are ordered by: what is tried next shows in a few.
_PROMISED = 6


@dataclasses.dataclass(frozen=True)
class Step:
    """One effect that was tried on top of those before it.

    Attributes:
        effect: its name; "" for the nominal simulator.
        accepted: whether it stayed.
        halves: fits of both halves.
        error: mean absolute error of each window's free coordinates, from the fit that has not seen it [m], shape [W].
        chance: share of resamples of the recordings in which the error falls.
        counts: whether the effect could be judged: it is no evidence against one that its simulations are lost.
        instead_of: the effect that went out when this one came in; "" = none.
    """

    effect: str
    accepted: bool
    halves: tuple[Explanation, Explanation]
    error: Float[np.ndarray, "W"]
    chance: float
    counts: bool = True
    instead_of: str = ""


def halves(group: Int[np.ndarray, "W"]) -> Bool[np.ndarray, "W"]:
    """A split of the recordings into two parts of about as many windows; of windows, where there is one recording."""
    if len(np.unique(group)) < 2:
        return np.arange(len(group)) < (len(group) + 1) // 2
    return dealt(group, 2) == 0


def falls(before: Float[np.ndarray, "W"], after: Float[np.ndarray, "W"], group) -> tuple[bool, float]:
    """Whether an error falls beyond chance, and the share of resamples of the recordings in which it does.

    Of one recording the windows are resampled. Few windows that are off before or after are left out.
    """
    use, _ = compared(before, after)
    before, after = before[use], after[use]
    chance = float((_resampled(before - after, independent(np.asarray(group)[use])) > 0).mean())
    return bool(chance > _CHANCE and after.mean() < (1 - _LEAST) * before.mean()), chance


def accepted_effects(steps: Sequence[Step]) -> list[str]:
    """Names of the effects that the search kept."""
    return [step.effect for step in steps if step.accepted and step.effect]


def search(
    cable: SpatialCable,
    first: Bool[np.ndarray, "W"],
    candidates: Sequence[str],
    *,
    begun: Sequence[Step] = (),
    save: Callable[[Sequence[Step]], None] = lambda steps: None,
    progress: Callable[[str], None] = lambda text: None,
) -> list[Step]:
    """Adds effects one by one as long as recordings that no fit has seen are simulated better.

    Args:
        cable: in the windows to explain.
        first: those of the first half of the recordings; some of either are needed.
        candidates: names of the effects to try.
        begun: steps of an earlier call that was interrupted.
        save: called with all steps after each.
        progress: called with a line of text.

    Returns:
        All steps, the nominal simulator first.
    """
    steps = list(begun)
    if not steps:
        null = explanation()
        error = unseen_error(cable, first, (null, null))
        steps = [Step("", True, (null, null), error, 0.0)]
        progress(f"nominal simulator: {1e3 * moderated(error).mean():.1f} mm from the free markers")
    while True:
        last = [i for i, step in enumerate(steps) if step.accepted][-1]
        # what did not help before another effect came in may help now
        tried = [step.effect for step in steps[last + 1 :]]
        rest = [name for name in candidates if name not in [*accepted_effects(steps), *tried]]
        failures = sum(step.counts for step in steps[last + 1 :])
        if not rest or failures == _FAILURES:
            return steps
        trusted = cable.trusting(steps[last].error)
        starts = {name: _starts(trusted, first, steps[last].halves, cable.layout.named(name)) for name in rest}
        for name in sorted(rest, key=lambda name: starts[name][1]):
            steps.append(tried_with(cable, first, name, starts[name][0], steps[last], progress))
            save(steps)
            failures += steps[-1].counts
            if steps[-1].accepted or failures == _FAILURES:
                break


def tried_with(
    cable: SpatialCable,
    first: Bool[np.ndarray, "W"],
    name: str,
    starts: tuple[Explanation, Explanation],
    before: Step,
    progress: Callable[[str], None],
    instead_of: str = "",
) -> Step:
    """Fits both halves from starts, and checks whether that improves the held-out predictions.

    Args:
        cable: in all windows.
        first: those of the first half of the recordings.
        name: of what is tried.
        starts: for either half.
        before: the step to compare with.
        progress: called with a line of text.
        instead_of: the effect that the starts do without, if any.
    """
    fits = []
    for start, (seen, _, _) in zip(starts, _parts(cable.trusting(before.error), first), strict=True):
        evidence = seen.evidence()
        fits += improve(evidence, evaluate(evidence, [beginning(seen, [start])]), cable.plan.last_steps)
    fitted = fits[0].explanation, fits[1].explanation
    error = unseen_error(cable, first, fitted)
    better, chance = falls(before.error, error, cable.recording)
    # with the effect at its null value, what the fits gained is due to their further steps
    accepted = better and any(_is_there(cable, name, one) for one in fitted)
    counts = compared(before.error, error)[1]
    word = "stays" if accepted else "does not help" if counts else "fails in many windows, not judged"
    accidents = f", {off(error).sum()} windows off" if off(error).any() else ""
    was, now = (1e3 * moderated(e).mean() for e in (before.error, error))
    what = f"{name} for {instead_of}" if instead_of else name
    progress(f"{what}: {was:.2f} -> {now:.2f} mm on unseen recordings{accidents}, {word}")
    return Step(name, accepted, fitted, error, chance, counts, instead_of)


def _is_there(cable: SpatialCable, name: str, one: Explanation) -> bool:
    """Whether an effect has other values than its null ones, common or of single recordings."""
    effect, slots = cable.layout.named(name), cable.layout.slots(name)
    return bool((one.vector(cable.layout.effects)[slots] != effect.null).any() or (effect.own and one.own.any()))


def unseen_error(
    cable: SpatialCable, first: Bool[np.ndarray, "W"], halves: tuple[Explanation, Explanation]
) -> Float[np.ndarray, "W"]:
    """Error of every window by the fit of the other half [m]; `first` are those of the first half."""
    error = np.zeros(len(cable.windows))
    for one, (_, other, index) in zip(halves, _parts(cable, first), strict=True):
        unseen = other.evidence()
        error[index] = mean_error(unseen.predict([one])[0], unseen.observed)
    return error


def _parts(
    cable: SpatialCable, first: Bool[np.ndarray, "W"]
) -> list[tuple[SpatialCable, SpatialCable, Int[np.ndarray, "_"]]]:
    """The cable in what either half's fit sees, and in what it does not, with its place among the windows."""
    index = [np.flatnonzero(half) for half in (first, ~first)]
    one, other = map(cable.chosen, index)
    return [(one, other, index[1]), (other, one, index[0])]


def _starts(
    cable: SpatialCable, first: Bool[np.ndarray, "W"], before: tuple[Explanation, Explanation], effect: SpatialEffect
) -> tuple[tuple[Explanation, Explanation], float]:
    """Where fits with one more effect may begin, per half, and the error on what each has not seen.

    Seen in the beginnings of few windows: this says what to try first, and the fits correct it. Whole windows of a soft
    cable that swings differ in phase under any parameter, so there what only calms it down would come first.
    """
    found, total = [], 0.0
    for base, parts in zip(before, _parts(cable, first), strict=True):
        seen, other = (early(part.some(_PROMISED)).evidence() for part in parts[:2])
        found.append(_start(seen, base, effect))
        total += typical_error(other, found[-1])
    return (found[0], found[1]), total


def _start(seen: Evidence, base: Explanation, effect: SpatialEffect) -> Explanation:
    """The best of the effect's starts, moved by the step that the quadratic model promises from there, or part of it.

    Far from the solution the model says little.
    """
    trials = [base.plus((effect, variant, values)) for variant, values in effect.starts(None)]
    errors = [typical_error(seen, trial) for trial in trials]
    (fit,) = evaluate(seen, [trials[int(np.argmin(errors))]])
    model = fit.model(seen.weight(fit.sse), 0.0)
    step = -solve_arrow(
        model.curvature + _DAMPING * np.diag(np.diagonal(model.curvature)), model.gradient, model.blocks
    )
    step *= min(1.0, _LARGEST_STEP / max(np.abs(step).max(initial=0.0), 1e-12))
    for share in (1.0, 0.4):
        moved = fit.at(np.clip(model.point + share * step, model.lower, model.upper))
        if typical_error(seen, moved) < min(errors):
            return moved
    return fit.explanation


def _resampled(change: Float[np.ndarray, "W"], group: Int[np.ndarray, "W"]) -> Float[np.ndarray, "D"]:
    """Means over windows of recordings that are drawn with replacement, with a fixed seed."""
    names = np.unique(group)
    total = np.array([change[group == g].sum() for g in names])
    count = np.array([(group == g).sum() for g in names])
    pick = np.random.default_rng(0).integers(len(names), size=(_DRAWS, len(names)))
    return total[pick].sum(axis=1) / count[pick].sum(axis=1)
