"""Other laws of a simulator: the recording says which it fits, and intervals are over all of them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cablejax.diagnose import Calibration, explanation
from cablejax.diagnose.belief import log_scores
from cablejax.diagnose.conclude import Conclusion, conclude
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


def recorded(*, carried: bool) -> Evidence:
    """Rougher tables than believed, under grippers that carry the cable's ends or not."""
    facts = evidence(FRICTION, noise_mm=NOISE_MM)
    if not carried:
        return facts
    law = facts.simulator.other_laws[CARRIED]
    points = law.predict([explanation(*parts(FRICTION))], facts.episodes)[0]
    return dataclasses.replace(facts, observed=points + noise(points.shape, NOISE_MM, 0))


def concluded(facts: Evidence) -> tuple[Conclusion, tuple[Law, ...]]:
    calibration = Calibration(baseline=1e-4)
    starts = [explanation(), explanation(*parts(FRICTION)), explanation(*parts(("bending_stiffness", (0.5,))))]
    fits = improve(facts, evaluate(facts, starts), max_iterations=10)
    scores = log_scores(fits, facts, calibration)
    order = np.argsort(-scores)
    found = Search(tuple(fits[i] for i in order), scores[order], {})
    laws = by_other_laws(found, facts, calibration)
    return conclude(found, facts, calibration, laws), laws


@pytest.mark.parametrize("carried", [False, True])
def test_the_recording_says_which_law_it_fits(carried):
    """By the other one alone the friction comes out wrong; over both laws its interval holds."""
    conclusion, laws = concluded(recorded(carried=carried))
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


def covers(estimate: ParameterEstimate, truth: float) -> bool:
    low, high = np.asarray(estimate.ci90, float)
    return bool(low <= truth <= high)
