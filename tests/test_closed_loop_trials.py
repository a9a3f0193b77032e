"""Files of trials survive whatever stops their writer."""

import dataclasses
import json
import math

import numpy as np
import pytest

from cablejax.cable import Cable
from cablejax.control.targets import make_target, straight_start
from cablejax.simulate.elastica import elastica
from cablejax.types import Measurement
from closed_loop.baselines import StraightDrive
from closed_loop.trials import Trial, read_trials, trial_of
from closed_loop_cases import TRIAL, course, trial
from rows import append_row


def append_trial(path, row: Trial) -> None:
    append_row(path, dataclasses.asdict(row))


def test_trials_come_back_as_they_were(tmp_path):
    path = tmp_path / "new" / "trials.jsonl"
    written = [TRIAL, trial(seed=1, errors_cm=course(settled_s=math.inf), stopped="taut"), trial(stiffness=0.1)]
    for row in written:
        append_trial(path, row)
    assert read_trials(path) == written
    append_trial(path, trial(seed=2, errors_cm=course(math.nan)))
    assert math.isnan(read_trials(path)[-1].terminal_error_cm)
    assert read_trials(tmp_path / "none.jsonl") == []


@pytest.mark.parametrize("left", [1, 40, 200])
def test_a_torn_last_line_is_ignored_and_then_cut_off(tmp_path, left):
    path = tmp_path / "trials.jsonl"
    append_trial(path, TRIAL)
    append_trial(path, trial(seed=1))
    whole = path.read_bytes()
    first = whole.index(b"\n") + 1
    path.write_bytes(whole[: first + left])  # killed in the middle of the second line
    assert read_trials(path) == [TRIAL]
    append_trial(path, trial(seed=2))
    assert read_trials(path) == [TRIAL, trial(seed=2)]
    assert path.read_bytes().count(b"\n") == 2


def test_the_later_of_two_equal_keys_counts(tmp_path):
    path = tmp_path / "trials.jsonl"
    for row in (TRIAL, trial(seed=1), trial(errors_cm=course(0.5))):
        append_trial(path, row)
    assert [row.terminal_error_cm for row in read_trials(path)] == [0.5, 0.25]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("{", "line 1 is not JSON"),
        ("[1]", "line 1 is list"),
        ('{"table": "III"}', "missing fields"),
    ],
)
def test_a_line_that_is_no_trial_is_refused(tmp_path, line, message):
    path = tmp_path / "trials.jsonl"
    path.write_text(line + "\n")
    with pytest.raises(ValueError, match=message):
        read_trials(path)


def test_a_field_that_no_trial_has_is_refused(tmp_path):
    path = tmp_path / "trials.jsonl"
    append_trial(path, TRIAL)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"speed": 1}) + "\n")
    with pytest.raises(ValueError, match=r"missing fields \[\], unknown fields \['speed'\]"):
        read_trials(path)


def test_what_a_trial_says_is_read_off_its_errors():
    assert (TRIAL.terminal_error_cm, TRIAL.best_error_cm, TRIAL.steps, TRIAL.settling_time_s) == (0.25, 0.25, 40, 8.0)
    assert trial(errors_cm=course(0.9, best_cm=0.5)).best_error_cm == 0.5
    assert math.isinf(trial(errors_cm=course(settled_s=math.inf)).settling_time_s)
    lost = trial(errors_cm=course(math.nan))
    assert math.isnan(lost.terminal_error_cm) and lost.best_error_cm == 5.0 and math.isinf(lost.settling_time_s)
    assert math.isnan(trial(errors_cm=(math.nan,)).best_error_cm)


def test_a_value_that_is_no_number_is_refused(tmp_path):
    path = tmp_path / "trials.jsonl"
    append_trial(path, TRIAL)
    path.write_text(path.read_text().replace("12.5", '"fast"'))
    with pytest.raises(ValueError, match=r"line 1 is not a trial: .*fast"):
        read_trials(path)


def test_a_run_becomes_a_trial():
    class Run:
        error_cm = np.array([20.0, 0.4, np.nan, 0.5])
        mpc_ms = np.array([90.0, 110.0, 130.0, np.nan])
        stopped = None
        twist = np.tile([[0.01, 0.0, 0.0], [0.0, 0.0, 0.1]], (4, 1, 1))

    row = trial_of(Run(), table="III", method="direct", scenario="Z", stiffness=3, seed=4, wall_s=2)  # pyright: ignore[reportArgumentType]
    assert (row.best_error_cm, row.steps, row.mpc_ms_median) == (0.4, 3, 110.0)
    assert row.key == ("III", "direct", "Z", 3.0, 4)
    assert row.motion_m == pytest.approx((0.025,) * 3), "a radian counts as 15 cm; the last sample has no command"
    assert row.errors_cm[:2] == (20.0, 0.4) and math.isnan(row.errors_cm[2])


def test_the_end_of_a_run_is_judged_over_its_last_ten_seconds():
    chattering = trial(errors_cm=(20.0, *[0.2, 0.8] * 8), motion_m=(0.05,) * 16)
    assert len(chattering.late_errors_cm) == 10 and np.ptp(chattering.late_errors_cm) == pytest.approx(0.6)
    assert chattering.late_travel_m == pytest.approx(0.5)
    assert chattering.worse_than_best and not TRIAL.worse_than_best
    assert trial(errors_cm=course(math.nan)).worse_than_best, "a lost cable is worse than any"
    assert math.isnan(TRIAL.late_travel_m), "older rows have no motions"


def test_a_straight_drive_ends_at_the_goal_and_stays():
    drive, goal = StraightDrive(make_target("S").keypoints), make_target("S").gripper_pose
    pose = straight_start(Cable())
    keypoints = elastica(pose, 1.0, Cable().keypoint_arclength)
    for _ in range(20):
        _, twist, _ = drive.step((), Measurement(keypoints, pose))
        assert np.linalg.norm(twist * np.array([1.0, 1.0, 0.15]), axis=1).max() <= 0.05 + 1e-6
        pose = pose + np.asarray(twist)
        keypoints = np.linspace(pose[0, :2], pose[1, :2], 13)
    np.testing.assert_allclose(pose[:, :2], goal[:, :2], atol=1e-3)
    assert np.abs(twist).max() < 1e-3


@pytest.mark.parametrize(
    ("error", "fraction", "expected"),
    [
        ([21, 9, 1.9, 1.3, 1.0, 1.0, 1.0], 0.05, 2.0),  # 5 % of 20 are 1.0
        ([21, 9, 1.9, 1.3, 1.0, 1.0, 1.0], 0.02, 3.0),
        ([21, 1.1, 1.9, 1.3, 1.0, 1.0, 1.0], 0.02, 3.0),
        ([21, 9, 8, 7, 6], 0.02, np.inf),
        ([21, 9, np.nan, 1.0, 1.0, 1.0], 0.02, 3.0),  # what was not seen was not near
        ([21, 9, 1, np.nan], 0.02, np.inf),
    ],
)
def test_settling_time_of_a_step_response(error, fraction, expected):
    assert trial(errors_cm=tuple(error)).step_settling_time_s(fraction) == expected
