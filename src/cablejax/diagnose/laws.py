"""Refits the leading explanations under other laws of the simulator that the recording may not exclude.

A simulator makes assumptions that a recording may not test: the planar chain assumes, for example, that the table
carries the whole cable. Where the simulator offers another law (`Simulator.other_laws`), the remaining explanations and
the simulator without any effect are refitted under that law. All laws have equal prior probability; the posterior of a
law is that of all its fits together.

The verdict is that of the simulator's own law, under which a named effect is added. Only the probabilities of
look-alikes are averages over all laws: an effect that makes up for what the own law gets wrong, as a static friction
above the kinetic one does, would otherwise rank before the cause.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.special import softmax

from cablejax.diagnose.belief import effect_names
from cablejax.diagnose.fit import evaluate, improve
from cablejax.diagnose.protocol import Explanation, Simulator, explanation
from cablejax.diagnose.refits import refitted
from cablejax.diagnose.search import Law, Search

# The simulator's own law has what the others leave, which may be as much below 0.
_ROUNDING = 1e-12


def by_other_laws(found: Search) -> Search:
    """Fits what a search by the simulator's own law left open by each of its other laws.

    Returns:
        The search with these fits, its explanations ranked over all laws.
    """
    others = found.evidence.simulator.other_laws
    if not others:
        return found
    leading = [fit.explanation for fit in found.in_doubt()[0] if fit.explanation.terms]
    searches = []
    for simulator in others.values():
        bare = dataclasses.replace(found.evidence, simulator=simulator)
        other = dataclasses.replace(bare, nominal=bare.predict([explanation()])[0])
        *starts, null = evaluate(other, [*(_there(one, simulator) for one in leading), explanation()])
        fits = improve(other, starts, simulator.plan.last_steps)
        searches.append(Search.of(refitted(other, [*fits, null]), other, found.calibration))
    tried = [set(one.terms) for one in leading] + [set()]
    own = [score for fit, score in zip(found.fits, found.scores, strict=True) if set(fit.explanation.terms) in tried]
    totals = np.array([np.logaddexp.reduce(own), *(np.logaddexp.reduce(search.scores) for search in searches)])
    chances = np.exp(totals - np.logaddexp.reduce(totals))[1:].tolist()
    return _over_laws(found, tuple(map(Law, others, searches, chances)))


def _there(one: Explanation, simulator: Simulator) -> Explanation:
    """The explanation with the forms of its effects that the law leaves them, see `Effect.variants`."""
    left = {effect.name: effect.variants for effect in simulator.effects}
    terms = tuple(
        term if term.variant in left[term.effect.name] else dataclasses.replace(term, variant=left[term.effect.name][0])
        for term in one.terms
    )
    return dataclasses.replace(one, terms=terms)


def _over_laws(found: Search, laws: tuple[Law, ...]) -> Search:
    """The search with those explanations ranked over all laws that are open and have as many effects as the best.

    How they compare with all others stays for the simulator's own law to say: the most probable has the best's score.
    """
    size = len(effect_names(found.fits[0].explanation))
    names = [effect_names(fit.explanation) for fit in found.in_doubt()[0]]
    alike = [one for one in names if len(one) == size]
    if not size or len(alike) < 2:
        return dataclasses.replace(found, laws=laws)
    each = [(1.0 - sum(law.probability for law in laws), found), *((law.probability, law.found) for law in laws)]
    shares = np.array([_shares(search, alike) for _, search in each])
    chances = np.maximum([chance for chance, _ in each], _ROUNDING)
    over = np.log(np.maximum(chances / chances.sum() @ shares, np.finfo(float).tiny))
    over += found.scores[0] - over.max()
    better = dict(zip(alike, over.tolist(), strict=True))
    kept = zip(found.fits, found.scores.tolist(), strict=True)
    scores = [better.get(effect_names(fit.explanation), score) for fit, score in kept]
    return dataclasses.replace(found, laws=laws).ranked(np.array(scores))


def _shares(found: Search, alike: list[tuple[str, ...]]) -> Float[np.ndarray, "A"]:
    """Probabilities of these sets of effects, given that one of them holds."""
    scores = {effect_names(fit.explanation): score for fit, score in zip(found.fits, found.scores, strict=True)}
    return softmax([scores[one] for one in alike])
