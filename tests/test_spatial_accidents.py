"""Windows that are lost or that nothing explains are found, counted, and decide nothing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import cablejax.spatial.estimate as estimates
import spatial_cases as cases
from cablejax.diagnose.fit import evaluate, improve
from cablejax.diagnose.protocol import explanation
from cablejax.simulate.rod import Rod, RodResult
from cablejax.spatial.accidents import accident_sentences, compared, kept, moderated, off, trust
from cablejax.spatial.cable import SpatialCable, errors, typical_error
from cablejax.spatial.diagnose import diagnose_space
from cablejax.spatial.estimate import starts_from
from cablejax.spatial.growing import beginning
from cablejax.spatial.identify import layout_of
from cablejax.spatial.search import Step, falls, halves, search
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
    names = [effect.name for effect in cable.effects[:6]]
    null = explanation()
    begun = [Step("", True, (null, null), np.full(len(windows), 0.01), 0.0)]
    monkeypatch.setattr("cablejax.spatial.search._starts", lambda cable, first, halves, effect: ((null, null), 0.0))
    monkeypatch.setattr(
        "cablejax.spatial.search.tried_with",
        lambda cable, first, name, starts, before, progress: Step(name, False, (null, null), before.error, 0.0, counts),
    )
    assert len(search(cable, halves(windows.group), names, begun=begun)) == 1 + (4 if counts else 6)


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


@pytest.mark.slow
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
    none = np.zeros(24, bool)
    first, second = accident_sentences(lost, error, windows, none)
    assert "1 of 24 windows could not be simulated" in first and "(700 mm)" in first and "excluded" in first
    assert "1 of 24 windows are off" in second and "(300 mm)" in second
    (many,) = accident_sentences(np.arange(24) < 8, _USUAL, windows, none)
    assert "too many to be excluded" in many and "and 3 more" in many
    assert accident_sentences(none, _USUAL, windows, none) == []
    (coarse,) = accident_sentences(none, _USUAL, windows, np.arange(24) == 4)
    assert "1 of 24 windows have time-step errors above the tolerance" in coarse and "file 0 from 0 s" in coarse


def test_how_each_simulation_ended_is_known(with_a_lost_window):
    _, broken = with_a_lost_window
    one = explanation((broken.layout.named("bending_stiffness"), 0, (2.0,)))
    points, results = broken.rollouts(one)
    assert results[1] == RodResult.UNSOLVED and (np.delete(results, 1) == RodResult.SOLVED).all()
    # no time step is short enough for such a local error
    strict = dataclasses.replace(broken, rod=dataclasses.replace(broken.rod, local_error=1e-9))
    found, results = strict.rollouts(one)
    assert results[1] == RodResult.UNSOLVED and (np.delete(results, 1) == RodResult.COARSE).all()
    assert np.isfinite(np.delete(found, 1, 0)).all() and not np.array_equal(found[0], points[0])


def test_a_window_begins_where_all_keypoints_are_observed():
    log = cases.recording()
    points = log.keypoints.copy()
    points[2, 1, 4] = np.nan
    whole, later = windows_of(log), windows_of(dataclasses.replace(log, keypoints=points))
    assert later.left_out == () and later.begin.tolist() == [0, 0, 2, 0]
    np.testing.assert_array_equal(later.valid.sum(axis=1), whole.valid.sum(axis=1) - [0, 0, 2, 0])
    kept = int(later.valid[2].sum())
    np.testing.assert_array_equal(later.keypoints[2, :kept], whole.keypoints[2, 2 : kept + 2])


def test_windows_that_never_show_all_keypoints_are_counted():
    log = cases.recording()
    points = log.keypoints.copy()
    points[2, np.arange(points.shape[1]) % 5 > 0, 4] = np.nan
    windows = windows_of(dataclasses.replace(log, keypoints=points))
    assert windows.name == ("0", "1", "3") and windows.left_out == ("file 2 from 0 s",)
    error, none = np.full(3, 0.004), np.zeros(3, bool)
    (sentence,) = accident_sentences(none, error, windows, none)
    assert (
        sentence.startswith("1 more windows were left out, since none of their seconds begins")
        and "file 2 from 0 s." in sentence
    )
    assert windows_of(log).left_out == ()


def test_markers_that_are_often_hidden_for_a_moment_leave_a_window_where_it_begins():
    log = cases.recording()
    whole, points = windows_of(log), log.keypoints.copy()
    for k in range(2, 8):
        points[:, 1 + (k % 3) : -1 : 3, k] = np.nan
    windows = windows_of(dataclasses.replace(log, keypoints=points))
    assert windows.begin.tolist() == [0, 0, 0, 0] and windows.left_out == ()
    np.testing.assert_allclose(windows.keypoints[:, :2], whole.keypoints[:, :2], atol=5e-4)
    assert np.isnan(windows.observed[:, 2:]).any()


def test_what_is_shorter_than_a_window_is_said():
    log = cases.recording()
    length = log.episode_length.copy()
    length[0] = 40
    windows = windows_of(dataclasses.replace(log, episode_length=length))
    error, none = np.full(3, 0.004), np.zeros(3, bool)
    (sentence,) = accident_sentences(none, error, windows, none)
    assert sentence.startswith("12 % of the samples are in episodes, or ends of episodes, shorter than 1 s")
    with pytest.raises(ValueError, match=r"The longest episode is 0.78 s long, expected at least 1 s\. Record longer"):
        windows_of(dataclasses.replace(log, episode_length=np.full_like(length, 40)))


def torn(episodes: int = 4):
    """A log whose gripper 1 is 0.6 m too far away in episode 1, from 0.8 s to 1.0 s: longer than a misreading."""
    log = cases.recording(episodes)
    points, pose = log.keypoints.copy(), log.gripper_pose.copy()
    points[1, 40:50, -2:, 0] += 0.6
    pose[1, 40:50, 1, 0] += 0.6
    return dataclasses.replace(log, keypoints=points, gripper_pose=pose)


def test_grippers_that_tear_the_cable_are_named():
    windows = windows_of(torn())
    assert windows.torn.tolist() == [False, True, False, False]
    assert windows.trust[1] < 0.02 and (np.delete(windows.trust, 1) == 1).all()
    assert 1 not in windows.whole(24) and len(windows.whole(24)) == 3
    cable = SpatialCable(Rod(8, 1, twisting=False), layout_of(windows, cases.NOMINAL), windows)
    trusted = cable.trusting(np.full(4, 0.004)).windows.trust
    assert trusted is not None and trusted[1] == windows.trust[1]
    none = np.zeros(4, bool)
    (sentence,) = accident_sentences(none, np.full(4, 0.004), windows, none)
    assert sentence.startswith("1 of 4 windows have the grippers further apart than the 0.9 m")
    assert "file 1 at 0.8" in sentence and "tear" in sentence
    # as far apart as the cable is long is nothing
    assert not windows_of(cases.recording()).torn.any() and (windows_of(cases.recording()).trust == 1).all()


@pytest.mark.slow
def test_what_is_not_torn_is_diagnosed():
    found = diagnose_space(torn(10), only=["bending_stiffness", "bending_damping"])
    assert {effect.name for effect in found.effects} == {"bending_stiffness", "bending_damping"}
    assert found.gap.shrinkage is not None and found.gap.shrinkage > 0.9
    assert any("1 of 10 windows have the grippers further apart" in text for text in found.caveats)
    assert 1 not in found.gap.held_out_episodes


@pytest.mark.slow
def test_the_fit_to_all_begins_where_it_is_simulated_best(monkeypatch):
    windows = windows_of(cases.recording())
    cable = SpatialCable(Rod(8, 1, twisting=False), layout_of(windows, cases.NOMINAL), windows)
    names = ("bending_stiffness", "bending_damping")

    def one(*values):
        return explanation(*((cable.layout.named(n), 0, (v,)) for n, v in zip(names, values, strict=True)))

    good, stray = one(cases.TRUE_RATIO, cases.TRUE_DAMPING), one(0.02, 2.0)
    starts, begun = starts_from(stray, good), []
    assert np.argmin([typical_error(cable.evidence(), start) for start in starts]) == 2

    def spied(evidence, fits, **options):
        begun.extend(fits)
        return improve(evidence, fits, **options)

    monkeypatch.setattr(estimates, "improve", spied)
    estimates.estimate(cable, starts, names)
    np.testing.assert_array_equal(begun[0].explanation.z, beginning(cable, [good]).z)


def test_a_fit_that_does_not_settle_ends_and_says_so(monkeypatch):
    windows = windows_of(cases.recording())
    cable = SpatialCable(Rod(8, 1, twisting=False), layout_of(windows, cases.NOMINAL), windows)
    start = explanation((cable.layout.named("bending_stiffness"), 0, (cases.TRUE_RATIO,)))
    (fit,) = evaluate(cable.evidence(), [start])
    error = np.hypot(*(np.linalg.norm(rows) for rows in estimates.sources(cable.evidence(), fit)))
    rounds = []
    monkeypatch.setattr(estimates, "beginning", lambda cable, starts: starts[0])

    def to_and_fro(evidence, fits, **options):
        rounds.append(fits)
        sign = (-1) ** len(rounds)
        return evaluate(evidence, [start.moved(start.z + 0.25 * sign * error, start.own)])

    monkeypatch.setattr(estimates, "improve", to_and_fro)
    found = estimates.estimate(cable, [start], start.names)
    # by a quarter of a standard error the first time, which is settled, so one that does not begin there
    assert found.settled and len(rounds) == 1
    rounds.clear()
    begun = start.moved(start.z + 0.25 * error, start.own)
    found = estimates.estimate(cable, [begun], start.names)
    assert not found.settled and len(rounds) == 2
