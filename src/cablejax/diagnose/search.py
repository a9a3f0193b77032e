"""Searches for explanations: every effect alone, then sets of effects while their score improves."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from cablejax.diagnose.belief import Calibration, as_good, best_by_effects, effect_names, excess, level, log_scores
from cablejax.diagnose.evidence import Evidence
from cablejax.diagnose.fit import Fit, evaluate, improve
from cablejax.diagnose.protocol import Explanation
from cablejax.diagnose.refits import refitted
from cablejax.diagnose.screen import Template, screen, shortlist

_FINALISTS = 9
_BASES = 3
_PARTNERS = 6
# The best of them by weighed templates are tried too.
_WEIGHED_PARTNERS = 3
_NEGLIGIBLE = 0.1
# Of a set, an effect that repeats counted as often as it does: three keypoints off their places and another cause.
_MOST_TERMS = 6
# Each costs simulations of every motion that is considered.
_MOST_IN_DOUBT = 5


@dataclasses.dataclass(frozen=True)
class Law:
    """The leading explanations, fitted by another law of the simulator.

    Attributes:
        assumes: in words.
        found: fits by this law.
        probability: of the law, among all.
    """

    assumes: str
    found: Search
    probability: float


@dataclasses.dataclass(frozen=True)
class Search:
    """All explanations that were fitted to a recording.

    Attributes:
        evidence: that was explained.
        calibration: of the judgement.
        fits: of different sets of effects, best first; one is the nominal simulator.
        scores: their log posterior, see `belief.log_scores`; over all laws where others were tried, see `laws`.
        screened: {effect: share of the squared gap that its best template takes away}.
        laws: what was found by the simulator's other laws.
    """

    evidence: Evidence
    calibration: Calibration
    fits: tuple[Fit, ...]
    scores: Float[np.ndarray, "F"]
    screened: dict[str, float] = dataclasses.field(default_factory=dict)
    laws: tuple[Law, ...] = ()

    @classmethod
    def of(
        cls, fits: Sequence[Fit], evidence: Evidence, calibration: Calibration, screened: dict[str, float] | None = None
    ) -> Search:
        """Scores fits, and sorts them."""
        scores = log_scores(fits, evidence, calibration)
        return cls(evidence, calibration, tuple(fits), scores, screened or {}).ranked(scores)

    def ranked(self, scores: Float[np.ndarray, "F"]) -> Search:
        """The search with these scores, sorted by them."""
        best_first = np.argsort(-scores, kind="stable")
        return dataclasses.replace(self, fits=tuple(self.fits[i] for i in best_first), scores=scores[best_first])

    @property
    def null(self) -> Fit:
        """The nominal simulator."""
        return next(fit for fit in self.fits if not fit.explanation.terms)

    @property
    def singles(self) -> list[int]:
        """Indices of the fits of one effect."""
        return [i for i, fit in enumerate(self.fits) if len(effect_names(fit.explanation)) == 1]

    def complete(self, fit: Fit) -> bool:
        """Whether what a fit leaves of the gap needs no other cause."""
        left, gap = excess(fit, self.evidence), excess(self.null, self.evidence)
        return self.calibration.complete(left, gap, level(self.evidence))

    def in_doubt(self) -> tuple[list[Fit], Float[np.ndarray, "K"]]:
        """Explanations that a verdict leaves open, and their probabilities, sum 1.

        Those whose odds against the best are not small. One with another effect in the place of one of the best's that
        merely leaves as little counts as if its odds were the smallest of these: a likelihood is that sure only if
        every law is exact. So does one that needs no other cause, where the best is the nominal simulator: the log
        shows too little of the gap to pay for an effect.
        """
        best, least = self.fits[0], self.calibration.set_odds
        names, kept, odds = set(effect_names(best.explanation)), [], []
        for fit, chance in zip(self.fits, np.exp(self.scores - self.scores[0]).tolist(), strict=True):
            own = set(effect_names(fit.explanation))
            in_place = len(own) == len(names) and len(own & names) >= len(names) - 1
            as_likely = in_place and as_good(fit, best, self.evidence, self.calibration)
            if as_likely or (own and not names and self.complete(fit)):
                chance = max(chance, least)
            if chance >= least:
                kept.append(fit)
                odds.append(chance)
        order = np.argsort(-np.array(odds), kind="stable")[:_MOST_IN_DOUBT]
        chances = np.array(odds)[order]
        return [kept[i] for i in order], chances / chances.sum()


def search(
    evidence: Evidence,
    null: Fit,
    calibration: Calibration,
    *,
    progress: Callable[[str], None],
) -> Search:
    """Fits every effect alone, and sets of effects if none alone is an adequate explanation.

    Args:
        evidence: to explain.
        null: the nominal simulator, evaluated.
        calibration: of the judgement.
        progress: called with a line of text before each stage.
    """
    gap = excess(null, evidence)
    effects = evidence.simulator.effects
    progress(f"screening {len(effects)} effects")
    templates = screen(evidence, null.explanation, effects, evidence.nominal)
    screened: dict[str, float] = {}
    for template in templates:
        name = template.start.names[-1]
        if not template.weighed:
            screened[name] = max(screened.get(name, 0.0), template.explained)
    progress("fitting every effect")
    plan = evidence.simulator.plan
    starts = _promising(shortlist(templates), screened)
    starts += _of_fixed_size(templates, {start.names[-1] for start in starts})
    singles = _best(improve(evidence, evaluate(evidence, starts), plan.first_steps), evidence, calibration)
    fits = improve(evidence, singles[:_FINALISTS], plan.last_steps) + singles[_FINALISTS:]
    fits = _best([null, *fits], evidence, calibration)
    # the leaders until they rest: what is taken for a missing second effect may be a valley not walked to its end
    fits = _best([*improve(evidence, fits[:_BASES], plan.last_steps), *fits[_BASES:]], evidence, calibration)

    def grow(fits: list[Fit], bases: Sequence[Fit]) -> list[Fit]:
        """Sets of one more effect each, until the best is adequate or the next one no better."""
        for size in range(1 + max(len(base.explanation.terms) for base in bases), _MOST_TERMS + 1):
            left, noise = excess(fits[0], evidence), level(evidence)
            alone = len(effect_names(fits[0].explanation)) == 1
            enough = calibration.needs_no_other(gap, noise) if alone else calibration.may_leave(gap, noise)
            if left <= enough:
                break
            progress(f"fitting sets of {size} effects")
            grown = [fit for base in bases for fit in _grown(evidence, base.explanation, calibration)]
            best_before = log_scores(fits[:1], evidence, calibration)[0]
            fits = _joined(fits, grown, evidence, calibration)
            if log_scores(fits[:1], evidence, calibration)[0] < best_before + 1.0:
                break
            bases = fits[:1]
        return fits

    if singles:
        fits = grow(fits, [fit for fit in fits if fit.explanation.terms][:_BASES])
    if len(effect_names(fits[0].explanation)) > 1:
        progress("exchanging the effects of the best set one by one")
        before = fits[0].explanation
        exchanged = [fit for rest in without_one(before) for fit in _grown(evidence, rest, calibration)]
        fits = _joined(fits, exchanged, evidence, calibration)
        if fits[0].explanation is not before:
            fits = grow(fits, fits[:1])
    return Search.of(fits, evidence, calibration, screened)


def baselines(found: Search) -> dict[str, str]:
    """Effects that simpler rules would have named, see `Diagnosis.baselines`."""
    singles = [found.fits[i] for i in found.singles]
    if not singles:
        return {}
    samples = float(found.evidence.count.sum())

    def bic(fit: Fit) -> float:
        return float(fit.sse.sum()) + len(fit.explanation.z) * float(np.log(samples))

    return {
        "lowest_cost": min(singles, key=lambda fit: float(fit.sse.sum())).explanation.names[0],
        "bic": min(singles, key=bic).explanation.names[0],
        "sparse_regression": max(found.screened, key=lambda name: found.screened[name]),
    }


def _promising(starts: Sequence[Explanation], screened: dict[str, float]) -> list[Explanation]:
    """Starts of effects whose best template explains a part of the gap worth a fit, and of the next best ones."""
    ordered = sorted(screened, key=lambda name: -screened[name])
    threshold = _NEGLIGIBLE * max([0.0, *screened.values()])
    kept = {name for rank, name in enumerate(ordered) if rank < _FINALISTS or screened[name] > threshold}
    return [start for start in starts if start.names[-1] in kept]


def without_one(whole: Explanation) -> list[Explanation]:
    """The explanation without each of its effects."""
    return [whole.without(name) for name in effect_names(whole)]


def _joined(fits: list[Fit], more: list[Fit], evidence: Evidence, calibration: Calibration) -> list[Fit]:
    """The best of all, best first; a new best set also without each of its effects, from the values it has.

    From there an effect may reach alone what it missed before.
    """
    best = _best([*fits, *more], evidence, calibration)
    whole = best[0].explanation
    if whole is fits[0].explanation or len(effect_names(whole)) < 2:
        return best
    rest = improve(evidence, evaluate(evidence, without_one(whole)), evidence.simulator.plan.last_steps)
    return _best([*best, *rest], evidence, calibration)


def _grown(evidence: Evidence, base: Explanation, calibration: Calibration) -> list[Fit]:
    """The base with one more effect each, the most promising ones fitted together with it."""
    full = len(effect_names(base)) >= calibration.max_effects
    partners = [e for e in evidence.simulator.effects if (e.repeatable if e.name in base.names else not full)]
    if not partners:
        return []
    templates = screen(evidence, base, partners, evidence.predict([base])[0])
    starts = shortlist(templates, per_variant=1, per_effect=2)
    starts = [start for start in starts if start.terms[-1] not in start.terms[:-1]][:_PARTNERS]
    tried = {start.names[-1] for start in starts}
    weighed = [start for start in shortlist(templates, 1, 1, weighed=True) if start.names[-1] not in base.names]
    starts += [start for start in weighed[:_WEIGHED_PARTNERS] if start.names[-1] not in tried]
    starts += _of_fixed_size(templates, tried | {start.names[-1] for start in starts})
    return improve(evidence, evaluate(evidence, starts), evidence.simulator.plan.grown_steps)


def _of_fixed_size(templates: Sequence[Template], tried: set[str]) -> list[Explanation]:
    """The best start of each effect that was not tried and that no parameter stretches to meet the gap.

    What its template takes away says little: an obstacle that is not quite in its place touches in other episodes, and
    a lag that starts three times too long looks worse than none.
    """
    fixed = [template for template in templates if template.start.terms[-1].effect.amplitude is None]
    return [start for start in shortlist(fixed, per_variant=1, per_effect=1) if start.names[-1] not in tried]


def _best(fits: Sequence[Fit], evidence: Evidence, calibration: Calibration) -> list[Fit]:
    """The best fit of every set of effects, best first."""
    if evidence.simulator.plan.parts is not None:
        # one of each set is worth the fits without parts of the recordings
        cheapest = best_by_effects(fits, np.array([-fit.cost(evidence) for fit in fits]))
        fits = refitted(evidence, [fits[i] for i in sorted(cheapest.values())])
    scores = log_scores(fits, evidence, calibration)
    return [fits[i] for i in best_by_effects(fits, scores).values()]
