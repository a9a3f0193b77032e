"""Windows are what the trajectories say, at the first sample and at the last."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.dataset.windows import draw_windows, split, windows
from cablejax.types import Trajectory, advance

M, T, N = 4, 9, 3


@pytest.fixture
def trajectory() -> Trajectory:
    """Numbers that tell where they come from: 100 row + time, and the pose that follows from the twist."""
    stamp = 100.0 * np.arange(M)[:, None] + np.arange(T + 1)
    keypoints = np.broadcast_to(stamp[:, :, None, None], (M, T + 1, N, 2)).astype(np.float32)
    return Trajectory(
        keypoints=keypoints,
        gripper_pose=keypoints[:, :, :2, :1] + np.zeros(3, np.float32),
        gripper_twist=np.ones((M, T, 2, 3), np.float32),
    )


def test_a_window_holds_past_command_and_future(trajectory):
    batch = windows(trajectory, jnp.array([2, 0]), jnp.array([6, 5]), horizon=3)
    np.testing.assert_array_equal(
        batch.history.keypoints[:, :, 0, 0], [[201, 202, 203, 204, 205, 206], [0, 1, 2, 3, 4, 5]]
    )
    np.testing.assert_array_equal(batch.history.gripper_pose[:, 0, 0], [206, 5])
    np.testing.assert_array_equal(batch.keypoints[:, :, 0, 0], [[207, 208, 209], [6, 7, 8]])
    assert batch.twist.shape == (2, 3, 2, 3)


def test_before_the_first_sample_the_cable_was_at_rest(trajectory):
    batch = windows(trajectory, jnp.array([1, 1]), jnp.array([0, 2]), history=6)
    np.testing.assert_array_equal(batch.history.keypoints[:, :, 0, 0], [[100] * 6, [100] * 4 + [101, 102]])


def test_advancing_a_window_by_the_truth_gives_the_next(trajectory):
    now, after = (windows(trajectory, jnp.array([3]), jnp.array([t])) for t in (4, 5))
    displacement = now.keypoints[:, 0] - now.history.keypoints[:, -1]
    stepped = jax.vmap(advance)(now.history, displacement, now.twist[:, 0])
    jax.tree.map(np.testing.assert_array_equal, stepped, after.history)


def test_drawn_windows_fit_and_reach_both_ends(trajectory):
    draw = jax.jit(draw_windows, static_argnames=("batch", "horizon"))
    row, time = draw(jax.random.key(0), trajectory, 2000, horizon=4)
    assert set(np.asarray(row)) == set(range(M))
    assert set(np.asarray(time)) == set(range(T - 4 + 1))
    again = draw(jax.random.key(0), trajectory, 2000, horizon=4)
    np.testing.assert_array_equal(again[1], time)
    batch = jax.jit(windows, static_argnames=("horizon",))(trajectory, row, time, horizon=4)
    np.testing.assert_array_equal(batch.keypoints[:, -1, 0, 0], 100 * row + time + 4)
    for wrong in (0, T + 1):
        with pytest.raises(ValueError, match=f"horizon is {wrong}, expected 1 to {T}"):
            draw_windows(jax.random.key(0), trajectory, 2, horizon=wrong)


@pytest.mark.parametrize(("count", "held_out"), [(2, 0.05), (2, 0.99), (20, 0.05), (1000, 0.05), (7, 0.5)])
def test_split_is_a_partition_with_both_parts(count, held_out):
    train, rest = split(count, held_out)
    np.testing.assert_array_equal(np.concatenate([train, rest]), np.arange(count))
    assert len(train) >= 1 and len(rest) >= 1
    assert abs(len(rest) - held_out * count) <= 1


def test_split_refuses_what_it_cannot_do():
    with pytest.raises(ValueError, match="held_out is 1"):
        split(10, 1.0)
    with pytest.raises(ValueError, match="1 trajectories"):
        split(1)
