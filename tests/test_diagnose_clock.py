"""Samples put on an even clock: smooth motion is kept, exact arms stay exact, and nothing is invented in a gap."""

import numpy as np
import pytest

from cablejax.diagnose.clock import furthest_off, is_even, on_even_clock, usual_interval
from cablejax.diagnose.reference import predicted_ahead
from cablejax.gaplog import Episode

INTERVAL, N = 0.1, 120


def truth(time):
    """Two keypoints on smooth paths [m], a few centimetres a second."""
    return np.stack(
        [0.05 * np.sin(0.8 * time), 0.03 * np.cos(1.1 * time), 0.02 * time, 0.04 * np.sin(time)], 1
    ).reshape(-1, 2, 2)


def clocks():
    rng = np.random.default_rng(0)
    even = INTERVAL * np.arange(N)
    return {
        "jitter": even + INTERVAL * rng.uniform(-0.3, 0.3, N),
        "drift": np.concatenate([[0.0], np.cumsum(np.linspace(0.9, 1.1, N - 1) * INTERVAL)]),
        "two steps": np.concatenate([[0.0], np.cumsum(np.where(rng.random(N - 1) < 0.45, 0.85, 1.0) * INTERVAL)]),
    }


def episode_of(time, pose, command, hold=False):
    return Episode("recorded", time, truth(time), pose, command, np.full(len(time), hold))


def samples_at(time):
    """Grippers that move with piecewise constant twists, which are their commands too."""
    rng = np.random.default_rng(1)
    command = np.repeat(rng.normal(size=(len(time) // 10 + 1, 2, 3)), 10, axis=0)[: len(time)] * 0.05
    path = np.cumsum(command[:-1] * np.diff(time)[:, None, None], axis=0)
    return episode_of(time, np.concatenate([np.zeros((1, 2, 3)), path]), command)


@pytest.mark.parametrize("name", ["jitter", "drift", "two steps"])
def test_keypoints_and_arms_are_those_of_the_even_times(name):
    time = clocks()[name]
    interval = usual_interval(time)
    assert interval == pytest.approx(np.diff(time).mean(), abs=1e-6) and not is_even(time, interval)
    even = on_even_clock(samples_at(time), interval)
    grid = interval * np.arange(len(even.hold))
    assert np.isfinite(even.keypoints).all()
    np.testing.assert_allclose(even.keypoints, truth(grid + time[0]), atol=3e-5)
    commanded = np.cumsum(even.gripper_command[:-1] * interval, axis=0)
    np.testing.assert_allclose(commanded, even.gripper_pose[1:], atol=1e-12)


def test_a_gap_is_left_open_and_the_rest_bridged():
    time = np.delete(INTERVAL * np.arange(N), np.arange(50, 60))
    assert usual_interval(time) == INTERVAL
    samples = samples_at(time)
    even = on_even_clock(samples, INTERVAL)
    missing = np.isnan(even.keypoints).any(axis=(1, 2))
    np.testing.assert_array_equal(np.flatnonzero(missing), np.arange(50, 60))
    np.testing.assert_array_equal(even.keypoints[:50], samples.keypoints[:50])
    assert np.isfinite(even.gripper_pose).all() and np.isfinite(even.gripper_command).all()


def test_a_keypoint_that_is_not_seen_is_taken_from_its_neighbours_in_time_or_not_at_all():
    time = clocks()["jitter"]
    samples = samples_at(time)
    samples.keypoints[40, 0] = np.nan
    even = on_even_clock(samples, INTERVAL)
    lost = np.flatnonzero(np.isnan(even.keypoints[:, 0, 0]))
    assert 1 <= len(lost) <= 2 and np.abs(lost - 40).max() <= 1
    assert np.isfinite(even.keypoints[:, 1]).all()


def test_an_even_clock_is_known_by_its_farthest_sample():
    time = INTERVAL * np.arange(N)
    assert is_even(time + 7.0, INTERVAL) and furthest_off(time, INTERVAL) < 1e-12
    late = time.copy()
    late[30] += 0.02 * INTERVAL
    assert not is_even(late, INTERVAL) and furthest_off(late, INTERVAL) == pytest.approx(0.02 * INTERVAL)


def test_two_samples_are_enough():
    time = np.array([0.0, 0.13])
    even = on_even_clock(episode_of(time, np.zeros((2, 2, 3)), np.zeros((2, 2, 3)), hold=True), 0.1)
    assert even.hold.all() and np.isfinite(even.keypoints).all()


def test_an_even_clock_of_any_rate_is_even():
    for rate in (30.0, 60.0, 120.0):
        time = np.arange(3000) / rate
        assert is_even(time, usual_interval(time))


@pytest.mark.parametrize("interval", [0.1, 0.4, 0.7])
def test_five_seconds_ahead_are_five_seconds_whatever_the_clock(interval):
    """Errors that grow by a millimetre a second."""
    count = int(40 / interval)
    observed = np.broadcast_to(1e-3 * interval * np.arange(count)[None, :, None, None], (1, count, 3, 2))
    pose = np.zeros((1, count, 2, 3))
    plain, _ = predicted_ahead(observed, np.zeros_like(observed), pose, np.array([interval]), np.array([count]))
    assert 1e3 * plain == pytest.approx(5.0, rel=1e-6)
