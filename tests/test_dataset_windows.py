"""Windows are what the trajectories say, at the first sample and at the last, in a mirror and from the other end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.dataset.windows import (
    Window,
    draw_windows,
    mirrored,
    reversed_ends,
    window_at,
)
from cablejax.types import Trajectory, advance

M, T, N = 4, 9, 3


@pytest.fixture
def trajectory() -> Trajectory:
    """Numbers that tell where they come from: 100 row + time in x, the keypoint's number in y, and poses alike."""
    stamp = (100.0 * np.arange(M)[:, None] + np.arange(T + 1))[:, :, None]
    keypoints = np.stack(np.broadcast_arrays(stamp, np.arange(1.0, N + 1)), axis=-1).astype(np.float32)
    pose = np.zeros((M, T + 1, 2, 3), np.float32)
    pose[..., 0], pose[..., 1], pose[..., 2] = stamp, [1, N], [0.1, 0.2]
    twist = np.zeros((M, T, 2, 3), np.float32)
    twist[..., 0] = 1.0
    return Trajectory(keypoints, pose, twist)


def one(trajectory: Trajectory, row: int, start: int, **sizes) -> Window:
    return window_at(jax.tree.map(lambda x: jnp.asarray(x[row]), trajectory), jnp.asarray(start), **sizes)


def test_a_window_holds_past_command_and_future(trajectory):
    window = one(trajectory, 2, 6, history=6, steps=3)
    np.testing.assert_array_equal(window.history.keypoints[:, 0, 0], [201, 202, 203, 204, 205, 206])
    np.testing.assert_array_equal(window.history.gripper_pose[:, 0], [206, 206])
    np.testing.assert_array_equal(window.future[:, 0, 0], [207, 208, 209])
    assert window.twist.shape == (3, 2, 3)


def test_before_the_first_sample_the_cable_was_at_rest(trajectory):
    for start, expected in ((0, [100] * 6), (2, [100] * 4 + [101, 102])):
        window = one(trajectory, 1, start, history=6, steps=1)
        np.testing.assert_array_equal(window.history.keypoints[:, 0, 0], expected)


def test_advancing_a_window_by_the_truth_gives_the_next(trajectory):
    now, after = (one(trajectory, 3, t, history=6, steps=1) for t in (4, 5))
    stepped = advance(now.history, now.future[0] - now.history.keypoints[-1], now.twist[0])
    jax.tree.map(np.testing.assert_array_equal, stepped, after.history)


def test_drawn_windows_reach_both_ends_and_repeat(trajectory):
    draw = jax.jit(draw_windows, static_argnames=("batch", "history", "steps"))
    windows = draw(jax.random.key(0), trajectory, batch=2000, history=2, steps=4)
    newest = np.asarray(windows.history.keypoints[:, -1, 0, 0])
    assert set(newest // 100) == set(range(M))
    asis = draw_windows(jax.random.key(0), trajectory, batch=200, history=2, steps=4, flips=False)
    assert (asis.history.keypoints[..., 0, 1] == 1).all() and (windows.history.keypoints[:, -1, 0, 1] != 1).any()
    assert set(newest % 100) == set(range(T - 4 + 1))
    np.testing.assert_array_equal(windows.future[:, -1, 0, 0], newest + 4)
    again = draw(jax.random.key(0), trajectory, batch=2000, history=2, steps=4)
    jax.tree.map(np.testing.assert_array_equal, again, windows)
    other = draw(jax.random.key(1), trajectory, batch=2000, history=2, steps=4)
    assert (np.asarray(other.history.keypoints[:, -1, 0, 0]) != newest).any()


def test_half_of_the_windows_are_mirrored_and_half_reversed(trajectory):
    windows = draw_windows(jax.random.key(0), trajectory, batch=2000, history=2, steps=1)
    y = np.asarray(windows.future[:, 0, :, 1])
    flipped, swapped = y[:, 0] < 0, np.abs(y[:, 0]) == N
    for share in (flipped.mean(), swapped.mean(), (flipped & swapped).mean() * 2):
        assert 0.45 < share < 0.55


def test_a_mirror_image_turns_the_other_way(trajectory):
    window = one(trajectory, 1, 3, history=2, steps=2)
    image = mirrored(window)
    np.testing.assert_array_equal(image.future, window.future * np.array([1.0, -1.0]))
    np.testing.assert_array_equal(image.history.gripper_pose, window.history.gripper_pose * np.array([1.0, -1.0, -1.0]))
    jax.tree.map(np.testing.assert_array_equal, mirrored(image), window)
    # the ends of the cable stay on the grippers
    np.testing.assert_array_equal(image.history.keypoints[-1, [0, -1]], image.history.gripper_pose[:, :2])


def test_from_the_other_end_the_tangent_points_the_other_way(trajectory):
    window = one(trajectory, 1, 3, history=2, steps=2)
    other = reversed_ends(window)
    np.testing.assert_array_equal(other.future[:, 0], window.future[:, -1])
    np.testing.assert_array_equal(other.twist[:, 0], window.twist[:, 1])
    np.testing.assert_allclose(other.history.gripper_pose[:, 2], window.history.gripper_pose[::-1, 2] + np.pi)
    np.testing.assert_array_equal(other.history.keypoints[-1, [0, -1]], other.history.gripper_pose[:, :2])
