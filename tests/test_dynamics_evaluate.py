"""Open-loop errors are those of predictors whose error is known."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.dynamics.error_report import GROUPS, MODEL, error_report
from cablejax.dynamics.evaluate import (
    evaluation_windows,
    no_motion,
    predict,
    prior_motion,
    snapping,
    window_errors,
)
from cablejax.dynamics.graph import rigid_interpolation
from cablejax.types import Trajectory
from dynamics_cases import SMALL, network, trajectories
from open_loop import open_loop_error

DATA = trajectories(m=3, t=8)
SHORT = (1, 4)


def test_windows_start_at_every_stride_and_hold_what_followed():
    windows = evaluation_windows(DATA, SMALL, steps=4, stride=2)
    assert windows.twist.shape == (3 * 3, 4, 2, 3)
    for row, (m, start) in enumerate((m, start) for m in range(3) for start in (0, 2, 4)):
        np.testing.assert_array_equal(windows.future[row], DATA.keypoints[m, start + 1 : start + 5])
        np.testing.assert_array_equal(windows.history.keypoints[row, -1], DATA.keypoints[m, start])
        np.testing.assert_array_equal(windows.history.gripper_pose[row], DATA.gripper_pose[m, start])


def test_who_expects_no_motion_is_off_by_the_motion():
    found = open_loop_error(no_motion, DATA, SMALL, horizons=SHORT, stride=3)
    assert found.rmse_cm == pytest.approx(found.moved_cm, rel=1e-5)
    assert found.relative == pytest.approx((1.0, 1.0), rel=1e-5)
    shift = DATA.keypoints[:, [4, 7]] - DATA.keypoints[:, [0, 3]]
    expected = 100 * np.sqrt(np.mean(np.sum(shift**2, axis=-1)))
    assert found.rmse_cm[1] == pytest.approx(expected, rel=1e-5)
    mean = 100 * np.mean(np.sqrt(np.mean(np.sum(shift**2, axis=-1), axis=-1)))
    assert found.mean_cm[1] == pytest.approx(mean, rel=1e-5)
    assert found.starts == (6, 6) and found.horizons == SHORT
    assert found.median_cm[0] < found.p90_cm[0] < found.p95_cm[0] < found.p99_cm[0]


def test_a_constant_error_per_step_adds_up():
    def drifting(history, twist):
        """Moves every keypoint by 1 mm beyond the truth, which is: nothing moves."""
        return jnp.full_like(history.keypoints[-1], 1e-3)

    still = jax.tree.map(lambda x: np.repeat(x[:, :1], x.shape[1], axis=1), DATA)
    found = open_loop_error(drifting, still, SMALL, horizons=(1, 3), stride=1)
    assert found.rmse_cm == pytest.approx((0.1 * 2**0.5, 0.3 * 2**0.5), rel=1e-4)
    assert found.p99_cm == pytest.approx(found.median_cm, rel=1e-4)


def test_prior_is_the_network_that_learned_nothing():
    windows = evaluation_windows(DATA, SMALL, steps=4, stride=4)
    untrained, learned = (window_errors(network(SMALL, last=last), windows, SMALL, batch=2) for last in (0.0, 0.1))
    floor = window_errors(prior_motion(SMALL, "rigid"), windows, SMALL, batch=6)
    np.testing.assert_allclose(untrained, floor, atol=1e-6)
    assert np.abs(learned - floor).max() > 1e-4


def test_prediction_feeds_itself_and_not_the_truth():
    history = jax.tree.map(lambda x: x[0], evaluation_windows(DATA, SMALL, steps=4, stride=4).history)
    commands = jnp.full((3, 2, 3), 0.01)
    shapes = predict(prior_motion(SMALL, "rigid"), history, commands)
    shape, pose = history.keypoints[-1], history.gripper_pose
    for k in range(3):
        shape = shape + rigid_interpolation(pose, commands[k], n_keypoints=5, length=SMALL.length)
        pose = pose + commands[k]
        np.testing.assert_allclose(shapes[k], shape, atol=1e-6)


def snapping_data() -> Trajectory:
    """Two trajectories; in step 5 of the second a keypoint jumps by 5 cm, more than the grippers explain."""
    keypoints = np.zeros((2, 9, 5, 2), np.float32)
    keypoints[1, 6:, 2, 1] = 0.05
    twist = np.zeros((2, 8, 2, 3), np.float32)
    twist[:, :, 0, 0] = 0.01
    return Trajectory(keypoints, np.zeros((2, 9, 2, 3), np.float32), twist)


def test_windows_with_a_snap_through_are_found_from_the_truth_alone():
    found = snapping(snapping_data(), steps=3, stride=1)
    assert found.shape == (2 * 6, 3)
    assert not found[:6].any()
    # starts 0, ..., 5: within the first 1, 2, 3 steps of a window or in the two steps before it
    np.testing.assert_array_equal(found[6:].argmax(axis=1), [0, 0, 0, 2, 1, 0])
    np.testing.assert_array_equal(found[6:].any(axis=1), [False, False, False, True, True, True])
    assert snapping(snapping_data(), steps=1, stride=1)[8:].ravel().tolist() == [False] * 5 + [True] * 3


def test_a_jump_that_the_grippers_lead_is_no_snap_through():
    data = snapping_data()
    data.gripper_twist[1, 5, :, 2] = 0.06 / 0.15  # 6 cm weighted, each
    assert not snapping(data, steps=3, stride=1).any()


def test_report_adds_up_over_groups_and_data_sets():
    jump = trajectories(m=2, t=8, seed=5)
    jump.keypoints[:, 5:, 2] += 0.3
    report = error_report(network(SMALL), {"calm": DATA, "jump": jump}, SMALL, horizons=(1, 4, 20), stride=2)
    everything, calm, snapped = (report.errors[group] for group in GROUPS)
    assert everything[MODEL].horizons == (1, 4), "no trajectory is 20 steps long"
    assert [a + b for a, b in zip(calm[MODEL].starts, snapped[MODEL].starts, strict=True)] == [15, 15]
    assert [sum(e.starts[k] for e in report.by_data.values()) for k in range(2)] == list(calm[MODEL].starts)
    assert snapped[MODEL].starts[1] == 4 and report.snapping_fraction()[1] == pytest.approx(4 / 15)
    assert snapped[MODEL].rmse_cm[1] > 5 * calm[MODEL].rmse_cm[1]
    whole = open_loop_error(network(SMALL), DATA, SMALL, horizons=(1, 4), stride=2)
    assert report.by_data["calm"].rmse_cm == pytest.approx(whole.rmse_cm, rel=1e-5)
    text = "\n".join(report.markdown())
    assert text.count("| no motion |") == 6 and "| jump | 4 |" in text
    assert report.to_json()["errors"]["snap-through"][MODEL]["starts"] == list(snapped[MODEL].starts)


def test_a_group_without_windows_is_left_empty():
    report = error_report(network(SMALL), {"calm": DATA}, SMALL, horizons=(1,), stride=4)
    assert report.errors["snap-through"][MODEL].starts == (0,)
    assert report.to_json()["errors"]["snap-through"][MODEL]["rmse_cm"] == [None]
    assert any(line.startswith("| network | 1 | 0 |  |") for line in report.markdown())


def test_bad_data_is_refused():
    for change, message in (
        ({"keypoints": DATA.keypoints[:, :, :4]}, "another cable"),
        ({"keypoints": np.where(np.arange(5)[:, None] == 2, np.nan, DATA.keypoints)}, "NaN or infinity in 3 of 3"),
        ({"keypoints": DATA.keypoints + 0.1}, "away from its gripper"),
        ({"gripper_twist": DATA.gripper_twist[0]}, "four axes"),
    ):
        with pytest.raises(ValueError, match=message):
            open_loop_error(no_motion, dataclasses.replace(DATA, **change), SMALL, horizons=(1,))
    with pytest.raises(ValueError, match="use longer trajectories"):
        open_loop_error(no_motion, DATA, SMALL)


@pytest.mark.parametrize("length", [0.1, 10.0])
def test_snap_throughs_of_a_cable_of_another_length_are_the_same(length):
    data = snapping_data()
    scaled = dataclasses.replace(
        data, keypoints=length * data.keypoints, gripper_twist=data.gripper_twist * np.array([length, length, 1.0])
    )
    usual, found = snapping(data, steps=3, stride=1), snapping(scaled, steps=3, stride=1, length=length)
    np.testing.assert_array_equal(found, usual)
