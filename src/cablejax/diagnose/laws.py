"""Refits the leading explanations under other laws of the simulator that the recording may not exclude.

A simulator makes assumptions that a recording may not test: the planar chain assumes, for example, that the table
carries the whole cable. Where the simulator offers another law (`Simulator.other_laws`), the remaining explanations and
the simulator without any effect are refitted under that law. All laws have equal prior probability; the posterior of a
law is that of all its fits together. The verdict is that of the simulator's own law, under which a named effect is
added. Its intervals cover all laws, and it states the verdict under each.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from cablejax.diagnose.belief import Calibration, in_doubt, log_scores
from cablejax.diagnose.evidence import Evidence
from cablejax.diagnose.fit import evaluate, improve
from cablejax.diagnose.protocol import explanation
from cablejax.diagnose.refits import refitted
from cablejax.diagnose.search import Search


@dataclasses.dataclass(frozen=True)
class Law:
    """The leading explanations, fitted by another law.

    Attributes:
        assumes: in words.
        evidence: the same recording, predicted by this law.
        found: fits by this law.
        probability: of the law, among all.
    """

    assumes: str
    evidence: Evidence
    found: Search
    probability: float


def by_other_laws(found: Search, evidence: Evidence, calibration: Calibration) -> tuple[Law, ...]:
    """Fits what a search left open by each of the simulator's other laws.

    Args:
        found: by the simulator's own law.
        evidence: that was explained.
        calibration: of the judgement.
    """
    others = evidence.simulator.other_laws
    if not others:
        return ()
    open_fits, _ = in_doubt(found.fits, found.scores, evidence, calibration)
    leading = [fit.explanation for fit in open_fits if fit.explanation.terms]
    searches, evidences = [], []
    for simulator in others.values():
        bare = dataclasses.replace(evidence, simulator=simulator)
        other = dataclasses.replace(bare, nominal=bare.predict([explanation()])[0])
        *starts, null = evaluate(other, [*leading, explanation()])
        fits = improve(other, starts, simulator.plan.last_steps)
        fits = refitted(other, [*fits, null])
        scores = log_scores(fits, other, calibration)
        best_first = np.argsort(-scores, kind="stable")
        searches.append(Search(tuple(fits[i] for i in best_first), scores[best_first], {}))
        evidences.append(other)
    tried = [set(one.terms) for one in leading] + [set()]
    own = [score for fit, score in zip(found.fits, found.scores, strict=True) if set(fit.explanation.terms) in tried]
    totals = np.array([np.logaddexp.reduce(own), *(np.logaddexp.reduce(search.scores) for search in searches)])
    chances = np.exp(totals - np.logaddexp.reduce(totals))[1:]
    return tuple(
        Law(assumes, other, search, float(chance))
        for assumes, other, search, chance in zip(others, evidences, searches, chances, strict=True)
    )
