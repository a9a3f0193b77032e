"""Recordings that are not as they should be: a clear error or a stated loss of power, never a confident wrong name."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cablejax.diagnose import CableDiagnosis, DiagnosisError, diagnose
from cablejax.diagnose.log_faults import clock_offset, early_keypoints, steadied
from cablejax.diagnose.recording import prepare
from cablejax.gaplog import GapLogError
from cablejax.gaplog_join import chosen
from cablejax.types import GapLog
from diagnose_cases import BY_NAME, SAMPLES, clean, log_of, noise, record

FEW = tuple(BY_NAME[n] for n in ("gripper_rotation_offset", "bending_stiffness", "keypoint_bias"))
NAME = "gripper_rotation_offset"
OFFSET = (NAME, 0, (0.08,))


def told(log: GapLog) -> CableDiagnosis:
    return diagnose(log, effects=FEW)


def not_misled(result: CableDiagnosis, *true: str) -> bool:
    """No name but the true ones is given without a doubt."""
    return result.verdict != "named" or {e.name for e in result.effects} <= set(true)


def caveat(result: CableDiagnosis, words: str) -> bool:
    return any(words in text for text in result.caveats)


def samples(log: GapLog, chosen: np.ndarray) -> GapLog:
    arrays = {
        f.name: getattr(log, f.name)[:, chosen]
        for f in dataclasses.fields(GapLog)
        if f.name not in ("meta", "episode_length")
    }
    return GapLog(meta=log.meta, episode_length=np.full_like(log.episode_length, len(chosen)), **arrays)


def of_length(log: GapLog, length: float) -> GapLog:
    meta = {**log.meta, "cable": {**log.meta["cable"], "length_m": length}}
    meta["keypoint_arclength_m"] = np.linspace(0, length, log.keypoints.shape[2]).tolist()
    return dataclasses.replace(log, meta=meta)


def holed(log: GapLog, share: float) -> GapLog:
    keypoints = log.keypoints.copy()
    keypoints[np.random.default_rng(0).random(keypoints.shape[:3]) < share] = np.nan
    return dataclasses.replace(log, keypoints=keypoints)


# Less than there should be.


@pytest.mark.parametrize(
    "effect", [pytest.param((OFFSET,), marks=pytest.mark.slow, id="effect"), pytest.param((), id="none")]
)
def test_one_episode_is_reported_as_a_limit(effect):
    result = told(chosen(record(*effect), [0]))
    assert caveat(result, "The log has one episode") and not_misled(result, NAME)
    assert (result.verdict == "none") == (effect == ())


@pytest.mark.slow
def test_without_holds_the_noise_is_assumed():
    result = told(dataclasses.replace(record(OFFSET), hold=None))
    assert caveat(result, "No holds") and not_misled(result, NAME)
    assert result.noise_mm.mean() == pytest.approx(0.5, rel=0.05)


def test_without_commands_the_arms_are_not_judged():
    log = record()
    result = told(dataclasses.replace(log, gripper_command=np.zeros_like(log.gripper_command)))
    assert caveat(result, "No commands") and result.verdict == "none"


@pytest.mark.slow
def test_a_fifth_of_the_keypoints_may_be_missing():
    result = told(holed(record(OFFSET), 0.2))
    assert caveat(result, "keypoints are missing")
    assert [e.name for e in result.effects] == [NAME] and result.verdict in ("named", "ambiguous")
    assert result.effects[0].parameters["angle_rad"].value == pytest.approx(0.08, abs=0.004)


@pytest.mark.slow
def test_a_keypoint_never_seen_does_not_matter():
    log = record(OFFSET)
    log.keypoints[:, :, 4] = np.nan
    result = told(log)
    assert [e.name for e in result.effects] == [NAME]


def test_nothing_seen_is_refused():
    with pytest.raises(DiagnosisError, match="keypoints are missing"):
        told(holed(record(), 0.95))


def test_only_the_ends_seen_is_refused():
    log = record()
    keypoints = log.keypoints.copy()
    keypoints[:, :, 1:-1] = np.nan
    with pytest.raises(DiagnosisError, match=r"missing|No keypoint between the grippers"):
        told(dataclasses.replace(log, keypoints=keypoints))


def test_a_tracker_that_repeats_its_last_value_is_not_believed():
    log = record()
    keypoints = log.keypoints.copy()
    keypoints[:, 40:, 4] = keypoints[:, 39:40, 4]
    result = told(dataclasses.replace(log, keypoints=keypoints))
    assert result.verdict == "none" and caveat(result, "Keypoint 4 repeats its last value")


def test_a_tracker_that_misreads_single_keypoints_makes_no_gap():
    log, rng = record(), np.random.default_rng(0)
    keypoints = log.keypoints.copy()
    wrong = rng.random(keypoints.shape[:3]) < 0.01
    keypoints[wrong] += 0.1 * rng.normal(size=(int(wrong.sum()), 2)).astype(np.float32)
    result = told(dataclasses.replace(log, keypoints=keypoints))
    assert result.verdict == "none" and caveat(result, "leaves its path while those around it")
    assert result.noise_mm.max() < 1.2 * told(log).noise_mm.max()


def test_keypoints_that_exchanged_their_names_make_no_gap():
    log = record()
    keypoints = log.keypoints.copy()
    keypoints[:, 30:42, 5:7] = keypoints[:, 30:42, 6:4:-1]
    result = told(dataclasses.replace(log, keypoints=keypoints))
    assert result.verdict == "none" and caveat(result, "is farther from its neighbours than the cable allows in ")


def test_an_episode_whose_keypoints_run_the_other_way_is_named():
    log = record()
    keypoints = log.keypoints.copy()
    keypoints[2] = keypoints[2, :, ::-1]
    with pytest.raises(DiagnosisError, match=r"In episode 2, unlike in others, keypoint 0 is at gripper 1 .* reverse"):
        told(dataclasses.replace(log, keypoints=keypoints))


def test_an_offset_of_the_tool_is_told():
    log = record()
    angle = log.gripper_pose[:, :, 0, 2]
    pose = log.gripper_pose.copy()
    pose[:, :, 0, 0] -= 0.008 * np.cos(angle)
    pose[:, :, 0, 1] -= 0.008 * np.sin(angle)
    caveats = prepare(dataclasses.replace(log, gripper_pose=pose)).caveats
    assert any("at gripper 0 is 8.0 mm ahead of its pose and 0.0 mm beside it" in text for text in caveats)
    assert not any("ahead of" in text or "behind" in text for text in prepare(log).caveats)


def test_an_angle_that_is_half_a_turn_off_in_one_sample_is_told_and_put_right():
    log = record()
    pose = log.gripper_pose.copy()
    pose[1, 40, 0, 2] += np.pi
    found, right = prepare(dataclasses.replace(log, gripper_pose=pose)), prepare(log)
    np.testing.assert_allclose(found.gripper_pose, right.gripper_pose, atol=0.02)
    (told_,) = set(found.caveats) - set(right.caveats)
    assert told_.startswith("In episode 1 the pose of gripper 0 jumps away and back in 1 of 100 samples, for example")


@pytest.mark.parametrize("late", [0, 1, 4, -4])
def test_poses_that_come_later_than_the_keypoints_are_told(late):
    """Of a camera that lags, an effect of the library, nothing is said here."""
    log = record()
    rows = np.clip(np.arange(SAMPLES) - late, 0, SAMPLES - 1)
    caveats = prepare(dataclasses.replace(log, gripper_pose=log.gripper_pose[:, rows])).caveats
    told_ = [text for text in caveats if "fit their poses" in text]
    assert len(told_) == (late > 0) and all(f"{0.1 * late:.2g} s later" in text for text in told_)


@pytest.mark.parametrize("unseen", [[0], [0, 1]])
def test_ends_that_are_not_seen_say_nothing_of_clocks(unseen):
    log = record()
    keypoints = log.keypoints[:, :, [0, -1]].astype(float)
    ends = keypoints.copy()
    ends[:, :, unseen] = np.nan
    place, interval = log.gripper_pose[..., :2].astype(float), np.full(len(ends), 0.1)
    assert clock_offset(ends, place, log.episode_length, interval) is None
    if unseen == [0]:
        late = np.concatenate([place[:, :1].repeat(4, axis=1), place[:, :-4]], axis=1)
        found = clock_offset(ends, late, log.episode_length, interval)
        assert found is not None and "0.4 s later" in early_keypoints(found)[0]
        ahead = clock_offset(late, ends, log.episode_length, interval)
        assert ahead is not None and ahead[0] == pytest.approx(-0.4, abs=1e-3) and early_keypoints(ahead) == []
        assert clock_offset(ends[:, :3], late[:, :3], np.full(len(ends), 3), interval) is None


SCATTER = np.array([3e-4, 3e-4, 4e-3])


def scattered(pose: np.ndarray) -> np.ndarray:
    return pose + SCATTER * np.random.default_rng(1).standard_normal(pose.shape)


@pytest.mark.parametrize("commanded", [True, False])
def test_poses_that_scatter_are_smoothed(commanded):
    recording = prepare(record())
    true = recording.gripper_pose
    expected = true if commanded else np.zeros_like(true)
    smooth, taken = steadied(scattered(true), expected, recording.length)
    error = np.sqrt(np.mean((smooth - true)[:, : recording.length.min()] ** 2, axis=(0, 1, 2)))
    assert (error < (0.3 if commanded else 0.7) * SCATTER).all()
    assert taken == pytest.approx(np.tile(SCATTER, (2, 1)), rel=0.25)


@pytest.mark.parametrize("commanded", [True, False])
def test_poses_of_encoders_stay_as_they_are(commanded):
    recording = prepare(record())
    exact = recording.gripper_pose + 0.1 * SCATTER * np.random.default_rng(1).standard_normal((2, 3))
    expected = exact if commanded else np.zeros_like(exact)
    smooth, taken = steadied(exact, expected, recording.length)
    assert smooth is exact and not taken.any()


def test_a_lag_of_the_arms_is_not_smoothed_away():
    # what the arms are off their commands by is itself no scatter
    recording = prepare(record())
    late = np.roll(recording.gripper_pose, 3, axis=1)
    late[:, :3] = late[:, 3:4]
    smooth, _ = steadied(scattered(late), recording.gripper_pose, recording.length)
    error = np.sqrt(np.mean((smooth - late)[:, : recording.length.min()] ** 2, axis=(0, 1, 2)))
    assert (error < 0.8 * SCATTER).all()


@pytest.mark.parametrize("times", [1.0, pytest.param(3.0, marks=pytest.mark.slow)])
def test_measured_poses_that_scatter_are_no_gap(times):
    log = record()
    pose = log.gripper_pose + times * (scattered(log.gripper_pose) - log.gripper_pose)
    result = told(dataclasses.replace(log, gripper_pose=pose.astype(np.float32)))
    assert result.verdict == "none" and caveat(result, "gripper poses scatter")


def test_motion_in_few_samples_is_no_scatter():
    time = np.arange(120.0)[None, :, None, None]  # a sample per second
    pose = 0.2 * np.sin(2 * np.pi * time / np.array([[20.0], [15.0]]) + np.arange(3.0)).repeat(4, axis=0)
    smooth, taken = steadied(pose, np.zeros_like(pose), np.full(4, 120))
    assert smooth is pose and not taken.any()
    noisy = pose + 0.01 * np.random.default_rng(0).standard_normal(pose.shape)
    assert (steadied(noisy, np.zeros_like(pose), np.full(4, 120))[1] > 3e-3).all()


def test_commands_made_of_poses_are_none():
    log = record()
    caveats = prepare(dataclasses.replace(log, meta={**log.meta, "commands_from_poses": True})).caveats
    assert any("No commands were logged" in text for text in caveats)


def _in_frame_of_gripper(command, log):
    cosine, sine = np.cos(log.gripper_pose[..., 2]), np.sin(log.gripper_pose[..., 2])
    x, y = command[..., 0], command[..., 1]
    return np.stack([cosine * x + sine * y, cosine * y - sine * x, command[..., 2]], axis=-1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda command, log: command * np.array([1, 1, 180 / np.pi]), "degrees per second"),
        (lambda command, log: command * np.array([1e3, 1e3, 1]), "vx and vy in mm/s: divide"),
        (lambda command, log: command * np.diff(log.time[:, :2], axis=1)[:, :, None, None], "motion of a sample"),
        (lambda command, log: log.gripper_pose, "poses, not velocities"),
        (_in_frame_of_gripper, "gripper's frame"),
        (lambda command, log: command[:, :, ::-1], "other gripper"),
    ],
    ids=["degrees", "millimetres", "per sample", "poses", "frame", "exchanged"],
)
def test_commands_of_another_meaning_are_refused(change, message):
    log = record()
    command = np.asarray(change(log.gripper_command, log), np.float32)
    with pytest.raises(DiagnosisError, match=message):
        prepare(dataclasses.replace(log, gripper_command=command))


def test_commands_that_arms_do_not_follow_leave_the_cable_its_verdict():
    log = record()
    command = log.gripper_command.copy()
    command[:, :, 0] = 0
    result = told(dataclasses.replace(log, gripper_command=command))
    assert result.verdict == "unknown" and result.sentence.startswith("With the measured poses the simulator explains")
    assert caveat(result, "neither a gain nor a lag explains that")


def test_a_moment_is_refused():
    with pytest.raises(DiagnosisError, match="longest episode has 15 samples"):
        told(samples(record(), np.arange(15)))


# Other than it says.


@pytest.mark.parametrize(("length", "message"), [(0.7, "more than the cable's length"), (1.3, "times as far apart")])
def test_a_wrong_length_is_refused(length, message):
    with pytest.raises(DiagnosisError, match=message):
        told(of_length(record(), length))


@pytest.mark.slow
@pytest.mark.parametrize("length", [0.95, 1.05])
def test_a_length_a_little_wrong_is_found(length):
    """None of the effects is a wrong length, so none is named; with the right one there is no gap."""
    result = told(of_length(record(), length))
    assert result.verdict == "none" and f"m long, not {length:g} m as stated" in result.sentence
    assert caveat(result, "so the diagnosis assumes that length")
    assert result.quantities["length_m"].value == pytest.approx(1.0, abs=2e-3)


def test_millimetres_are_refused():
    log = record()
    with pytest.raises(GapLogError, match="expected metres"):
        told(dataclasses.replace(log, keypoints=1e3 * log.keypoints))
    pose = log.gripper_pose * np.array([1e3, 1e3, 1.0], np.float32)
    with pytest.raises(GapLogError, match="expected metres"):
        told(dataclasses.replace(log, keypoints=1e3 * log.keypoints, gripper_pose=pose))


def test_another_frame_is_refused():
    log = record()
    with pytest.raises(DiagnosisError, match="in one frame"):
        told(dataclasses.replace(log, keypoints=log.keypoints + np.float32(0.5)))


def test_a_grasp_that_is_not_simulated_is_refused_before_the_diagnosis():
    log = record()
    pinned = dataclasses.replace(log, meta={**log.meta, "grasp": ["pinned", "clamped"]})
    with pytest.raises(DiagnosisError, match=r"'meta.grasp' is \['pinned', 'clamped'\], expected .*gripper_compliance"):
        prepare(pinned)


def test_space_is_refused():
    log = record()
    height = np.zeros_like(log.keypoints[..., :1])
    upright = np.zeros((*log.gripper_pose.shape[:3], 7), np.float32)
    upright[..., :2], upright[..., 3] = log.gripper_pose[..., :2], 1.0
    still = np.zeros((*log.gripper_pose.shape[:3], 6), np.float32)
    solid = np.concatenate([log.keypoints, height], axis=-1)
    with pytest.raises(DiagnosisError, match="3 dimensions"):
        told(dataclasses.replace(log, keypoints=solid, gripper_pose=upright, gripper_command=still))


@pytest.mark.parametrize("sample", [0, 40])
def test_a_pose_that_is_no_number_is_refused(sample):
    log = record()
    log.gripper_pose[1, sample, 0, 1] = np.nan
    with pytest.raises(ValueError, match="finite"):
        told(log)


def test_two_cables_end_to_end_are_refused():
    """Keypoints of a second, shorter cable in one frame with the first."""
    log = record()
    keypoints = log.keypoints.copy()
    keypoints[:, :, 7:] = keypoints[:, :, 7:][:, :, ::-1] + np.float32(0.3)
    with pytest.raises(GapLogError, match="angle of gripper 1"):
        told(dataclasses.replace(log, keypoints=keypoints))


def test_two_cables_in_one_file_get_no_name_for_both():
    """Half of the episodes with one grasp, half with the opposite one: no single angle explains both."""
    one, other = (clean((NAME, 0, (angle,))) for angle in (0.08, -0.08))
    both = np.concatenate([one[:2], other[2:]])
    result = told(log_of(both + noise(both.shape, 0.5, 3)))
    assert result.verdict in ("unknown", "named+unknown")
    assert result.gap.shrinkage < 0.6


# Clocks.


@pytest.mark.slow
def test_a_second_lost_is_bridged():
    log = samples(record(OFFSET), np.delete(np.arange(SAMPLES), np.arange(50, 60)))
    result = told(log)
    assert caveat(result, "clock of episode 0 is up to 1000 ms off an even one")
    assert [e.name for e in result.effects] == [NAME]
    assert result.effects[0].parameters["angle_rad"].value == pytest.approx(0.08, abs=0.004)


@pytest.mark.slow
def test_a_clock_that_leaps_gets_no_wrong_name():
    """The stamps leap by three seconds in the middle of the motion, the cable does not wait."""
    log = record()
    log.time[:, 50:] += 3.0
    result = told(log)
    assert caveat(result, "clock") and not_misled(result)


def test_lost_samples_leave_the_rest_in_place():
    log = record()
    whole = prepare(log)
    gap = prepare(samples(log, np.delete(np.arange(SAMPLES), np.arange(50, 60))))
    np.testing.assert_array_equal(gap.length, SAMPLES)
    assert np.isnan(gap.keypoints[:, 50:60]).all()
    kept = np.delete(np.arange(SAMPLES), np.arange(50, 60))
    np.testing.assert_array_equal(gap.keypoints[:, kept], whole.keypoints[:, kept])
    np.testing.assert_allclose(gap.gripper_pose[:, kept], whole.gripper_pose[:, kept], atol=1e-6)


def test_turns_beyond_half_a_circle_stay_continuous():
    log = record()
    wrapped, turn = log.gripper_pose.copy(), np.array([[np.cos(3.0), np.sin(3.0)], [-np.sin(3.0), np.cos(3.0)]])
    wrapped[..., :2] = wrapped[..., :2] @ turn
    wrapped[..., 2] = (wrapped[..., 2] + 3.0 + np.pi) % (2 * np.pi) - np.pi
    keypoints = (log.keypoints @ turn).astype(np.float32)
    pose = prepare(dataclasses.replace(log, gripper_pose=wrapped, keypoints=keypoints)).gripper_pose
    assert np.abs(np.diff(pose[..., 2], axis=1)).max() < 0.2


def test_commissioning_logs_of_another_cable_and_the_log_itself_are_refused():
    log = record()
    cable = {**log.meta["cable"], "bending_stiffness_n_m2": 0.05}
    other = dataclasses.replace(log, meta={**log.meta, "cable": cable}, keypoints=log.keypoints + np.float32(1e-3))
    with pytest.raises(ValueError, match="commissioning log 1 is not of the set-up of the log"):
        diagnose(log, commissioning=[other])
    with pytest.raises(ValueError, match="share an episode with identical samples"):
        diagnose(log, commissioning=[log])
