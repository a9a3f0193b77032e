"""The noise floor: what is put into a recording comes out again."""

import dataclasses
import re

import numpy as np
import pytest
from scipy.signal import lfilter

from cablejax.diagnose import explanation, planar_run
from cablejax.diagnose.belief import Calibration
from cablejax.diagnose.case import Case, calibrated
from cablejax.diagnose.caveats import caveats_of, rarely_left, silent_motions
from cablejax.diagnose.conclude import Conclusion
from cablejax.diagnose.diagnosis import NamedEffect
from cablejax.diagnose.fit import Fit
from cablejax.diagnose.noise import SMALLEST, _rounding, noise_floor, still
from cablejax.diagnose.planar_run import _worth_naming
from cablejax.diagnose.playback import Playback
from diagnose_cases import evidence, holds, log_of, parts, poses, record

EPISODES, SAMPLES, POINTS = 4, 300, 13


def moving(seed: int = 0) -> np.ndarray:
    """Points on a straight line that sways, without noise [m]."""
    t = 0.1 * np.arange(SAMPLES)
    x = np.linspace(0, 1, POINTS)[None] + 0.1 * np.sin(0.5 * t + seed)[:, None]
    y = 0.2 * np.sin(0.3 * t)[:, None] * np.linspace(0, 1, POINTS)[None]
    return np.stack([np.stack([x, y], axis=-1)] * EPISODES)


def held(begin: int = 100, end: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """The same, at rest from `begin` to `end`, and the flags."""
    index = np.arange(SAMPLES)
    index = np.where(index < begin, index, np.where(index < end, begin, index - (end - begin)))
    flags = np.zeros((EPISODES, SAMPLES), bool)
    flags[:, begin:end] = True
    return moving()[:, index], flags


def white(std: float, seed: int = 0) -> np.ndarray:
    return std * np.random.default_rng(seed).normal(size=(EPISODES, SAMPLES, POINTS, 2))


def coloured(std: float, rho: float, seed: int = 0) -> np.ndarray:
    """First-order autoregressive noise of that standard deviation."""
    drive = white(std * np.sqrt(1 - rho**2), seed)
    drive[:, 0] /= np.sqrt(1 - rho**2)
    return lfilter([1.0], [1.0, -rho], drive, axis=1)


def test_white_noise_is_found_in_holds():
    points, flags = held()
    floor = noise_floor(points + white(7e-4), flags)
    assert floor.from_holds
    np.testing.assert_allclose(floor.std, 7e-4, rtol=0.04)
    assert np.ptp(floor.std) == 0, "keypoints share one level unless one stands out"
    assert np.abs(floor.correlation).max() < 0.06


def test_correlation_in_time_is_found_in_holds():
    points, flags = held()
    floor = noise_floor(points + coloured(7e-4, 0.6), flags)
    assert floor.from_holds
    np.testing.assert_allclose(floor.std, 7e-4, rtol=0.1)
    # a line is taken out of each hold, and a little of slow noise with it
    np.testing.assert_allclose(floor.correlation[:3], [0.6, 0.36, 0.216], atol=0.08)


def short_holds() -> tuple[np.ndarray, np.ndarray]:
    """The same with holds of 16 samples, and the flags."""
    flags = np.zeros((EPISODES, SAMPLES), bool)
    for begin in range(0, SAMPLES - 16, 32):
        flags[:, begin : begin + 16] = True
    index = np.arange(SAMPLES)
    return moving()[:, np.where(index % 32 < 16, index - index % 32, index)], flags


@pytest.mark.parametrize("rho", [0.5, 0.7, 0.85])
def test_what_a_line_takes_from_slow_noise_in_short_holds_is_given_back(rho):
    points, flags = short_holds()
    floor = noise_floor(points + coloured(7e-4, rho), flags)
    np.testing.assert_allclose(floor.std, 7e-4, rtol=0.12)
    np.testing.assert_allclose(floor.correlation[0], rho, atol=0.06)


def test_a_cable_that_comes_to_rest_in_short_holds_is_no_slow_noise():
    points, flags = short_holds()
    settling = 5e-3 * np.exp(-(np.arange(SAMPLES) % 32) / 4.0)
    with_creep = noise_floor(points + settling[:, None, None] + white(7e-4), flags)
    about_lines = [
        settling[b : b + 16] - np.polyval(np.polyfit(range(16), settling[b : b + 16], 1), range(16))
        for b in range(0, SAMPLES - 16, 32)
    ]
    added = np.sum(np.square(about_lines)) / (len(about_lines) * 14)
    np.testing.assert_allclose(with_creep.std, np.sqrt(7e-4**2 + added), rtol=0.06)


def test_a_cable_that_snaps_in_one_hold_adds_no_noise():
    points, flags = short_holds()
    snapping = points + white(7e-4)
    snapping[1, 70:, :, 1] += 0.1
    floor = noise_floor(snapping, flags)
    np.testing.assert_allclose(floor.std, 7e-4, rtol=0.06)
    assert floor.from_holds and floor.restless == 1
    assert noise_floor(points + white(7e-4), flags).restless == 0


def test_correlated_noise_is_not_sharpened_by_differences():
    """Third differences see only the fast part of slow noise: half of it here."""
    points, flags = held()
    noisy = points + coloured(7e-4, 0.8)
    assert noise_floor(noisy, flags).std[0] > 5.5e-4 > noise_floor(noisy, None).std[0]


@pytest.mark.parametrize("flags", [None, np.zeros((EPISODES, SAMPLES), bool)], ids=["no flags", "never held"])
def test_without_holds_the_noise_is_taken_to_be_white(flags):
    floor = noise_floor(moving() + white(7e-4), flags)
    assert not floor.from_holds
    np.testing.assert_allclose(floor.std, 7e-4, rtol=0.04)
    np.testing.assert_array_equal(floor.correlation, 0.0)


def test_a_hold_too_short_tells_nothing():
    points, flags = held(100, 108)
    assert not noise_floor(points + white(7e-4), flags).from_holds


@pytest.mark.parametrize("std", [2e-4, 2e-3])
def test_motion_between_samples_a_second_apart_is_no_noise(std):
    """Third differences of such samples are motion; holds of three samples show the level."""
    points, flags = short_holds()
    seldom, flags = (points + white(std))[:, ::5], flags[:, ::5]
    assert noise_floor(seldom, None).std[0] > 1.5 * std
    floor = noise_floor(seldom, flags)
    assert floor.from_holds and not floor.correlation.any()
    np.testing.assert_allclose(floor.std, std, rtol=0.05)


@pytest.mark.parametrize("with_holds", [True, False])
def test_one_noisier_keypoint_has_its_own_level(with_holds):
    points, flags = held()
    noise = white(7e-4)
    noise[:, :, 5] *= 3
    std = noise_floor(points + noise, flags if with_holds else None).std
    others = np.delete(std, 5)
    assert std[5] == pytest.approx(2.1e-3, rel=0.08)
    np.testing.assert_allclose(others, 7e-4, rtol=0.25)
    assert std[5] > 2.2 * others.max()


def test_a_noisier_keypoint_does_not_raise_the_others():
    points, flags = held()
    noise = white(7e-4)
    noise[:, :, 5] *= 3
    np.testing.assert_allclose(np.delete(noise_floor(points + noise, flags).std, 5), 7e-4, rtol=0.1)


def test_noise_scales_with_the_recording():
    points, flags = held()
    single, double = (noise_floor(points + k * white(7e-4), flags) for k in (1, 2))
    # the jerks with which the motion stops and starts do not scale
    np.testing.assert_allclose(double.std, 2 * single.std, rtol=0.01)


def test_missing_keypoints_do_not_change_the_level():
    points, flags = held()
    noisy = points + white(7e-4)
    noisy[np.random.default_rng(1).random(noisy.shape[:3]) < 0.2] = np.nan
    floor = noise_floor(noisy, flags)
    assert floor.from_holds
    np.testing.assert_allclose(floor.std, 7e-4, rtol=0.06)


def test_a_cable_that_creeps_in_its_holds_adds_no_noise():
    points, flags = held()
    creep = np.where(flags, np.clip(np.arange(SAMPLES) - 100, 0, 100) * 2e-5, 0.0)
    floor = noise_floor(points + creep[..., None, None] + white(7e-4), flags)
    np.testing.assert_allclose(floor.std, 7e-4, rtol=0.04)


def test_a_cable_that_snaps_adds_no_noise():
    points, flags = held()
    points[:, 250:, 4:9] += 0.05
    np.testing.assert_allclose(noise_floor(points + white(7e-4), flags).std, 7e-4, rtol=0.04)


def test_a_real_motion_adds_no_noise():
    pose = poses("ramp_hold")
    between = np.linspace(0, 1, POINTS)[None, :, None]
    line = pose[:, :1, :2] * (1 - between) + pose[:, 1:, :2] * between
    points = np.stack([line] * EPISODES) + white(5e-4)[:, : len(line)]
    log = log_of(points)
    assert log.hold is not None and holds().any()
    np.testing.assert_allclose(noise_floor(log.keypoints.astype(float), log.hold).std, 5e-4, rtol=0.06)


def test_without_noise_the_least_that_is_believed_is_assumed():
    floor = noise_floor(np.zeros((1, SAMPLES, POINTS, 2)), None)
    np.testing.assert_array_equal(floor.std, SMALLEST)


def test_too_few_observations_are_refused():
    points = np.full((1, SAMPLES, POINTS, 2), np.nan)
    points[:, :10] = white(1e-3)[:1, :10]
    with pytest.raises(ValueError, match="expected at least 20"):
        noise_floor(points, None)


def test_holds_in_which_the_grippers_move_are_none():
    """Wrong flags would take the motion for noise, and hide any gap."""
    pose = np.stack([poses(motion, SAMPLES) for motion in ("approach", "mirror", "translation", "ramp_hold")])
    everywhere = np.ones((EPISODES, SAMPLES), bool)
    kept = still(everywhere, pose, 1.0)
    np.testing.assert_array_equal(still(everywhere, 0.25 * pose, 0.25), kept)
    keypoints = moving() + white(1e-3)
    assert kept.mean() < 0.5 and noise_floor(keypoints, everywhere).std.max() > 0.01
    np.testing.assert_allclose(noise_floor(keypoints, still(everywhere, pose, 1.0)).rapid, 1e-3, rtol=0.05)
    rest, flags = held()
    np.testing.assert_array_equal(still(flags, np.repeat(rest[:, :, :2, :1], 3, axis=-1), 1.0), flags)
    # a gripper that lags arrives within a hold
    late = np.zeros((1, 60, 2, 3))
    late[0, :3, 0, 0] = [0.015, 0.01, 0.005]
    assert still(np.ones((1, 60), bool), late, 1.0).all()


def test_keypoints_that_are_seen_in_every_third_sample_only():
    keypoints = moving() + white(1e-3)
    keypoints[:, np.arange(SAMPLES) % 3 != 0] = np.nan
    np.testing.assert_allclose(noise_floor(keypoints, None).std, 1e-3, rtol=0.1)


def test_caveats_on_holds_that_are_none():
    log = record()
    assert not caveats_of(Case.of(log), Calibration(), None, 0.0, commissioned=True)
    (text, *_) = Case.of(dataclasses.replace(log, hold=np.ones_like(log.hold))).recording.caveats
    assert re.match(r"\d+ of 400 samples are marked as holds although the grippers move", text)
    creeping = np.array(log.keypoints)
    creeping[:, :, 3:10, 1] += 0.004 * np.sin(0.9 * np.arange(creeping.shape[1]))[None, :, None]
    texts = caveats_of(
        Case.of(dataclasses.replace(log, keypoints=creeping)), Calibration(), None, 0.0, commissioned=True
    )
    assert any("while the grippers rest, and by" in text for text in texts)


def test_what_the_simulator_may_be_off_by_grows_with_the_cable():
    assert calibrated(1.0) == Calibration()
    for length in (3.0, 0.25):
        assert calibrated(length).baseline == pytest.approx(length * Calibration.baseline)
    assert calibrated(0.05).baseline == SMALLEST


def test_what_stated_numbers_may_be_off_by_is_small_unless_the_cable_is_soft():
    log = record()
    case = Case.of(log)
    assert 0 < case.stated_error() < 0.1 * Calibration.baseline
    cable = {**log.meta["cable"], "bending_stiffness_n_m2": 4e-4, "linear_density_kg_per_m": 0.1}
    rope = Case.of(dataclasses.replace(log, meta={**log.meta, "cable": cable}))
    stated = rope.stated_error()
    # the same from predictions under each change alone
    playback, off = rope.simulator.playback, []
    for name in ("stiffness", "friction"):
        high, low = (
            playback.keypoints(
                [dataclasses.replace(playback.believed, **{name: factor * getattr(playback.believed, name)})]
            )
            for factor in (1.01, 0.99)
        )
        off.append(np.mean((high - low)[0] ** 2, axis=(1, 2, 3)) / 4)
    assert stated == pytest.approx(np.sqrt(np.median(sum(off))), rel=1e-3) and stated > 10 * case.stated_error()
    texts = caveats_of(rope, Calibration(), None, 1e-3, commissioned=True)
    assert any("1 % more or less stiffness or friction" in text and "1 mm per coordinate" in text for text in texts)


def test_simulations_that_break_down_do_not_count_in_what_stated_numbers_may_be_off_by(monkeypatch):
    case, again = Case.of(record()), Case.of(record())
    whole, keypoints = case.stated_error(), Playback.keypoints

    def broken(self, physics):
        points = keypoints(self, physics)
        points[1, 2, 50:] = np.nan
        return points

    monkeypatch.setattr(Playback, "keypoints", broken)
    assert again.stated_error() == pytest.approx(whole, rel=0.5)


def test_the_simulator_may_be_further_off_where_small_errors_grow(monkeypatch):
    """By as many times as an error of the clamps' angles moves the cable more than in the median motion."""
    case, keypoints = Case.of(record()), Playback.keypoints

    def snapping(self, physics):
        points = keypoints(self, physics)
        askew = np.array([one.rotation_offset.any() for one in physics])
        middle = points.mean(axis=0, keepdims=True)
        points[:, 1] = np.where(askew[:, None, None, None], middle + 20.0 * (points - middle), points)[:, 1]
        return points

    usual = case.evidence(Calibration())
    assert usual.own_error is not None and usual.own_error.max() < 1.6 * Calibration.baseline
    monkeypatch.setattr(Playback, "keypoints", snapping)
    own = (grown := Case.of(record()).evidence(Calibration())).own_error
    assert own is not None and 10 < own[1] / Calibration.baseline < 30
    np.testing.assert_allclose(np.delete(own, 1), np.delete(usual.own_error, 1), rtol=0.3)
    # and such a motion counts less in every fit
    assert grown.temper[1] > 10 * usual.temper[1]


def test_explains_again_where_small_errors_grow_under_the_best_explanation(monkeypatch):
    """Until the evidence is weighed by the growth under what explains it; calm motions count as before."""
    case, soft = Case.of(record()), explanation(*parts(("bending_stiffness", [0.1])))
    measured, seen = Case.growth, []

    def growth(self, cause):
        return measured(self, cause) * (np.array([1.0, 8.0, 1.0, 1.0]) if cause.terms else 1.0)

    def explain(facts, calibration, *, progress):
        seen.append(facts)
        return None, Conclusion("named", Fit(soft, np.zeros(4), np.zeros((4, 1)), np.zeros((4, 1, 1))), (), (), (), 0.0)

    monkeypatch.setattr(Case, "growth", growth)
    monkeypatch.setattr(planar_run, "explain", explain)
    planar_run._explained(case, Calibration(), lambda text: None)
    once, twice = seen
    assert 6 < twice.own_error[1] / once.own_error[1] < 20
    np.testing.assert_allclose(np.delete(twice.own_error, 1), np.delete(once.own_error, 1), rtol=0.5)
    monkeypatch.setattr(Case, "growth", measured)
    planar_run._explained(case, Calibration(), lambda text: None)
    assert len(seen) == 3


def test_a_motion_that_is_no_evidence_of_a_gap_is_reported():
    """By a verdict of "none" only; the other motions count as ever."""
    facts = evidence(noise_mm=0.5)
    own, off = np.full(4, 3.5e-4), np.zeros(4)
    own[2], off[2] = 0.05, 0.054
    facts = dataclasses.replace(facts, own_error=own)
    fit = Fit(explanation(), facts.count * (1.0 + (off / 5e-4) ** 2), np.zeros((4, 0)), np.zeros((4, 0, 0)))
    none = Conclusion("none", fit, (), (), (), 0.0)
    (text,) = silent_motions(facts, none, Calibration())
    assert text.startswith(
        "Episode 2 is no evidence for or against a gap: the nominal simulator misses the cable by 54 mm"
    )
    assert "may be off by 50 mm there without any effect" in text
    assert not list(silent_motions(facts, dataclasses.replace(none, verdict="unknown"), Calibration()))
    calm = dataclasses.replace(fit, sse=facts.count * 1.0)
    assert not list(silent_motions(facts, dataclasses.replace(none, best=calm), Calibration()))


def test_a_name_that_leaves_more_of_the_gap_than_correct_ones_has_a_caveat():
    """Such as two effects that together resemble a spring that pulls the cable."""
    fit = Fit(explanation(), np.zeros(4), np.zeros((4, 0)), np.zeros((4, 0, 0)))
    named = Conclusion("named", fit, (), (), (), 0.94, leftover_p=5 / 81)
    (text,) = rarely_left(named)
    assert text.startswith("Of the correct explanations on labelled logs, 6 % leave as large a part of the gap as this")
    assert list(rarely_left(dataclasses.replace(named, verdict="ambiguous"))) == [text]
    assert not list(rarely_left(dataclasses.replace(named, leftover_p=0.3)))
    assert not list(rarely_left(dataclasses.replace(named, verdict="named+unknown"))), "the page says how much is left"
    assert not list(rarely_left(Conclusion("none", fit, (), (), (), 0.0)))


def test_what_stands_beside_an_unknown_cause_makes_the_gap_smaller():
    effect = NamedEffect("obstacle", 0.2, {}, {})
    fit = Fit(explanation(), np.zeros(4), np.zeros((4, 0)), np.zeros((4, 0, 0)))
    found = Conclusion("named+unknown", fit, (effect,), (("obstacle", "friction_patch"),), (), 0.3)
    for shrinkage in (None, 0.05):
        assert _worth_naming(found, shrinkage) is found
    for shrinkage in (0.0, -0.5):
        left = _worth_naming(found, shrinkage)
        assert left.verdict == "unknown" and not left.effects and not left.equivalent
    named = dataclasses.replace(found, verdict="named")
    assert _worth_naming(named, -0.5) is named


@pytest.mark.parametrize("holds", [False, True])
def test_a_tracker_that_reports_whole_millimetres_errs_by_their_rounding(holds):
    """At rest it repeats the same number, which is no sign of a tracker without noise."""
    points, flags = held(60, 290)
    coarse = 1e-3 * np.round(points / 1e-3)
    floor = noise_floor(coarse, flags if holds else None)
    assert np.all(floor.std >= 0.999e-3 / np.sqrt(12)) and np.all(floor.std < 5e-4)


def test_numbers_with_all_their_digits_were_not_rounded():
    smooth = np.sin(np.linspace(0, 6, 60))[None, :, None, None]
    seen = smooth + 1e-5 * np.random.default_rng(0).standard_normal(smooth.shape)
    for points in (smooth, seen, np.linspace(0, 1, 60)[None, :, None, None], np.tile(seen[:, :1], (1, 50, 1, 1))):
        assert _rounding(points) == 0.0
    for dtype in (np.float64, np.float32):
        whole = (np.round(1e3 * np.sin(np.linspace(0, 6, 3000))) / 1e3)[None, :, None, None].astype(dtype)
        assert _rounding(whole.astype(float)) == pytest.approx(1e-3 / np.sqrt(12), rel=1e-3)
