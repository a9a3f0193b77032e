"""Bad recordings: repaired and reported, or rejected with advice."""

import dataclasses

import numpy as np
import pytest

import recording_cases
from cablejax.poses import poses_from_markers
from cablejax.recordings.assemble import Nominal, gap_log_from_takes, measured_arclength
from cablejax.recordings.deform import read_deform, takes_of
from cablejax.recordings.frames import Frame
from cablejax.recordings.gaps import cut_at_gaps
from cablejax.recordings.marker_order import restore_order
from cablejax.recordings.prepare import Setup, prepare
from cablejax.recordings.take import Take
from recording_cases import DATA, DT, SPACING, arch, arch_take, needs_deform, swinging, take

HELD = (0, 1, 7, 8)
PAIRS = Setup(unit="m", on_grippers="pairs")
NOMINAL = Nominal(diameter=0.006, linear_density=0.04, bending_stiffness=6e-4)


def others(count: int = 3) -> tuple[Take, ...]:
    return tuple(take(swinging(seed=seed, phase=seed), str(seed)) for seed in range(1, count + 1))


def exchanged(points: np.ndarray, rows: slice, order: list[int]) -> np.ndarray:
    points = points.copy()
    points[rows] = points[rows][:, order]
    return points


@pytest.mark.parametrize(
    ("rows", "order"),
    [
        (slice(60, 130), [0, 1, 2, 4, 3, 5, 6, 7, 8]),
        (slice(60, 130), [1, 0, 2, 3, 4, 5, 6, 7, 8]),
        (slice(60, 130), [0, 1, 6, 3, 4, 5, 2, 7, 8]),
        (slice(150, 200), [8, 7, 6, 5, 4, 3, 2, 1, 0]),
        (slice(60, 130), [3, 8, 1, 0, 7, 2, 6, 5, 4]),
        (slice(0, 200), [0, 1, 2, 3, 4, 5, 6, 8, 7]),
        (slice(0, 90), [0, 3, 2, 1, 4, 5, 6, 7, 8]),
        (slice(0, 200), [8, 7, 6, 5, 4, 3, 2, 1, 0]),
    ],
    ids=["two", "a pair", "far apart", "reversed", "all", "a whole take", "from the start", "a whole take reversed"],
)
def test_exchanged_markers_are_put_back(rows, order):
    right = swinging()
    restored, repairs = restore_order((take(exchanged(right, rows, order)), *others()))
    np.testing.assert_array_equal(restored[0].keypoints, right)
    assert len(repairs) == 1 and repairs[0].startswith("Take a: ")
    for before, after in zip(others(), restored[1:], strict=True):
        np.testing.assert_array_equal(after.keypoints, before.keypoints)


def test_a_cable_that_slowly_folds_back_at_its_gripper_keeps_its_order():
    points = swinging()
    along = points[:, 2] - points[:, 1]
    along *= 0.03 / np.linalg.norm(along, axis=1, keepdims=True)
    turn = np.pi * np.sin(np.pi * np.arange(200) / 200)[:, None]
    across = np.cross(along, [0.0, 1.0, 0.0])
    points[:, 0] = points[:, 1] - np.cos(turn) * along - np.sin(turn) * across
    (one, *_), repairs = restore_order((take(points), *others()))
    np.testing.assert_array_equal(one.keypoints, points)
    assert not repairs


def test_exchanged_markers_are_reported_by_number_and_sample():
    points = exchanged(swinging(), slice(60, 130), [0, 1, 2, 4, 3, 5, 6, 7, 8])
    _, repairs = restore_order((take(points), *others()))
    assert repairs == [
        "Take a: keypoints 3, 4 had exchanged their names in 70 of 200 samples, from sample 60, and were reordered."
    ]


def torn() -> np.ndarray:
    """One end is pulled off from the middle of the take on, slowly."""
    points = swinging()
    points[:, -2:, 0] += np.clip(np.arange(len(points)) - 100, 0, None)[:, None] * 0.005
    return points


def test_no_order_mends_a_cable_that_is_torn():
    points = torn()
    restored, repairs = restore_order((take(points), *others()))
    np.testing.assert_array_equal(restored[0].keypoints, points)
    assert repairs == []


def test_a_take_in_which_the_cable_is_torn_is_left_out():
    takes, repairs = prepare((take(torn(), "torn"), *others(5)), PAIRS)
    assert [one.name for one in takes] == [one.name for one in others(5)]
    assert len(repairs) == 1 and repairs[0].startswith("Take torn: along the keypoints the cable measures up to ")
    assert repairs[0].endswith("the take was left out. Was the cable torn, or did a marker come off?")


def test_where_many_takes_stretch_the_cause_is_another_and_all_stay():
    takes, repairs = prepare((take(torn(), "torn"), *others(2)), PAIRS)
    assert len(takes) == 3 and not any("left out" in line for line in repairs)


def test_missing_markers_do_not_hinder():
    right = swinging()
    right[np.random.default_rng(0).random(right.shape[:2]) < 0.05] = np.nan
    points = exchanged(right, slice(60, 130), [0, 1, 2, 5, 4, 3, 6, 7, 8])
    restored, repairs = restore_order((take(points), *others()))
    wrong = ~np.isclose(restored[0].keypoints, right, equal_nan=True).all(axis=(1, 2))
    # Where a marker is missing the order of the sample before is kept: it is late by at most a few samples.
    assert wrong.sum() <= 8 and len(repairs) == 1
    unchanged, repairs = restore_order((take(right), *others()))
    np.testing.assert_array_equal(unchanged[0].keypoints, right)
    assert repairs == []


def test_columns_in_a_wrong_order_are_refused():
    points = swinging()[:, [0, 4, 1, 5, 2, 6, 3, 7, 8]]
    with pytest.raises(ValueError, match=r"folds back .* 100 % of the samples: give the keypoints in their order"):
        restore_order((take(points),))


def branched(seed: int = 0) -> np.ndarray:
    """A parent of nine markers, and branches of three markers that leave it at its fourth, of two at its sixth."""
    parent = swinging(seed=seed, phase=seed)
    time = DT * np.arange(len(parent)) + seed
    down = np.stack([0.3 * np.sin(4 * time), 0.3 * np.cos(3 * time), -np.ones_like(time)], axis=-1)[:, None]
    down /= np.linalg.norm(down, axis=-1, keepdims=True)
    first = parent[:, 3:4] + 0.08 * np.arange(1, 4)[:, None] * down
    second = parent[:, 5:6] + 0.09 * np.arange(1, 3)[:, None] * (0.8 * down + 0.6 * np.array([0.0, 1.0, 0.0]))
    return np.concatenate([parent, first, second], axis=1)


def test_a_branched_cable_is_refused_by_that_name():
    takes = tuple(take(branched(seed), str(seed)) for seed in range(3))
    with pytest.raises(ValueError, match="This is a branched cable") as refused:
        prepare(takes, PAIRS)
    text = str(refused.value)
    assert "give keypoints 0 to 8" in text and "keypoints 9 to 11 leave it at keypoint 3" in text
    assert "keypoints 12 to 13 leave it at keypoint 5" in text and "leave out 9 to 13" in text
    assert "the mass of the branches is then missing" in text
    parents = [dataclasses.replace(one, keypoints=one.keypoints[:, :9]) for one in takes]
    assert len(prepare(tuple(parents), PAIRS)[0]) == 3


def test_a_branch_may_begin_on_top_of_the_parent():
    for off in (0.002, 0.0):
        points = branched()
        points = np.concatenate([points[:, :9], points[:, 3:4] + off, points[:, 9:12]], axis=1)
        with pytest.raises(ValueError, match="keypoints 9 to 12 leave it at keypoint 3"):
            prepare((take(points),), PAIRS)


def test_a_branch_of_one_marker_is_named_as_one():
    with pytest.raises(ValueError, match=r"keypoint 9 leaves it at keypoint 3\).* and leave out 9; the mass"):
        restore_order((take(branched()[:, :10]),))


@pytest.mark.parametrize(
    "order", [[0, 2, 4, 6, 8, 1, 3, 5, 7], [4, 5, 0, 1, 7, 8, 2, 3, 6], [3, 6, 2, 7, 1, 8, 0, 5, 4]]
)
def test_a_wrong_order_is_no_branch(order):
    with pytest.raises(ValueError, match="folds back"):
        restore_order((take(swinging()[:, order]),))


def test_two_cables_in_one_folder_are_refused(monkeypatch):
    first = others(4)
    with monkeypatch.context() as patch:
        patch.setattr(recording_cases, "SPACING", np.array([0.03, 0.11, 0.12, 0.1, 0.08, 0.1, 0.1, 0.04]))
        second = tuple(take(swinging(seed=seed), name) for seed, name in ((7, "x"), (8, "y")))
    with pytest.raises(
        ValueError, match=r"2 different cables: in take x, y .* other 4 .* Import each cable separately"
    ):
        prepare((*first[:2], *second, *first[2:]), PAIRS)
    assert len(prepare(first, PAIRS)[0]) == 4 and len(prepare(second, PAIRS)[0]) == 2
    # a marker that slipped, and another grip, are still the same cable
    slipped, gripped = swinging(seed=5), swinging(seed=6)
    slipped[:, 4] += 0.15 * (slipped[:, 5] - slipped[:, 4])
    gripped[:, 1] += 0.3 * (gripped[:, 0] - gripped[:, 1])
    assert len(prepare((*first, take(slipped, "slipped"), take(gripped, "gripped")), PAIRS)[0]) == 6


@needs_deform
def test_two_of_the_real_cables_are_two():
    both = [takes_of(read_deform(DATA / "deform" / f"DLO{k}.npz")) for k in (2, 3)]
    for some in both:
        assert len(prepare(some, Setup(unit=None))[0]) >= 70
    with pytest.raises(ValueError, match="2 different cables: in take"):
        prepare((*both[0][:20], *both[1][:5]), Setup(unit=None))


def samples_of(takes: tuple[Take, ...]) -> list[tuple[str, int]]:
    return [(part.name, len(part.time)) for part in takes]


def test_a_gap_in_the_times_cuts_a_take():
    keep = np.r_[0:80, 110:200]
    points = swinging()
    late = dataclasses.replace(take(points), time=DT * np.arange(200))
    late = Take("a", late.time[keep], points[keep])
    parts, repairs = cut_at_gaps((late,), HELD)
    assert samples_of(parts) == [("a/1", 80), ("a/2", 90)]
    assert len(repairs) == 1 and "no samples for 0.31 s after sample 79, where 0.01 s is usual" in repairs[0]
    np.testing.assert_array_equal(parts[1].keypoints, points[110:])


def test_a_gap_that_the_times_do_not_tell_cuts_a_take():
    points = swinging()[np.r_[0:80, 110:200]]
    parts, repairs = cut_at_gaps((take(points),), HELD)
    assert samples_of(parts) == [("a/1", 80), ("a/2", 90)]
    assert "the whole cable jumps between samples 79 and 80" in repairs[0]


def test_time_stamps_that_jitter_are_no_gap_and_do_not_hide_one():
    jitter = 0.002 * np.random.default_rng(3).normal(size=200)
    time = np.sort(DT * np.arange(200) + jitter)
    whole = dataclasses.replace(take(swinging()), time=time)
    assert samples_of(cut_at_gaps((whole,), HELD)[0]) == [("a", 200)]
    keep = np.r_[0:80, 110:200]
    lost = dataclasses.replace(take(swinging()[keep]), time=time[:170])
    assert samples_of(cut_at_gaps((lost,), HELD)[0]) == [("a/1", 80), ("a/2", 90)]


def test_what_was_cut_is_still_one_recording():
    points = swinging()
    points[80:110, 0] = np.nan
    parts, _ = cut_at_gaps((take(points), take(swinging(), "b")), HELD)
    assert [(part.name, part.labels["recording"]) for part in parts] == [("a/1", "a"), ("a/2", "a"), ("b", "b")]
    labelled = dataclasses.replace(take(points), labels={"recording": 7})
    assert [part.labels["recording"] for part in cut_at_gaps((labelled,), HELD)[0]] == [7, 7]


@pytest.mark.parametrize("column", [0, 7])
def test_a_gripper_not_seen_for_long_cuts_a_take(column):
    points = swinging()
    points[80:110, column] = np.nan
    parts, repairs = cut_at_gaps((take(points),), HELD)
    assert samples_of(parts) == [("a/1", 80), ("a/2", 90)]
    assert "in 30 samples one of the gripper poses is missing" in repairs[0]


def test_a_gripper_not_seen_for_a_moment_is_filled_in():
    right = swinging()
    points = right.copy()
    points[80:83, 7:] = np.nan
    parts, repairs = cut_at_gaps((take(points),), HELD)
    assert (
        samples_of(parts) == [("a", 200)]
        and "3 samples without one of the gripper poses: interpolated linearly" in repairs[0]
    )
    assert np.linalg.norm(parts[0].keypoints - right, axis=-1).max() < 2e-3


@pytest.mark.parametrize(("interval", "missing", "parts"), [(0.05, 1, 1), (0.05, 2, 2), (0.1, 1, 1), (0.2, 1, 2)])
def test_on_a_table_one_lost_frame_is_filled_in(interval, missing, parts):
    samples = 60
    points = np.stack([np.linspace(0, 1, 5), np.zeros(5)], axis=1) + 0.001 * np.arange(samples)[:, None, None]
    pose = np.stack([np.append(points[:, end], np.zeros((samples, 1)), axis=1) for end in (0, -1)], axis=1)
    kept = np.delete(np.arange(samples), np.arange(30, 30 + missing))
    takes, _ = cut_at_gaps((Take("1", interval * kept, points[kept], pose[kept]),), None)
    assert len(takes) == parts
    pose[30 : 30 + missing] = np.nan
    takes, _ = cut_at_gaps((Take("1", interval * np.arange(samples), points, pose),), None)
    assert len(takes) == parts
    if parts == 1:
        np.testing.assert_allclose(takes[0].gripper_pose[30, :, :2], points[30, [0, -1]], atol=1e-12)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_lost_pose_is_filled_in_the_short_way_round(dimension):
    """Angles of arctan2 jump by a whole turn, and trackers change the sign of a quaternion: neither is a motion."""
    samples = 60
    angle = np.pi - 0.0295 + 0.001 * np.arange(samples)
    places = np.stack([np.linspace(0, 1, 5), *np.zeros((dimension - 1, 5))], axis=1)
    points = np.tile(places, (samples, 1, 1))
    if dimension == 2:
        turned = np.arctan2(np.sin(angle), np.cos(angle))[:, None]
    else:
        still = np.zeros(samples)
        turned = np.stack([np.cos(angle / 2), still, still, np.sin(angle / 2)], axis=1)
        turned[30:] *= -1.0
    pose = np.stack([np.append(points[:, end], turned, axis=1) for end in (0, -1)], axis=1)
    lost = pose.copy()
    lost[30, 0] = np.nan
    takes, _ = cut_at_gaps((Take("1", 0.02 * np.arange(samples), points, lost),), None)
    filled = takes[0].gripper_pose
    np.testing.assert_array_equal(filled[:, 1], pose[:, 1])
    difference = filled[30, 0] - pose[30, 0]
    if dimension == 2:
        difference[2] = (difference[2] + np.pi) % (2 * np.pi) - np.pi
    else:
        difference[3:] = 1.0 - abs(filled[30, 0, 3:] @ pose[30, 0, 3:])
    np.testing.assert_allclose(difference, 0.0, atol=1e-6)


def test_keypoints_between_the_grippers_may_be_missing():
    points = swinging()
    points[20:180, 3:5] = np.nan
    parts, repairs = cut_at_gaps((take(points),), HELD)
    assert samples_of(parts) == [("a", 200)] and repairs == []
    np.testing.assert_array_equal(parts[0].keypoints, points)


def test_a_tracker_that_holds_its_last_values_cuts_a_take():
    points = swinging()
    points[80:110] = points[79]
    parts, repairs = cut_at_gaps((take(points),), HELD)
    assert samples_of(parts) == [("a/1", 80), ("a/2", 90)]
    assert "30 samples repeat the previous one to the last digit" in repairs[0]


@pytest.mark.parametrize("held", [5, 10])
def test_a_tracker_that_holds_its_values_for_a_moment_cuts_a_take(held):
    """At 0.1 m/s, where what it makes good for is millimetres."""
    points = 0.4 * swinging(400)
    points[200 : 200 + held] = points[199]
    parts, repairs = cut_at_gaps((take(points),), HELD)
    assert samples_of(parts) == [("a/1", 200), ("a/2", 200 - held)]
    assert f"{held} samples repeat the previous one to the last digit" in repairs[0]


def test_a_recording_without_noise_at_rest_is_no_gap():
    points = np.repeat(swinging(1), 200, axis=0)
    parts, repairs = cut_at_gaps((take(points),), HELD)
    assert samples_of(parts) == [("a", 200)] and repairs == []


@pytest.mark.parametrize("poses", [False, True])
def test_a_tracker_slower_than_its_recording_has_only_new_samples(poses):
    right = swinging(300)
    held = right[np.arange(300) // 3 * 3]
    pose = np.concatenate([right[:, [0, -1]], np.tile([1.0, 0.0, 0.0, 0.0], (300, 2, 1))], axis=2) if poses else None
    parts, (told,) = cut_at_gaps((take(held, pose=pose),), None if poses else HELD)
    assert "200 samples repeat" in told and "about 3 times slower than the recording" in told
    assert samples_of(parts) == [("a", 100)]
    np.testing.assert_array_equal(parts[0].keypoints, right[::3])
    np.testing.assert_allclose(np.diff(parts[0].time), 3 * DT)


def test_a_tracker_that_stops_is_noticed_beside_a_hidden_marker():
    points = swinging()
    points[:, 4] = np.nan
    points[100:130] = points[99]
    (one, *_), told = prepare((take(points), *others()), PAIRS)
    assert len(one.time) < 200 and any("30 samples repeat the previous one to the last digit" in text for text in told)


def test_a_marker_that_jumps_is_not_observed_there():
    right = swinging()
    points = right.copy()
    points[70:90, 4] += [0.0, 0.1, 0.05]
    (one, *_), repairs = prepare((take(points), *others()), PAIRS)
    assert np.isnan(one.keypoints[70:90, 4]).all()
    assert np.isfinite(np.delete(one.keypoints, np.arange(70, 90), axis=0)).all()
    np.testing.assert_array_equal(np.delete(one.keypoints, 4, axis=1), np.delete(right, 4, axis=1))
    (sentence,) = repairs
    assert sentence.startswith("Take a: keypoint 4 is farther") and "20 of 200 samples, from sample 70" in sentence


def test_neighbours_that_a_tracker_puts_at_the_origin_are_not_observed_there():
    right = swinging()
    points = right.copy()
    points[70:76, 4:6], points[70:90, 6] = 0.0, np.nan
    (one, *_), repairs = prepare((take(points), *others()), PAIRS)
    assert np.isnan(one.keypoints[70:76, 4:6]).all()
    points[70:76, 4:6] = np.nan
    np.testing.assert_array_equal(one.keypoints, points)
    assert [text.split(" is at one")[0] for text in repairs] == ["Take a: keypoint 4", "Take a: keypoint 5"]


def test_lost_markers_at_one_place_are_not_observed_there_even_both_of_a_gripper():
    points = swinging()
    points[70:74, [0, 1, 4]] = 0.0
    (one, *_), repairs = prepare((take(points), *others()), PAIRS)
    assert np.isnan(one.keypoints[70:74, 4]).all() and np.isfinite(one.keypoints[:, [0, 1]]).all()
    np.testing.assert_allclose(one.keypoints[70:74, :2], swinging()[70:74, :2], atol=3e-3)
    assert repairs[0].startswith("Take a: keypoint 0 is at one place with another one in 4 of 200 samples")
    points[:, 5] = points[:, 4]
    with pytest.raises(ValueError, match=r"Keypoints 4 and 5 are at one place in 100 % .* leave one of the two out"):
        prepare((take(points),), PAIRS)


def test_a_marker_whose_tracker_holds_it_is_not_observed_meanwhile():
    right = swinging()
    points = right.copy()
    points[70:130, 4] = points[70, 4]
    (one, *_), (sentence,) = prepare((take(points), *others()), PAIRS)
    assert np.isnan(one.keypoints[71:130, 4]).all()
    points[71:130, 4] = np.nan
    np.testing.assert_array_equal(one.keypoints, points)
    assert sentence.startswith(
        "Take a: keypoint 4 repeats its last value to the last digit while its neighbours move in 59 of"
    )


def test_a_marker_that_is_misread_for_a_moment_is_not_observed_then():
    right = swinging()
    points = right.copy()
    points[70:72, 4] += [0.0, 0.03, 0.0]
    points[120, 0] += [0.0, 0.012, 0.0]
    (one, *_), sentences = prepare((take(points), *others()), PAIRS)
    assert np.isnan(one.keypoints[70:72, 4]).all() and np.isfinite(one.keypoints[72:, 4]).all()
    assert sentences[0].startswith(
        "Take a: keypoint 0 leaves its path while those around it keep to theirs in 1 of 200 samples, from"
    )
    assert sentences[1].startswith(
        "Take a: keypoint 4 leaves its path while those around it keep to theirs in 2 of 200 samples, from"
    )
    # a gripper's markers are known again from their neighbours in time
    (without, *_), _ = prepare((take(right), *others()), PAIRS)
    np.testing.assert_allclose(one.gripper_pose, without.gripper_pose, atol=2e-3)


def test_exchanged_markers_are_put_back_while_another_is_not_observed():
    right = swinging()
    right[40:150, 6] = np.nan
    points = exchanged(right, slice(60, 130), [0, 1, 2, 4, 3, 5, 6, 7, 8])
    restored, repairs = restore_order((take(points), *others()))
    np.testing.assert_array_equal(restored[0].keypoints, right)
    assert len(repairs) == 1 and "keypoints 3, 4 had exchanged their names in 70 of 200 samples" in repairs[0]


def test_a_bend_between_arms_nearer_than_the_keypoints_is_no_wrong_order():
    """Five keypoints on a U whose arms are half a spacing apart: its way is the shortest there is."""
    hanging = np.array([[0, 0, 0], [0, 0, -0.2], [0.05, 0, -0.39], [0.1, 0, -0.2], [0.1, 0, 0]])
    time = 0.01 * np.arange(100)
    points = hanging + 0.02 * np.sin(time)[:, None, None] + 1e-4 * np.random.default_rng(0).normal(size=(100, 5, 3))
    restored, repairs = restore_order((take(points),))
    np.testing.assert_array_equal(restored[0].keypoints, points)
    assert not repairs
    for order in ([0, 2, 1, 3, 4], [1, 0, 2, 3, 4], [0, 3, 1, 2, 4]):
        with pytest.raises(ValueError, match=r"folds back .* in their order"):
            restore_order((take(points[:, order]),))


@pytest.mark.parametrize("end", [0, 8])
def test_an_end_that_jumps_does_not_move_its_gripper(end):
    right = swinging()
    points = right.copy()
    points[70:72, end] = 0.0
    (one, *_), repairs = prepare((take(points), *others()), PAIRS)
    assert np.linalg.norm(one.keypoints - right, axis=-1).max() < 2e-3, "filled in"
    assert any(text.startswith(f"Take a: keypoint {end} is farther") for text in repairs)
    assert not any("accelerations" in text for text in repairs)


def test_a_jerk_of_a_gripper_is_told_and_kept():
    points = swinging()
    points[100:, :2] += 0.02
    (one, *_), repairs = prepare((take(points), *others()), PAIRS)
    assert len(one.time) == 200
    (sentence,) = repairs
    assert sentence.startswith("Sudden accelerations: gripper 0 of take a by ") and " at 1 s. " in sentence


def test_a_turn_that_no_arm_makes_is_told_and_one_that_is_back_is_filled_in():
    points = np.concatenate([swinging()[..., [0, 2]]])
    pose = poses_from_markers(points[:, 0], points[:, 1], points[:, 0])
    stays, back = np.stack([pose, pose], axis=1), np.stack([pose, pose], axis=1)
    stays[100:, 0, 2] += 0.5 * np.pi
    back[100, 1, 2] += np.pi
    setup = Setup(unit="m", on_grippers="ends")
    _, (sentence,) = prepare((take(points, pose=stays),), setup)
    assert sentence.startswith("Sudden accelerations: gripper 0 of take a by ") and "rad/s^2 at 0.99 s. " in sentence
    (one,), (sentence,) = prepare((take(points, pose=back),), setup)
    assert sentence.startswith("Take a: the pose of gripper 1 jumps away and back in 1 of 200 samples")
    np.testing.assert_allclose(one.gripper_pose[:, 1], pose, atol=0.02)


def test_a_gripper_never_seen_is_refused():
    points = swinging()
    points[:, 8] = np.nan
    with pytest.raises(ValueError, match="Gripper 1 is located by keypoints 7 and 8, which are never obs"):
        cut_at_gaps((take(points),), HELD)
    with pytest.raises(ValueError, match=r"7 and 8 are never observed together: keypoint 8 was never.* position into"):
        prepare((take(points),), PAIRS)
    pose = np.full((200, 2, 7), np.nan)
    pose[:, 0] = [0, 0, 0, 1, 0, 0, 0]
    with pytest.raises(ValueError, match="Gripper 1 has no pose in any sample"):
        cut_at_gaps((take(swinging(), pose=pose),), None)


def test_nothing_left_between_gaps_is_refused():
    points = swinging()
    points[::8, 0] = np.nan
    points[np.arange(200) % 16 < 9, 0] = np.nan
    with pytest.raises(ValueError, match=r"no stretch of at least 0\.5 s"):
        cut_at_gaps((take(points),), HELD)
    with pytest.raises(ValueError, match=r"no stretch of at least 0\.5 s .* And [0-9]+ more\.$"):
        cut_at_gaps(tuple(take(points, str(k)) for k in range(9)), HELD)


def test_millimetres_are_recognised_or_refused():
    points = swinging()
    takes, repairs = prepare((take(1000 * points),), Setup(unit=None))
    np.testing.assert_allclose(takes[0].keypoints, points, rtol=1e-12)
    assert "is plausible only in mm" in repairs[0]
    takes, repairs = prepare((take(1000 * points),), Setup(unit="mm"))
    np.testing.assert_allclose(takes[0].keypoints, points, rtol=1e-12)
    assert repairs == []
    with pytest.raises(ValueError, match=r"0\.684 m if they are in mm"):
        prepare((take(1000 * points),), Setup(unit="m"))
    with pytest.raises(ValueError, match="It may be in cm or in in: state which"):
        prepare((take(1.5 * points / 0.0254),), Setup(unit=None))


def test_poses_in_other_units_are_converted_too():
    points = swinging()
    pose = np.zeros((200, 2, 7))
    pose[..., :3], pose[..., 3] = points[:, [0, -1]], 1.0
    setup = Setup(unit="mm", on_grippers="ends")
    scaled = pose * [1000, 1000, 1000, 1, 1, 1, 1]
    takes, _ = prepare((take(1000 * points, pose=scaled),), setup)
    np.testing.assert_allclose(takes[0].gripper_pose, pose, atol=1e-12)


def test_a_left_handed_frame_is_mirrored_when_stated():
    points = swinging()
    frame = Frame("y", "left")
    takes, repairs = prepare((take(points @ frame.matrix),), Setup(frame=frame))
    np.testing.assert_allclose(takes[0].keypoints, points, atol=1e-12)
    assert repairs == []
    with pytest.raises(ValueError, match="state that y is up"):
        prepare((take(points @ frame.matrix),), Setup())


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.full((50, 9, 3), np.inf), "largest entry of keypoints is inf"),
        (np.full((50, 9, 3), np.nan), "never observed together"),
        (np.zeros((50, 4, 3)), "at least three keypoints, or five"),
        (np.zeros((50, 9, 3)), "expected 0.05 to 20"),
    ],
    ids=["infinite", "nothing observed", "too few", "all in one place"],
)
def test_numbers_that_are_no_recording_are_refused(points, message):
    with pytest.raises(ValueError, match=message):
        prepare((take(points),), PAIRS)


def test_takes_of_different_cables_are_refused():
    with pytest.raises(ValueError, match=r"shapes \(8, 3\), \(9, 3\)"):
        prepare((take(swinging()), take(swinging()[:, :8])), PAIRS)


def test_a_single_marker_on_a_gripper_does_not_tell_its_pose():
    with pytest.raises(ValueError, match="poses are not given, and only one keypoint is on each"):
        prepare((take(swinging()),), Setup(on_grippers="ends"))


def test_the_log_tells_of_repairs_and_carries_labels():
    points = exchanged(swinging(), slice(60, 130), [0, 1, 2, 4, 3, 5, 6, 7, 8])
    labelled = dataclasses.replace(take(points), labels={"split": "train", "motion": "swing"})
    second = dataclasses.replace(take(swinging(150, seed=5), "b"), labels={"split": "eval", "motion": "swing"})
    takes, repairs = prepare((labelled, second), PAIRS)
    log = gap_log_from_takes(takes, NOMINAL, source="Made up.", repairs=repairs)
    assert log.meta["source"].startswith("Made up. Take a: keypoints 3, 4 had exchanged")
    assert log.meta["split"] == ["train", "eval"] and log.meta["take"] == ["a", "b"]
    assert log.meta["motion"] == ["swing", "swing"] and log.meta["table"] is None and log.hold is None
    assert log.episode_length.tolist() == [200, 150]
    tangent = log.keypoints[0, :, 1] - log.keypoints[0, :, 0]
    w, x, y, z = np.moveaxis(log.gripper_pose[0, :, 0, 3:], -1, 0)
    own_x = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=-1)
    np.testing.assert_allclose(own_x, tangent / np.linalg.norm(tangent, axis=1, keepdims=True), atol=1e-4)
    np.testing.assert_array_equal(log.gripper_pose[0, :, 1, :3], log.keypoints[0, :, 8])


def test_a_guess_is_kept_as_one():
    takes, _ = prepare((take(swinging()),), PAIRS)
    assert "guessed" not in gap_log_from_takes(takes, NOMINAL, source="").meta
    guess = dataclasses.replace(NOMINAL, guessed=("linear_density_kg_per_m",))
    assert gap_log_from_takes(takes, guess, source="").meta["guessed"] == ["linear_density_kg_per_m"]


def test_the_arc_length_is_that_of_the_curve_and_not_of_its_chords():
    # The markers are on half a circle, at these arc lengths; straight lines between them are 0.3 % shorter.
    measured = measured_arclength((take(swinging()),))
    true = np.concatenate([[0.0], np.cumsum(SPACING)])
    assert abs(measured - true).max() < 5e-4
    chords = np.linalg.norm(np.diff(swinging(), axis=1), axis=-1).mean(axis=0).sum()
    assert true[-1] - chords > 4 * abs(measured[-1] - true[-1])


ON_TABLE = Setup(on_grippers="ends", hangs=False)


@pytest.mark.parametrize(("count", "angles"), [(3, (1.4, 1.8)), (4, (2.0, 2.6)), (4, (2.6, 1.2))])
def test_few_keypoints_of_an_ordinary_arch_keep_their_names(count, angles):
    right = arch_take(np.linspace(0.0, 1.0, count), np.linspace(*angles, 100))
    (made,), told = prepare((right,), ON_TABLE)
    np.testing.assert_allclose(made.keypoints, right.keypoints, atol=1e-12)
    assert told == []


def test_a_cable_that_is_pulled_straight_is_the_same_cable_however_few_keypoints_it_has():
    marks = np.linspace(0.0, 1.0, 7)
    bent, taut = np.full(40, 2.2) + 0.2 * np.linspace(0, 1, 40), np.linspace(0.1, 0.3, 40)
    takes, told = prepare((arch_take(marks, bent, "bent"), arch_take(marks, taut, "taut")), ON_TABLE)
    assert [one.name for one in takes] == ["bent", "taut"] and told == []
    three = np.linspace(0.0, 1.0, 3)
    takes = (*(arch_take(three, bent - 0.6, str(k)) for k in range(5)), arch_take(three, taut, "taut"))
    assert len(prepare(takes, ON_TABLE)[0]) == 6


def test_noise_at_a_high_rate_is_no_jump():
    time = 1e-3 * np.arange(2000)
    points = arch(np.linspace(0.0, 1.0, 5), 1.0 + 0.4 * np.sin(time))
    points += 2e-4 * np.random.default_rng(0).standard_normal(points.shape)
    pose = np.concatenate([points[:, [0, -1]], np.zeros((2000, 2, 1))], axis=2)
    parts, told = cut_at_gaps((Take("a", time, points, pose),), None)
    assert samples_of(parts) == [("a", 2000)] and told == []
    # as large as before, and lost samples are found
    lost = np.delete(np.arange(2000), np.arange(900, 1000))
    parts, told = cut_at_gaps((Take("a", time[:1900], points[lost], pose[lost]),), None)
    assert samples_of(parts) == [("a/1", 900), ("a/2", 1000)] and "the whole cable jumps" in told[0]


@pytest.mark.parametrize("interval", [1 / 100, 1 / 240])
def test_frames_lost_at_random_are_no_jumps_of_a_cable_that_moves_fast(interval):
    time, rng = interval * np.arange(1000), np.random.default_rng(0)
    points = arch(np.linspace(0.0, 1.0, 9), np.full(1000, 1.0))
    points[..., 1] += 0.2 * np.sin(2 * np.pi * time)[:, None]
    pose = np.concatenate([points[:, [0, -1]], np.zeros((1000, 2, 1))], axis=2)
    points[rng.random(1000) < 0.3] = np.nan
    parts, told = cut_at_gaps((Take("a", time, points, pose),), None)
    assert samples_of(parts) == [("a", 1000)] and told == []


def test_rounded_keypoints_that_rest_are_kept_without_poses():
    """But for one at the end, after which nothing tells it from a tracker that stopped."""
    moved = np.linspace(0.0, 1.0, 200)
    angles = 0.6 + 0.6 * np.append(np.zeros(15), moved**2)
    points = arch(np.linspace(0.0, 1.0, 9), angles).round(3)
    parts, told = cut_at_gaps((take(np.append(points, 0 * points[..., :1], axis=2)),), HELD)
    assert samples_of(parts) == [("a", 215)] and told == []


@pytest.mark.parametrize("moves", [False, True])
def test_rounded_keypoints_that_rest_with_the_grippers_are_kept(moves):
    angles = np.concatenate([np.linspace(0.6, 1.2, 100), np.full(30, 1.2), np.linspace(1.2, 0.6, 100)])
    right = arch_take(np.linspace(0.0, 1.0, 13), angles)
    pose = right.gripper_pose + 1e-5 * np.random.default_rng(1).standard_normal(right.gripper_pose.shape)
    if moves:
        pose[100:130, 0, 1] += 0.1 * np.linspace(0.0, 1.0, 30)
    parts, told = cut_at_gaps(
        (dataclasses.replace(right, keypoints=right.keypoints.round(3), gripper_pose=pose),), None
    )
    assert samples_of(parts) == ([("a/1", 100), ("a/2", 99)] if moves else [("a", 230)])
    assert len(told) == (2 if moves else 0)


@pytest.mark.parametrize(("length", "count", "noise"), [(0.2, 41, 5e-4), (1.0, 101, 2e-3), (1.0, 13, 5e-3)])
def test_noise_does_not_lengthen_the_measured_cable(length, count, noise):
    marks = np.linspace(0.0, length, count)
    one = arch_take(marks, np.linspace(0.5, 1.2, 400), noise=noise)
    np.testing.assert_allclose(measured_arclength((one,))[-1], length, rtol=4e-3)
