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
from cablejax.diagnose.laws import Law, by_other_laws
from cablejax.diagnose.planar import OTHER_LAWS
from cablejax.diagnose.search import Search
from diagnose_cases import CABLE, evidence, noise, parts

FRICTION = ("table_friction", (2.2, 0.0))
NOISE_MM = 0.3
CARRIED, STICKS = OTHER_LAWS


def recorded(*effects: tuple[str, Any], carried: bool) -> Evidence:
    """Under grippers that carry the cable's ends or not."""
    facts = evidence(*effects, noise_mm=NOISE_MM)
    if not carried:
        return facts
    law = facts.simulator.other_laws[CARRIED]
    points = law.predict([explanation(*parts(*effects))], facts.episodes)[0]
    return dataclasses.replace(facts, observed=points + noise(points.shape, NOISE_MM, 0))


def concluded(facts: Evidence, *, laws: bool = True) -> tuple[Conclusion, tuple[Law, ...]]:
    # a simulator that is exact but for its law, so that small gaps count
    calibration = Calibration(baseline=2e-5, noise_share=0.02)
    starts = [explanation(), explanation(*parts(FRICTION)), explanation(*parts(("bending_stiffness", (0.5,))))]
    found = Search.of(improve(facts, evaluate(facts, starts), max_iterations=10), facts, calibration)
    others = by_other_laws(found) if laws else ()
    return conclude(found, others), others


@pytest.mark.parametrize("carried", [False, True])
def test_the_recording_says_which_law_it_fits(carried):
    """By the other one alone the friction comes out wrong; over both laws its interval holds."""
    conclusion, laws = concluded(recorded(FRICTION, carried=carried))
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
    conclusion, (law, _) = concluded(recorded(carried=True))
    assert law.probability > 0.5
    assert conclusion.verdict == "none" and conclusion.effects == ()
    assert conclusion.under_laws[0].verdict == "none" and CARRIED in sentence(conclusion, None)
    alone, _ = concluded(recorded(carried=True), laws=False)
    assert alone.verdict != "none"


def test_a_law_costs_one_verdict_and_no_posterior(monkeypatch):
    """What a verdict would be under a law is stated without draws from all that is left open there."""
    drawn = []
    monkeypatch.setattr("cablejax.diagnose.conclude.posterior", lambda found, *_: drawn.append(found) or ())
    conclusion, laws = concluded(recorded(FRICTION, carried=False))
    assert len(conclusion.under_laws) == len(laws) == 2 and all(under.effects for under in conclusion.under_laws)
    assert len(drawn) == 1 and not any(drawn[0] is law.found for law in laws)


def covers(estimate: ParameterEstimate, truth: float) -> bool:
    low, high = np.asarray(estimate.ci90, float)
    return bool(low <= truth <= high)
