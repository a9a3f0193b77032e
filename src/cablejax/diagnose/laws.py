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

from cablejax.diagnose.fit import evaluate, improve
from cablejax.diagnose.protocol import explanation
from cablejax.diagnose.refits import refitted
from cablejax.diagnose.search import Search


@dataclasses.dataclass(frozen=True)
class Law:
    """The leading explanations, fitted by another law.

    Attributes:
        assumes: in words.
        found: fits by this law.
        probability: of the law, among all.
    """

    assumes: str
    found: Search
    probability: float


def by_other_laws(found: Search) -> tuple[Law, ...]:
    """Fits what a search by the simulator's own law left open by each of its other laws."""
    others = found.evidence.simulator.other_laws
    if not others:
        return ()
    leading = [fit.explanation for fit in found.in_doubt()[0] if fit.explanation.terms]
    searches = []
    for simulator in others.values():
        bare = dataclasses.replace(found.evidence, simulator=simulator)
        other = dataclasses.replace(bare, nominal=bare.predict([explanation()])[0])
        *starts, null = evaluate(other, [*leading, explanation()])
        fits = improve(other, starts, simulator.plan.last_steps)
        searches.append(Search.of(refitted(other, [*fits, null]), other, found.calibration))
    tried = [set(one.terms) for one in leading] + [set()]
    own = [score for fit, score in zip(found.fits, found.scores, strict=True) if set(fit.explanation.terms) in tried]
    totals = np.array([np.logaddexp.reduce(own), *(np.logaddexp.reduce(search.scores) for search in searches)])
    chances = np.exp(totals - np.logaddexp.reduce(totals))[1:]
    return tuple(
        Law(assumes, search, float(chance)) for assumes, search, chance in zip(others, searches, chances, strict=True)
    )
