"""Concludes a verdict from fitted explanations."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.special import softmax

from cablejax.arrays import wrapped
from cablejax.diagnose.belief import (
    as_good,
    effect_names,
    excess,
    explains_most_motions,
    has_gap,
    leftover_p,
    leftover_score,
    level,
)
from cablejax.diagnose.diagnosis import (
    PLACES,
    EffectValues,
    NamedEffect,
    ParameterEstimate,
    Ranked,
    UnderLaw,
    Verdict,
)
from cablejax.diagnose.fit import Fit
from cablejax.diagnose.gap import shrinkage
from cablejax.diagnose.judgement import beside_unknown, judged, verdict_sentence
from cablejax.diagnose.posterior import drawn_by, draws, over_laws, posterior
from cablejax.diagnose.protocol import Simulator
from cablejax.diagnose.search import Law, Search

_GRIPPER = "gripper"
"""Several of an effect are one with lists of values, as of keypoints, but each gripper's is one for itself."""


@dataclasses.dataclass(frozen=True)
class Conclusion:
    """The conclusion of a search.

    Attributes:
        verdict: see the format.
        best: the most probable explanation, the nominal simulator included.
        effects: named; empty for "none" and "unknown".
        equivalent: sets of effects that are indistinguishable on this log.
        ranking: of single effects.
        explained: share of the squared gap that the best explanation takes away, on the episodes of the fit.
        leftover_p: of the test whether it leaves more than a right one does, by `belief.leftover_p`; None: no gap.
        posterior: see `Diagnosis`.
        under_laws: see `Diagnosis`.
        undecided: see `Diagnosis`.
        nothing: share of the posterior's draws in which the observations show no effect.
    """

    verdict: Verdict
    best: Fit
    effects: tuple[NamedEffect, ...]
    equivalent: tuple[tuple[str, ...], ...]
    ranking: tuple[Ranked, ...]
    explained: float
    leftover_p: float | None = None
    posterior: tuple[tuple[EffectValues, ...], ...] = ()
    under_laws: tuple[UnderLaw, ...] = ()
    undecided: bool = False
    nothing: float = 0.0


def conclude(found: Search) -> Conclusion:
    """Probabilities, equivalence sets and the verdict.

    The verdict is that of the simulator's own law; probabilities of look-alikes and intervals are over all of them.
    Where the most probable one leaves no gap, no effect is named.
    """
    conclusion, drawn = _concluded(found)
    if not conclusion.effects:
        return conclusion
    every = posterior(found, drawn)
    return dataclasses.replace(conclusion, posterior=every, nothing=every.count(()) / max(len(every), 1))


def _concluded(
    found: Search, drawn: Float[np.ndarray, "D P"] | None = None
) -> tuple[Conclusion, Float[np.ndarray, "D P"]]:
    """The conclusion without its posterior, and draws of the best fit's coordinates over all laws.

    `drawn` are draws by the simulator's own law, where there are some.
    """
    evidence, calibration, simulator = found.evidence, found.calibration, found.evidence.simulator
    best, nothing = found.fits[0], np.zeros((0, 0))
    gap, left = excess(found.null, evidence), excess(best, evidence)
    none = Conclusion("none", found.null, (), (), _ranking(found), 0.0)
    if not has_gap(found.null, evidence, calibration):
        return none, nothing
    shared = [drawn_by(law, best) for law in found.laws]
    under = tuple(map(_under, found.laws, shared))
    if _excused(under):
        return dataclasses.replace(none, under_laws=under), nothing
    unknown = dataclasses.replace(
        none,
        verdict="unknown",
        best=best,
        explained=1.0 - (left / gap) ** 2 if gap > 0 else 0.0,
        leftover_p=leftover_p(leftover_score(left, gap, level(evidence), calibration), simulator.right_scores),
        under_laws=under,
    )
    if not best.explanation.terms:
        # an effect would do, and yet the gap is too small or in too few motions to pay for it
        undecided = any(found.complete(fit) for fit in found.fits if fit.explanation.terms)
        return dataclasses.replace(unknown, undecided=undecided), nothing
    complete = found.complete(best)
    if not _telling(best, unknown.explained, complete, found):
        return unknown, nothing

    own = draws(evidence, best, calibration) if drawn is None else drawn
    drawn = over_laws(own, [(law.probability, each[1]) for law, each in zip(found.laws, shared, strict=True) if each])
    chances = {name: _in_its_place(name, found) for name in effect_names(best.explanation)}
    equivalent = tuple(tuple(alike) for alike in chances.values() if len(alike) > 1)
    verdict = judged(resolvable=True, telling=True, complete=complete, alike=bool(equivalent))
    effects = [one for name, alike in chances.items() for one in _named(name, best, alike, drawn, simulator)]
    effects.sort(key=lambda effect: -(effect.probability or 0.0))
    if verdict == "named+unknown":
        effects = [beside_unknown(effect, simulator.beside_unknown) for effect in effects]
    return dataclasses.replace(unknown, verdict=verdict, effects=tuple(effects), equivalent=equivalent), drawn


def _in_its_place(name: str, found: Search) -> dict[str, float]:
    """Probabilities of an effect of the best explanation, and of those that could replace it; most probable first."""
    best = found.fits[0]
    rest = set(effect_names(best.explanation)) - {name}
    odds: dict[str, float] = {}
    alike_by_size: set[str] = set()
    for fit, chance in zip(found.fits, softmax(found.scores).tolist(), strict=True):
        names = set(effect_names(fit.explanation))
        # the same explanation with another effect in this one's place
        if len(names) == len(rest) + 1 and rest <= names:
            (other,) = names - rest
            odds[other] = odds.get(other, 0.0) + chance
            if as_good(fit, best, found.evidence, found.calibration):
                alike_by_size.add(other)
    least, total = found.calibration.set_odds * odds[name], sum(odds.values())
    # In a wide gap a likelihood is sure of differences that are small compared with the error of any law.
    alike = (other for other in odds if odds[other] >= least or other in alike_by_size)
    return {other: odds[other] / total for other in sorted(alike, key=lambda other: -odds[other])}


def _excused(under: Sequence[UnderLaw]) -> bool:
    """Whether the gap is what a simulator by its own law is off by: there is none by a law that is more probable."""
    own = 1.0 - sum(law.probability for law in under)
    likeliest = max(under, key=lambda law: law.probability, default=None)
    return likeliest is not None and likeliest.probability > own and likeliest.verdict == "none"


def _under(law: Law, shared: tuple[Fit, Float[np.ndarray, "D P"]] | None) -> UnderLaw:
    """The verdict by another law alone; `shared` are a fit by it and draws of its coordinates."""
    drawn = shared[1] if shared is not None and shared[0] is law.found.fits[0] else None
    other, _ = _concluded(law.found, drawn=drawn)
    return UnderLaw(law.assumes, law.probability, other.verdict, other.effects, other.equivalent)


def _telling(best: Fit, explained: float, complete: bool, found: Search) -> bool:
    """Whether enough of the gap goes away to name an explanation, see `judged`."""
    null, evidence, calibration = found.null, found.evidence, found.calibration
    if best.refits is None or null.refits is None:
        return complete or explained >= calibration.telling or explains_most_motions(best, null, evidence, calibration)
    before, after = (fit.refits.sse - evidence.count for fit in (null, best) if fit.refits is not None)
    interval = shrinkage(before, after, evidence.motion)[1]
    return interval is not None and interval[0] > 0


def _ranking(found: Search) -> tuple[Ranked, ...]:
    if not found.singles:
        return ()
    evidence, null, result = found.evidence, found.null, []
    before = max(float(null.held_out_sse(evidence).sum()) - evidence.count.sum(), 1e-9)
    for i, chance in zip(found.singles, softmax(found.scores[found.singles]), strict=True):
        fit = found.fits[i]
        held_out = float(fit.held_out_sse(evidence).sum()) - evidence.count.sum()
        result.append(
            Ranked(
                name=fit.explanation.names[0],
                probability=float(chance),
                held_out_shrinkage=float(np.clip(1 - held_out / before, -1.0, 1.0)),
                leftover_mm=1e3 * excess(fit, evidence),
            )
        )
    tried = {r.name for r in result}
    # effects whose best template explained too little to be fitted
    result += [
        Ranked(name, 0.0, math.nan, 1e3 * excess(null, evidence)) for name in found.screened if name not in tried
    ]
    return tuple(sorted(result, key=lambda r: -(r.probability or 0.0)))


def _named(
    name: str, fit: Fit, chances: dict[str, float], draws: Float[np.ndarray, "D P"], simulator: Simulator
) -> list[NamedEffect]:
    """One effect of a fit, with intervals from draws of the fit's coordinates; each, where there are several.

    `chances` are its probability and those of its look-alikes.
    """
    parts: list[dict[str, ParameterEstimate]] = []
    locations: list[dict[str, Any]] = []
    drawn = [fit.explanation.by_term(draw) for draw in draws]
    for i, (term, z) in enumerate(fit.explanation.by_term()):
        if term.effect.name != name:
            continue
        report = simulator.report(term, term.values(z))
        sampled = [simulator.report(term, term.values(draw[i][1])).parameters for draw in drawn]
        parameters = {}
        for key, (value, unit) in report.parameters.items():
            column = [sample[key][0] for sample in sampled]
            parameters[key] = ParameterEstimate(value, _interval(value, column, unit), unit)
        parts.append(parameters)
        locations.append(dict.fromkeys(PLACES) | report.location)
    if not all(_GRIPPER in part for part in parts):
        parts, locations = [_merged(parts)], [functools.reduce(_spanning, locations)]
    alike = {other: chance for other, chance in chances.items() if other != name}
    return [NamedEffect(name, chances[name], *each, alike) for each in zip(parts, locations, strict=True)]


def _spanning(location: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """Stretches of cable from the first to the last of both; places of another kind are those of the later piece."""
    one, two = location["along_cable_m"], other.get("along_cable_m")
    both = {"along_cable_m": [min(one[0], two[0]), max(one[1], two[1])]} if one and two else {}
    return location | other | both


def _interval(value, column: Sequence[Any], unit: str):
    if isinstance(value, int):
        return None
    drawn = np.asarray(column, float)
    if unit == "rad":
        # angles near the turn of the circle
        drawn = value + wrapped(drawn - value)
    low, high = np.quantile(drawn, (0.05, 0.95))
    return float(low), float(high)


def _merged(parts: list[dict[str, ParameterEstimate]]) -> dict[str, ParameterEstimate]:
    """Several pieces of one effect as lists."""
    if len(parts) == 1:
        return parts[0]
    merged = {}
    for key, first in parts[0].items():
        every = [part[key] for part in parts]
        intervals: Any = None if first.ci90 is None else [e.ci90 for e in every]
        merged[key] = ParameterEstimate([e.value for e in every], intervals, first.unit)
    return merged


def sentence(conclusion: Conclusion, shrinkage: float | None) -> str:
    """The verdict in words, with the share of the squared gap that goes away.

    Args:
        conclusion: the verdict.
        shrinkage: on episodes left out of the fit; None where nothing could be, which leaves that of the fit.
    """
    if conclusion.verdict == "none" and conclusion.under_laws:
        law = max(conclusion.under_laws, key=lambda law: law.probability)
        return (
            f"No effect is needed to explain this log if {law.assumes}: that assumption fits the log better than the "
            "nominal one."
        )
    if conclusion.undecided:
        return "There is a gap, but this log shows too little of it to name the cause: record more motions."
    parts = (conclusion.effects, conclusion.equivalent, conclusion.explained)
    said = verdict_sentence(conclusion.verdict, *parts, shrinkage)
    if not conclusion.nothing:
        return said
    chance = f"{100 * conclusion.nothing:.0f} %"
    return f"{said} With a probability of {chance} there is no effect, and the gap is the simulator's own error."
