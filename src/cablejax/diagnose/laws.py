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
from scipy.special import log_softmax, logsumexp, softmax

from cablejax.diagnose.belief import effect_names
from cablejax.diagnose.fit import evaluate, improve
from cablejax.diagnose.protocol import Explanation, Simulator, explanation
from cablejax.diagnose.refits import refitted
from cablejax.diagnose.search import Law, Search


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
    names = [effect_names(one) for one in leading]
    chances = softmax([np.logaddexp.reduce(_scores(search, [*names, ()])) for search in (found, *searches)])
    laws = tuple(map(Law, others, searches, chances[1:].tolist()))
    return _ranked(dataclasses.replace(found, laws=laws), names, chances)


def _there(one: Explanation, simulator: Simulator) -> Explanation:
    """The explanation with the forms of its effects that the law leaves them, see `Effect.variants`."""
    left = {effect.name: effect.variants for effect in simulator.effects}
    terms = tuple(
        term if term.variant in left[term.effect.name] else dataclasses.replace(term, variant=left[term.effect.name][0])
        for term in one.terms
    )
    return dataclasses.replace(one, terms=terms)


def _ranked(found: Search, leading: list[tuple[str, ...]], chances: Float[np.ndarray, "L"]) -> Search:
    """The search with those of its leading explanations ranked over all laws that have as many effects as the best.

    How they compare with all others stays for the simulator's own law to say: the most probable has the best's score.
    `chances` are the laws' probabilities, the simulator's own first.
    """
    alike = [names for names in leading if len(names) == len(effect_names(found.fits[0].explanation))]
    if len(alike) < 2:
        return found
    shares = log_softmax([_scores(search, alike) for search in (found, *(law.found for law in found.laws))], axis=1)
    over = logsumexp(shares, axis=0, b=chances[:, None])
    better = dict(zip(alike, found.scores[0] + over - over.max(), strict=True))
    kept = zip(found.fits, found.scores, strict=True)
    return found.ranked(np.array([better.get(effect_names(fit.explanation), score) for fit, score in kept]))


def _scores(found: Search, names: list[tuple[str, ...]]) -> list[float]:
    """Scores of these sets of effects."""
    scores = {effect_names(fit.explanation): score for fit, score in zip(found.fits, found.scores, strict=True)}
    return [scores[one] for one in names]
