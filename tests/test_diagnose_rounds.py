"""Several recordings of one set-up: what each adds, and whether they contradict one another."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from cablejax.diagnose import Calibration
from cablejax.diagnose.evidence import Evidence
from cablejax.diagnose.fit import evaluate, improve
from cablejax.diagnose.protocol import explanation
from cablejax.diagnose.rounds import Rounds, rounds_of
from cablejax.diagnose.search import Search
from diagnose_cases import clean, evidence_of, log_of, parts

SOFT: tuple[Any, ...] = ("bending_stiffness", 0, (0.5,))
RUBBED: tuple[Any, ...] = ("table_friction", 0, (2.5, 0.0))
CALIBRATION = dataclasses.replace(Calibration(), set_odds=0.0)
N_LINKS = 17


def _mixed(*effects) -> Evidence:
    """Two recordings of two episodes, each with its own effects."""
    points = [clean(one, n_links=N_LINKS) for one in effects]
    points = np.concatenate([points[0][:2], points[1][2:]])
    return dataclasses.replace(evidence_of(points, n_links=N_LINKS), freedom=6.0, temper=np.full(4, 20.0))


def _rounds(evidence: Evidence) -> tuple[Rounds, np.ndarray]:
    """The rounds of two recordings, and the scores of the explanations, best first."""
    starts = [explanation(*parts(one)) for one in (SOFT, RUBBED)]
    fits = improve(evidence, evaluate(evidence, [explanation(), *starts]), 12)
    found = Search.of(fits, evidence, CALIBRATION)
    log = log_of(evidence.observed)
    log = dataclasses.replace(
        log, meta={**log.meta, "recordings": [{"name": "a", "episodes": 2}, {"name": "b", "episodes": 2}]}
    )
    rounds = rounds_of(log, found)
    assert rounds is not None
    return rounds, found.scores


@pytest.fixture(scope="module")
def alike() -> tuple[Rounds, np.ndarray]:
    return _rounds(_mixed(SOFT, SOFT))


def test_nats_add_up_to_the_odds(alike):
    rounds, scores = alike
    assert len(rounds.rounds) == 2 and set(rounds.rounds[0].nats) == {"bending_stiffness", "table_friction", "nominal"}
    last = rounds.rounds[-1].probability
    expected = np.exp(scores - scores.max())
    np.testing.assert_allclose(list(last.values()), expected / expected.sum(), atol=1e-9)
    for name in ("table_friction", "nominal"):
        cost = Calibration().term_cost if name == "nominal" else 0.0
        added = sum(one.nats[name] for one in rounds.rounds)
        leader = "bending_stiffness"
        assert added + cost == pytest.approx(np.log(last[name] / last[leader]), abs=1e-6)


def test_the_only_explanation_left_is_compared_with_a_rejected_one(alike, monkeypatch):
    """Else nothing would show which recording decided."""
    monkeypatch.setattr(Search, "in_doubt", lambda found: (found.fits[:1], np.ones(1)))
    rounds, _ = _rounds(_mixed(SOFT, SOFT))
    assert list(rounds.rounds[0].nats) == ["bending_stiffness", "table_friction"]
    assert rounds.rounds[1].nats == {name: alike[0].rounds[1].nats[name] for name in rounds.rounds[1].nats}


def test_one_set_up_does_not_contradict_itself(alike):
    rounds, _ = alike
    assert next(iter(rounds.rounds[0].nats)) == "bending_stiffness"
    assert not rounds.contradictory


def test_a_recording_that_shows_nothing_gains_nothing_of_its_own():
    """Its prior alone would rather have no effect."""
    facts = _mixed(SOFT, SOFT)
    facts.observed[2:] = np.nan
    rounds, _ = _rounds(facts)
    assert [one.own_gain for one in rounds.rounds] == pytest.approx([0.0, 0.0], abs=0.05)
    assert rounds.contradiction > 0.5


def test_a_cable_that_was_changed_between_two_recordings():
    rounds, _ = _rounds(_mixed(SOFT, ("bending_stiffness", 0, (1.6,))))
    assert rounds.contradictory and (rounds.contradiction or 0.0) < 1e-4


def test_an_effect_in_one_recording_only():
    """Whatever is most probable for both: no effect at all says nothing of how they differ."""
    still = ("bending_stiffness", 0, (1.0,))
    rounds, _ = _rounds(_mixed(("bending_stiffness", 0, (0.3,)), still))
    assert rounds.contradictory
    rounds, scores = _rounds(_mixed(still, still))
    assert next(iter(rounds.rounds[0].nats)) == "nominal" and len(scores) == 3
    assert not rounds.contradictory and rounds.contradiction is not None


def test_a_log_that_was_not_joined_has_no_rounds():
    log = log_of(clean(n_links=N_LINKS))
    evidence = _mixed(SOFT, SOFT)
    assert rounds_of(log, Search.of(evaluate(evidence, [explanation()]), evidence, CALIBRATION)) is None
