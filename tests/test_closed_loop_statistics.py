"""Statistics of trials against textbook values, other implementations, and their own promises."""

import math

import numpy as np
import pytest

from closed_loop.paper import LIANG, METHOD_LABEL, PAPER, best_in_paper
from closed_loop.statistics import mean_interval, paired_difference, summarise


def test_failures_are_counted_and_rank_last():
    cell = summarise([1.0, math.inf, 3.0, math.nan, 2.0])
    assert (cell.count, cell.failures, cell.mean, cell.std) == (5, 2, 2.0, 1.0)
    assert cell.median == 3.0 and cell.worst == math.inf
    none = summarise([math.inf, math.nan])
    assert none.failures == 2 and math.isnan(none.mean) and math.isnan(none.std) and none.median == math.inf
    assert summarise([2.0]).std == 0.0
    with pytest.raises(ValueError, match="at least one"):
        summarise([])


@pytest.mark.parametrize(("count", "draw", "mean"), [(30, "exponential", 1.0), (5, "normal", 0.0)])
def test_an_interval_covers_the_mean_about_as_often_as_it_says(count, draw, mean):
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(200):
        interval = mean_interval(getattr(rng, draw)(size=count))
        hits += interval.low <= mean <= interval.high
    assert 0.88 <= hits / 200 <= 0.99  # 0.95 asked for; BCa at n = 30 on exponentials is a few per cent short


def test_an_interval_of_few_values():
    assert math.isnan(mean_interval([1.0]).low)
    same = mean_interval([2.0, 2.0, 2.0])
    assert (same.low, same.high) == (2.0, 2.0)
    with pytest.raises(ValueError, match="1 of 2 values are not finite"):
        mean_interval([1.0, math.inf])
    with pytest.raises(ValueError, match="confidence"):
        mean_interval([1.0, 2.0], confidence=1.0)


def test_pairing_removes_what_trials_share():
    rng = np.random.default_rng(0)
    hard = rng.uniform(0, 10, 20)  # some trials are hard for everybody
    method = {seed: hard[seed] + 0.01 * rng.standard_normal() for seed in range(20)}
    reference = {seed: hard[seed] + 0.1 + 0.01 * rng.standard_normal() for seed in range(20)}
    result = paired_difference(method, reference)
    assert result.mean == pytest.approx(-0.1, abs=0.01)
    assert -0.12 < result.interval.low < result.interval.high < -0.08
    assert (result.pairs, result.unpaired, result.failures, result.better, result.worse) == (20, 0, 0, 20, 0)


def test_pairs_with_failures_are_won_and_lost_but_not_averaged():
    method = {0: 1.0, 1: math.inf, 2: math.nan, 3: 2.0, 9: 1.0}
    reference = {0: 2.0, 1: 1.0, 2: math.inf, 3: math.inf, 8: 1.0}
    result = paired_difference(method, reference)
    assert (result.pairs, result.unpaired, result.failures) == (4, 2, 3)
    assert (result.mean, result.better, result.worse) == (-1.0, 2, 1)
    assert math.isnan(paired_difference({0: math.inf}, {0: 1.0}).mean)


def test_trials_of_one_seed_are_one_cluster():
    """Five copies of every trial must not make the interval narrower."""
    rng = np.random.default_rng(1)
    once = {(0, seed): rng.standard_normal() for seed in range(8)}
    copied = {(k, seed): once[0, seed] for k in range(5) for seed in range(8)}
    zero = dict.fromkeys(copied, 0.0)
    clustered = paired_difference(copied, zero, cluster=lambda key: key[1])
    alone = paired_difference(once, zero).interval
    assert (clustered.interval.low, clustered.interval.high) == pytest.approx((alone.low, alone.high))
    naive = paired_difference(copied, zero)
    assert naive.interval.high - naive.interval.low < 0.7 * (clustered.interval.high - clustered.interval.low)


def test_the_paper_is_complete():
    assert {table: {m: tuple(row) for m, row in rows.items()} for table, rows in PAPER.items()} == {
        "III": dict.fromkeys(METHOD_LABEL, ("U", "S", "Z")),
        "IV": dict.fromkeys(METHOD_LABEL, ("U", "S")),
        "V": dict.fromkeys(METHOD_LABEL, ("U", "S")),
    }
    assert [best_in_paper("III", s, "terminal") for s in "USZ"] == [0.42, 0.57, 0.78]
    assert [(p.successes, p.error_mm) for p in LIANG[:2]] == [(47, 1.7), (43, 2.2)]
    with pytest.raises(ValueError, match="table 'IV'"):
        best_in_paper("IV", "Z", "terminal")
