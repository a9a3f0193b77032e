"""Other laws of a simulator: the recording says which it fits, and intervals are over all of them."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from cablejax.diagnose import Calibration, explanation
from cablejax.diagnose.conclude import Conclusion, conclude, sentence
from cablejax.diagnose.diagnosis import ParameterEstimate
from cablejax.diagnose.evidence import Evidence
from cablejax.diagnose.fit import evaluate, improve
from cablejax.diagnose.laws import by_other_laws
from cablejax.diagnose.planar import OTHER_LAWS
from cablejax.diagnose.protocol import Explanation
from cablejax.diagnose.search import Law, Search
from diagnose_cases import BY_NAME, CABLE, evidence, noise, parts

FRICTION = ("table_friction", (2.2, 0.0))
STIFFNESS = ("bending_stiffness", (0.5,))
NOISE_MM = 0.3
CARRIED, STICKS = OTHER_LAWS


def recorded(*effects: tuple[str, Any], by: str | None = None) -> Evidence:
    """By one of the other laws, or by the simulator's own."""
    facts = evidence(*effects, noise_mm=NOISE_MM)
    if by is None:
        return facts
    law = facts.simulator.other_laws[by]
    points = law.predict([explanation(*parts(*effects))], facts.episodes)[0]
    return dataclasses.replace(facts, observed=points + noise(points.shape, NOISE_MM, 0))


def searched(facts: Evidence, *friction: Explanation) -> Search:
    """Without other laws; the friction in these forms, or the usual one."""
    # a simulator that is exact but for its law, so that small gaps count
    calibration = Calibration(baseline=2e-5, noise_share=0.02)
    starts = [explanation(), *(friction or [explanation(*parts(FRICTION))]), explanation(*parts(STIFFNESS))]
    return Search.of(improve(facts, evaluate(facts, starts), max_iterations=10), facts, calibration)


def concluded(facts: Evidence, *, laws: bool = True) -> tuple[Conclusion, tuple[Law, ...]]:
    found = by_other_laws(searched(facts)) if laws else searched(facts)
    return conclude(found), found.laws


@pytest.mark.parametrize("carried", [False, True])
def test_the_recording_says_which_law_it_fits(carried):
    """By the other one alone the friction comes out wrong; over both laws its interval holds."""
    conclusion, laws = concluded(recorded(FRICTION, by=CARRIED if carried else None))
    assert [law.assumes for law in laws] == [under.assumes for under in conclusion.under_laws] == [CARRIED, STICKS]
    law, sticks = laws
    (effect,), (there,) = conclusion.effects, conclusion.under_laws[0].effects
    assert effect.name == there.name == "table_friction"
    assert law.probability > 0.99 if carried else law.probability < 0.01
    assert sticks.probability < 0.01
    truth = 2.2 * CABLE.friction_coefficient
    whole, alone = effect.parameters["coefficient"], there.parameters["coefficient"]
    assert covers(whole, truth)
    wrong = whole if carried else alone
    assert abs(wrong.value / truth - 1) > 0.012
    assert abs((alone if carried else whole).value / truth - 1) < 0.006
    if not carried:
        assert not covers(alone, truth)


def test_what_another_law_makes_is_no_effect(monkeypatch):
    """Grippers that carry nearly all of the cable, and nothing else: by the nominal law a smoother table is named."""
    monkeypatch.setitem(OTHER_LAWS, CARRIED, {"grip_height": 0.02})
    conclusion, (law, _) = concluded(recorded(by=CARRIED))
    assert law.probability > 0.5
    assert conclusion.verdict == "none" and conclusion.effects == ()
    assert conclusion.under_laws[0].verdict == "none" and CARRIED in sentence(conclusion, None)
    alone, _ = concluded(recorded(by=CARRIED), laws=False)
    assert alone.verdict != "none"


def test_a_law_costs_one_verdict_and_no_posterior(monkeypatch):
    """What a verdict would be under a law is stated without draws from all that is left open there."""
    drawn = []
    monkeypatch.setattr("cablejax.diagnose.conclude.posterior", lambda found, *_: drawn.append(found) or ())
    conclusion, laws = concluded(recorded(FRICTION))
    assert len(conclusion.under_laws) == len(laws) == 2 and all(under.effects for under in conclusion.under_laws)
    assert len(drawn) == 1 and not any(drawn[0] is law.found for law in laws)


def test_an_effect_that_makes_up_for_the_law_does_not_rank_before_the_cause(monkeypatch):
    """Friction that sticks harder than it slides: only a fitted excess has it by the own law, whatever the cause is."""
    monkeypatch.setitem(OTHER_LAWS, STICKS, {"static_excess": 1.0})
    facts = recorded(STIFFNESS, by=STICKS)
    alone = searched(facts, explanation((BY_NAME["table_friction"], 1, (2.0, 0.2))))
    found = by_other_laws(alone)
    assert alone.fits[0].explanation.names == ("table_friction",)
    assert found.fits[0].explanation.names == ("bending_stiffness",)
    # of another law's excess the effect has no second one
    sticking = found.laws[1].found
    assert {term.variant for fit in sticking.fits for term in fit.explanation.terms} == {0}
    # whether there is any effect stays for the simulator's own law to say
    assert np.logaddexp.reduce(found.scores) == pytest.approx(np.logaddexp.reduce(alone.scores))
    assert found.null.sse == pytest.approx(alone.null.sse)


def covers(estimate: ParameterEstimate, truth: float) -> bool:
    low, high = np.asarray(estimate.ci90, float)
    return bool(low <= truth <= high)
