"""Windows that are lost or that nothing explains are found, counted, and decide nothing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import spatial_cases as cases
from cablejax.diagnose.fit import evaluate
from cablejax.diagnose.protocol import explanation
from cablejax.simulate.rod import Rod
from cablejax.spatial.accidents import accident_sentences, compared, kept, moderated, off, trust
from cablejax.spatial.cable import SpatialCable, errors
from cablejax.spatial.identify import layout_of
from cablejax.spatial.search import Step, falls, search
from cablejax.spatial.windows import windows_of

_GROUP = np.repeat(np.arange(6), 4)
_USUAL = 4e-3 * np.linspace(0.8, 1.2, 24)


def test_few_windows_that_are_off_decide_nothing():
    after = 0.9 * _USUAL
    after[7] = 0.508
    assert after.mean() > 2 * _USUAL.mean()
    assert falls(_USUAL, after, _GROUP)[0]
    assert off(after).sum() == 1 and not kept(off(after))[7] and moderated(after).mean() < 1.5 * _USUAL.mean()
    # nor do they let in what makes all others worse
    assert not falls(after, 1.1 * _USUAL, _GROUP)[0]


def test_many_windows_that_are_off_count_as_they_are():
    after = 0.9 * _USUAL
    after[::5] = 0.5
    assert not falls(_USUAL, after, _GROUP)[0]
    assert kept(off(after)).all() and (trust(after) == 1).all()


def test_an_effect_whose_simulations_are_lost_is_not_judged():
    some, many = _USUAL.copy(), _USUAL.copy()
    some[3], many[::5] = 0.6, 1.0
    assert compared(_USUAL, some)[1] and not compared(_USUAL, many)[1]
    # what was off before is nothing that the effect did
    assert compared(many, many)[1]


def test_trust_is_full_but_for_few_windows_that_are_off():
    error = _USUAL.copy()
    assert (trust(error) == 1).all()
    error[2] = 100 * np.median(error)
    assert trust(error)[2] == pytest.approx(0.01, rel=0.1) and (np.delete(trust(error), 2) == 1).all()


@pytest.mark.parametrize("counts", [True, False])
def test_the_budget_of_failures_counts_what_could_be_judged(monkeypatch, counts):
    windows = windows_of(cases.recording())
    cable = SpatialCable(Rod(8, 1, twisting=False), layout_of(windows, cases.NOMINAL), windows)
    names = [effect.name for effect in cable.effects[:4]]
    null = explanation()
    begun = [Step("", True, (null, null), np.full(len(windows), 0.01), 0.0)]
    monkeypatch.setattr("cablejax.spatial.search._starts", lambda cable, halves, effect: ((null, null), 0.0))
    monkeypatch.setattr(
        "cablejax.spatial.search.tried_with",
        lambda cable, name, starts, before, progress: Step(name, False, (null, null), before.error, 0.0, counts),
    )
    assert len(search(cable, names, begun=begun)) == 1 + (2 if counts else 4)


@pytest.fixture(scope="module")
def with_a_lost_window():
    """Windows of which the second has a clamp that is nowhere from its 41st sample on."""
    windows = windows_of(cases.recording())
    position = windows.position.copy()
    position[1, 40:, 1] = np.nan
    whole = SpatialCable(Rod(8, 1, twisting=False), layout_of(windows, cases.NOMINAL), windows)
    return whole, whole.on(dataclasses.replace(windows, position=position))


def test_a_lost_window_is_marked_and_leaves_the_others_alone(with_a_lost_window):
    whole, broken = with_a_lost_window
    one = explanation((whole.layout.named("bending_stiffness"), 0, (2.0,)))
    expected, found = whole.motion(one), broken.motion(one)
    np.testing.assert_array_equal(np.delete(found, 1, 0), np.delete(expected, 1, 0))
    assert np.isnan(found[1, 40:]).all()
    np.testing.assert_array_equal(found[1, :36], expected[1, :36])
    assert off(errors(found, broken.windows)).tolist() == [False, True, False, False]


def test_a_lost_window_does_not_move_a_fit(with_a_lost_window):
    whole, broken = with_a_lost_window
    one = explanation((whole.layout.named("bending_stiffness"), 0, (2.0,)))
    (expected,), (found,) = (evaluate(cable.evidence(), [one]) for cable in with_a_lost_window)
    assert np.isfinite(found.gradient).all() and np.isfinite(found.sse).all()
    np.testing.assert_allclose(np.delete(found.gradient, 1, 0), np.delete(expected.gradient, 1, 0))
    # with trust by its error, what is left of the lost window weighs little
    doubted = broken.on(dataclasses.replace(broken.windows, trust=np.array([1.0, 1e-3, 1.0, 1.0])))
    weights = doubted.evidence().weight(found.sse)
    assert weights[1] < 2e-3 * weights[0]


def test_the_reader_learns_which_windows_and_what_was_done_with_them(with_a_lost_window):
    windows = with_a_lost_window[0].windows.chosen([0, 1, 2, 3] * 6)
    lost, error = np.zeros(24, bool), _USUAL.copy()
    lost[5], error[5], error[6] = True, 0.7, 0.3
    first, second = accident_sentences(lost, error, windows)
    assert "1 of 24 windows could not be simulated" in first and "(700 mm)" in first and "left out" in first
    assert "1 of 24 windows are off" in second and "(300 mm)" in second
    (many,) = accident_sentences(np.arange(24) < 8, _USUAL, windows)
    assert "too many to be left out" in many and "and 3 more" in many
    assert accident_sentences(np.zeros(24, bool), _USUAL, windows) == []
