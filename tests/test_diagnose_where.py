"""Where a gap lies: sizes and places of gaps that were put there, and no place at all for noise."""

from __future__ import annotations

import dataclasses
import time
import types

import numpy as np
import pytest

from cablejax.diagnose.regimes import largest_curvature
from cablejax.diagnose.significance import LEVEL, contrast_p, variance_inflation
from cablejax.diagnose.where import _bending, localise
from cablejax.diagnose.where_words import describe
from cablejax.types import GapLog
from diagnose_cases import MOTIONS, SAMPLES, arches, log_of, poses

NOISE = 1e-3
POINTS = 13


def case(gap=0.0, motions=MOTIONS, seed=0):
    """A log that deviates by `gap` [m], broadcast to [E, T, N, 2], and its nominal keypoints."""
    nominal = arches(POINTS, motions)
    noise = NOISE * np.random.default_rng(seed).normal(size=nominal.shape)
    return log_of((nominal + gap + noise).astype(np.float32), motions), nominal


def test_noise_alone_is_nowhere():
    for seed in range(20):
        where = localise(*case(seed=seed), np.full(POINTS, NOISE))
        assert min(where.episode_p.min(), where.keypoint_p.min()) > LEVEL
        assert where.gap_mm < where.smallest_mm
        assert where.sentences[0].startswith("No episode deviates")


def test_size_of_a_gap_is_found_with_the_noise_taken_out():
    where = localise(*case(gap=3e-3), np.full(POINTS, NOISE))
    assert where.gap_mm == pytest.approx(3.0, rel=0.02)
    np.testing.assert_allclose(where.along_cable_mm, 3.0, rtol=0.05)
    np.testing.assert_allclose(where.per_episode_mm, 3.0, rtol=0.05)
    assert all(size == pytest.approx(3.0, rel=0.1) for size in where.regimes.values())


def test_place_and_episodes_of_a_gap():
    gap = np.zeros((4, SAMPLES, POINTS, 2))
    gap[[1, 3], 40:, 5:8] = 4e-3
    where = localise(*case(gap), np.full(POINTS, NOISE))
    assert np.flatnonzero(where.episode_p < LEVEL).tolist() == [1, 3]
    assert set(np.argsort(-where.along_cable_mm)[:3]) == {5, 6, 7}
    assert "it shows in only 2 of 4 episodes: episode 1 and episode 3." in where.sentences[0]
    assert "between 0.42 and 0.58 m" in where.sentences[1]
    assert where.horizons_mm[2.0] < 0.3 < 1.0 < where.horizons_mm[10.0]


def test_one_keypoint_that_is_off_is_found_although_no_episode_stands_out():
    gap = np.zeros((POINTS, 2))
    gap[4] = 1.1e-3
    where = localise(*case(gap), np.full(POINTS, NOISE))
    assert where.episode_p.min() >= LEVEL
    assert np.flatnonzero(where.keypoint_p < LEVEL).tolist() == [4]
    assert "too small to show in any single episode" in where.sentences[0]


def test_gap_that_grows_with_motion_differs_from_one_that_remains():
    motions = (*MOTIONS, *(f"back_{motion}" for motion in MOTIONS))
    pose = np.stack([poses(m) for m in motions])[..., :2]
    velocity = np.gradient(pose, 0.1, axis=1).mean(axis=2)
    moving = localise(*case(0.2 * velocity[:, :, None], motions), np.full(POINTS, NOISE))
    ratio, p = moving.contrasts["speed: hold"]
    assert ratio < 0.5 and p < 0.05
    assert any("grows with motion" in sentence for sentence in moving.sentences)
    staying = localise(*case(4e-3, motions), np.full(POINTS, NOISE))
    assert any("not a lag" in sentence for sentence in staying.sentences)
    assert staying.regimes["speed: hold"] == pytest.approx(4.0, rel=0.1)


def test_motions_made_twice_prove_nothing_that_made_once_they_do_not():
    velocity = np.gradient(np.stack([poses(m) for m in MOTIONS])[..., :2], 0.1, axis=1).mean(axis=2)
    gap = 0.2 * np.concatenate([velocity, velocity])[:, :, None]
    twice = localise(*case(gap, MOTIONS * 2), np.full(POINTS, NOISE))
    assert twice.contrasts["speed: hold"][1] > 0.05


def test_rest_before_any_motion_does_not_make_a_gap_one_of_motion():
    motions = MOTIONS * 2
    gap = np.zeros((len(motions), SAMPLES, POINTS, 2))
    gap[:, 40:] = 4e-3
    where = localise(*case(gap, motions), np.full(POINTS, NOISE))
    assert where.regimes["start: at rest"] < 0.3 and where.regimes["speed: hold"] > 3.5
    assert not any("grows with motion" in sentence for sentence in where.sentences)


def test_frames_tell_a_camera_from_marks_on_the_cable():
    nominal = arches(POINTS)
    turned = nominal * 1.01 + np.array([-0.02, 0.01]) * nominal[..., ::-1] + 0.004
    camera = localise(*case(turned - nominal), np.full(POINTS, NOISE))
    assert camera.frames["image"] > 0.95
    tangent = np.gradient(nominal, axis=2)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    mark = 6e-3 * tangent * (np.arange(POINTS) == 7)[:, None]
    marks = localise(*case(mark), np.full(POINTS, NOISE))
    assert marks.frames["body"] > 0.95 > 0.5 > marks.frames["image"]
    assert marks.along_share > 0.95 and any("% of it lies along the cable" in text for text in marks.sentences)
    across = localise(*case(mark[..., ::-1] * [-1, 1]), np.full(POINTS, NOISE))
    assert across.along_share < 0.05 and not any("along the cable, but" in text for text in across.sentences)


def test_neither_the_order_of_keypoints_nor_the_frame_matters():
    gap = np.linspace(0, 5e-3, POINTS)[:, None] * np.ones(2)
    log, nominal = case(gap)
    noise = np.full(POINTS, NOISE)
    where = localise(log, nominal, noise)
    swapped = dataclasses.replace(log, keypoints=log.keypoints[:, :, ::-1], gripper_pose=log.gripper_pose[:, :, ::-1])
    back = localise(swapped, nominal[:, :, ::-1], noise)
    np.testing.assert_allclose(back.along_cable_mm[::-1], where.along_cable_mm, rtol=1e-6)
    np.testing.assert_allclose(back.per_episode_mm, where.per_episode_mm, rtol=1e-6)
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    pose = log.gripper_pose.copy()
    pose[..., :2] = pose[..., :2] @ turn.T
    pose[..., 2] += angle
    keypoints = (log.keypoints @ turn.T).astype(np.float32)
    turned = localise(dataclasses.replace(log, keypoints=keypoints, gripper_pose=pose), nominal @ turn.T, noise)
    np.testing.assert_allclose(turned.along_cable_mm, where.along_cable_mm, rtol=1e-3)
    assert {k: round(v, 2) for k, v in turned.frames.items()} == {k: round(v, 2) for k, v in where.frames.items()}


def test_a_similar_cable_of_another_length_is_off_at_the_same_places_and_speeds():
    size = 0.25
    log, nominal = case(np.linspace(0, 5e-3, POINTS)[:, None] * np.ones(2))
    where = localise(log, nominal, np.full(POINTS, NOISE))
    assert {"speed: slow", "speed: fast"} <= set(where.regimes)
    cable = {**log.meta["cable"], "length_m": size * log.meta["cable"]["length_m"]}
    marks = [size * mark for mark in log.meta["keypoint_arclength_m"]]
    small = dataclasses.replace(
        log,
        keypoints=size * log.keypoints,
        gripper_pose=log.gripper_pose * [size, size, 1.0],
        gripper_command=log.gripper_command * [size, size, 1.0],
        meta={**log.meta, "cable": cable, "keypoint_arclength_m": marks},
    )
    there = localise(small, size * nominal, np.full(POINTS, size * NOISE))
    for name in ("speed: fast", "curvature: high"):
        assert there.regimes[name] == pytest.approx(size * where.regimes[name], rel=1e-5)
    np.testing.assert_allclose(there.along_cable_mm, size * where.along_cable_mm, rtol=1e-5)


def test_missing_keypoints_no_holds_and_a_single_episode_are_no_obstacle():
    log, nominal = case(3e-3, MOTIONS[:1])
    keypoints = log.keypoints.copy()
    keypoints[np.random.default_rng(0).random(keypoints.shape[:3]) < 0.2] = np.nan
    keypoints[:, :, 3] = np.nan
    log = dataclasses.replace(log, keypoints=keypoints, hold=None)
    begin = time.perf_counter()
    where = localise(log, nominal, np.full(POINTS, NOISE))
    assert time.perf_counter() - begin < 1.0
    assert where.gap_mm == pytest.approx(3.0, rel=0.1)
    assert np.isnan(where.along_cable_mm[3]) and np.isnan(where.heat[:, :, 3]).all()
    assert any("six are needed" in sentence for sentence in where.sentences)


def test_padding_counts_for_nothing():
    log, nominal = case(3e-3)
    noise = np.full(POINTS, NOISE)
    short = dataclasses.replace(log, episode_length=np.array([60, 100, 100, 100], np.int32))
    spoiled = short.keypoints.copy()
    spoiled[0, 60:] = 1.0
    where = localise(dataclasses.replace(short, keypoints=spoiled), nominal, noise)
    assert where.gap_mm == pytest.approx(localise(short, nominal, noise).gap_mm)


def test_chance_of_any_false_contrast_keeps_to_its_level():
    rng = np.random.default_rng(0)
    false = [contrast_p(rng.normal(size=(6, 9)), np.arange(6)).min() <= 0.05 for _ in range(600)]
    assert np.mean(false) < 0.05 + 3 * np.sqrt(0.05 * 0.95 / 600)


def test_fewer_than_six_episodes_prove_no_contrast():
    assert contrast_p(np.ones((5, 3)), np.arange(5)).min() > 0.05
    assert contrast_p(np.ones((6, 3)), np.arange(6)).min() == pytest.approx(2 / 64)


def test_correlated_noise_widens_its_sum_of_squares():
    log, nominal = case()
    hold = np.ones(nominal.shape[:2], bool)
    rng = np.random.default_rng(0)
    white = rng.normal(size=(4, 2000, POINTS, 2))
    slow = np.zeros_like(white)
    for t in range(1, 2000):
        slow[:, t] = 0.6 * slow[:, t - 1] + 0.8 * white[:, t]
    hold = np.ones((4, 2000), bool)
    assert variance_inflation(white, log, hold) == pytest.approx(1.0, abs=0.02)
    # 1 + 2 sum 0.36^k
    assert variance_inflation(slow, log, hold) == pytest.approx(2.125, rel=0.05)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda log, x, s: (log, x[:, :-1], s), "nominal has shape"),
        (lambda log, x, s: (log, x, 0.0 * s), "expected positive"),
        (lambda log, x, s: (log, np.full_like(x, np.nan), s), "no gap to locate"),
    ],
    ids=["another length", "no noise", "nothing simulated"],
)
def test_what_cannot_be_compared_is_refused(change, words):
    with pytest.raises(ValueError, match=words):
        localise(*change(*case(), np.full(POINTS, NOISE)))


def test_largest_curvature_of_keypoints_that_are_not_evenly_spaced():
    arclength = np.array([0.0, 0.05, 0.1, 0.3, 0.5, 0.8, 0.85, 1.0])
    circle = 0.5 * np.stack([np.cos(arclength / 0.5), np.sin(arclength / 0.5)], axis=-1)
    np.testing.assert_allclose(largest_curvature(circle[None, None], arclength), 2.0, rtol=1e-12)


def test_what_was_not_seen_and_what_repeats_is_no_episode_of_its_own():
    gap = np.zeros((4, SAMPLES, POINTS, 2))
    gap[1, 40:, 5:8] = 4e-3
    log, nominal = case(gap)
    keypoints = log.keypoints.copy()
    keypoints[3] = np.nan
    where = localise(dataclasses.replace(log, keypoints=keypoints), nominal, np.full(POINTS, NOISE))
    assert "it shows in only 1 of 3 episodes: episode 1." in where.sentences[0]
    again = dataclasses.replace(
        where,
        heat=np.concatenate([where.heat] * 2),
        per_episode_mm=np.tile(where.per_episode_mm, 2),
        episode_p=np.tile(where.episode_p, 2),
    )
    marks, noise = np.linspace(0, 1, POINTS), np.full(POINTS, NOISE)
    assert "3 different motions" in describe(again, marks, noise, motions=3)[-1]
    assert "six are needed" not in describe(again, marks, noise)[-1]


def test_dropouts_in_holds_leave_the_noise_white():
    random, hold = np.random.default_rng(0), np.zeros((6, 300), bool)
    hold[:, 150:] = True
    whitened = random.standard_normal((6, 300, POINTS, 2))
    whitened[random.random((6, 300, POINTS)) < 0.1] = np.nan
    log = dataclasses.replace(case()[0], time=np.tile(np.arange(300) / 60, (6, 1)), episode_length=np.full(6, 300))
    assert variance_inflation(whitened, log, hold) < 1.2


def test_bending_of_keypoints_that_are_not_evenly_spaced():
    marks = np.array([0.0, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9, 1.0])
    log = types.SimpleNamespace(meta={"keypoint_arclength_m": marks.tolist()})
    residual = np.zeros((1, 20, 8, 2))
    residual[..., 1] = 0.5 * marks**2 + 0.02 * marks
    np.testing.assert_allclose(_bending(log, residual, np.full(8, 1e-9)), 1.0, rtol=1e-6)
    noisy = 1e-3 * np.random.default_rng(0).standard_normal((1, 20_000, 8, 2))
    assert _bending(log, noisy, np.full(8, 1e-3)).max() < 0.05


def test_the_first_episode_alone_does_not_say_how_far_apart_samples_are():
    whitened = np.random.default_rng(0).normal(size=(2, 100, 9, 2))
    whitened[0, 1:] = np.nan
    time, pose = np.tile(0.1 * np.arange(100), (2, 1)), np.zeros((2, 100, 2, 3))
    log = GapLog(time, whitened, pose, pose, np.array([1, 100]), {})
    assert variance_inflation(whitened, log, np.zeros((2, 100), bool)) == pytest.approx(6.0)
