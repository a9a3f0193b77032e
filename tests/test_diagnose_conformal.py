"""The conformal test of what an explanation leaves."""

from __future__ import annotations

import pathlib

import numpy as np
import pytest

from blind.measures import leftovers
from blind.store import checked_labels, read_cases
from blind.verdicts import scored
from cablejax.diagnose import Calibration
from cablejax.diagnose.belief import SCORES, leftover_p, leftover_score

SET = pathlib.Path(__file__).parents[1] / "docs" / "results" / "blind" / "20270404" / "cases.jsonl"


def test_scores_are_those_of_the_stored_blind_check():
    rows = read_cases([SET])
    cases = scored(rows, checked_labels(rows))
    np.testing.assert_allclose(leftovers(cases), SCORES, atol=0.0051)


def test_a_score_like_the_labelled_ones_has_a_uniform_p_value():
    # each score against the others is a draw like them
    others = [1 + sum(o >= s for o in SCORES) for s in SCORES]
    for level in (0.05, 0.1, 0.5):
        assert np.mean(np.array(others) / (len(SCORES) + 1) <= level) <= level + 1 / len(SCORES)
    assert leftover_p(0.0) == 1.0 and leftover_p(9.0) == pytest.approx(1 / 81)


def test_what_is_not_complete_is_seldom_left_by_a_right_explanation():
    calibration, noise = Calibration(), 1e-3
    for gap in (2e-3, 8e-3):
        for left in np.linspace(0.0, gap, 41):
            score = leftover_score(left, gap, noise, calibration)
            assert calibration.complete(left, gap, noise) == (score <= 1.0)
            assert score <= 1.0 or leftover_p(score) <= 3 / 81
