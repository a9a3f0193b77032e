"""Keypoints and gripper angles that no cable can have are refused, and those of a real recording are not."""

import dataclasses
import functools

import numpy as np
import pytest

from cablejax.cable import Cable
from cablejax.diagnose.recording import DiagnosisError
from cablejax.diagnose.recording import prepare as prepare_log
from cablejax.gaplog import Episode, GapLogError, gap_log_from_episodes, validate
from cablejax.log_setup import cable_fault, setup_fault
from cablejax.recordings.prepare import Setup, prepare
from cablejax.recordings.take import Take
from cablejax.simulate.elastica import elastica
from cablejax.types import GapLog

CABLE = Cable()
ARRAYS = ("keypoints", "gripper_pose", "gripper_command", "hold")


@functools.cache
def arch(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """An arch that closes and turns with both grippers: keypoints and gripper poses."""
    way = np.linspace(0.0, 1.0, samples)
    pose = np.zeros((samples, 2, 3))
    pose[:, 0], pose[:, 1] = [0.0, 0.0, 0.4], [0.9, 0.0, -0.4]
    pose[:, 0, 2] += 1.2 * way
    pose[:, 1, 2] -= 1.2 * way
    pose[:, 1, 0] -= 0.4 * way
    return np.stack([elastica(p, CABLE.length, CABLE.keypoint_arclength) for p in pose]), pose


def motion(heading: float = 0.0, samples: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """The same seen from a heading."""
    points, pose = arch(samples)
    turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    return points @ turn.T, np.concatenate([pose[..., :2] @ turn.T, pose[..., 2:] + heading], axis=-1)


def log_of(points: np.ndarray, pose: np.ndarray) -> GapLog:
    n = len(points)
    still = Episode("close", 0.1 * np.arange(n), points, pose, np.zeros((n, 2, 3)), np.zeros(n, bool))
    return gap_log_from_episodes([still, still], CABLE, source="test")


def changed(log: GapLog, name: str, change) -> GapLog:
    array = getattr(log, name).copy()
    change(array)
    return dataclasses.replace(log, **{name: array})


@pytest.mark.parametrize("heading", [0.0, 1.5, 3.1, -3.1, 20.0])
def test_a_plausible_log_is_accepted(heading):
    log = log_of(*motion(heading))
    # offsets as large as the library's effects of grasp and camera may be
    for offset in (-1.0, 1.0):
        validate(changed(log, "gripper_pose", lambda pose, by=offset: pose[..., 2].__iadd__(by)))
        validate(changed(log, "keypoints", lambda points, by=offset: points.__iadd__(0.5 * by)))


@pytest.mark.parametrize("heading", [0.0, 1.5, 3.1])
@pytest.mark.parametrize("gripper", [0, 1])
def test_an_angle_that_points_the_other_way_is_refused(heading, gripper):
    log = log_of(*motion(heading))
    with pytest.raises(GapLogError, match=rf"angle of gripper {gripper} 1\d\d degrees off the cable.*Add pi"):
        validate(changed(log, "gripper_pose", lambda pose: pose[..., gripper, 2].__iadd__(np.pi)))


@pytest.mark.parametrize("heading", [0.0, 1.5, 3.1])
def test_angles_in_degrees_are_refused(heading):
    log = log_of(*motion(heading))
    with pytest.raises(
        GapLogError, match=r"in degrees .* expected radians. Multiply it by pi / 180 \(in a layout: `angle_unit"
    ):
        validate(changed(log, "gripper_pose", lambda pose: pose[..., 2].__imul__(180 / np.pi)))


@pytest.mark.parametrize("far", [1e30, 1e3, 9.0])
def test_a_keypoint_out_of_reach_is_refused(far):
    log = log_of(*motion())

    def throw(points):
        points[1, 4, 3, 0] = far

    with pytest.raises(GapLogError, match=r"keypoint 3 of episode 1 .* m away from both grippers at 0.4 s.*NaN"):
        validate(changed(log, "keypoints", throw))


def test_an_import_marks_outliers_as_not_observed_and_says_so():
    points, pose = motion()
    points[2, 5] = [1000.0, 0.0]
    points[7, 1, 1] = -3.0
    take = Take("1", 0.1 * np.arange(len(points)), points, pose)
    (prepared,), said = prepare((take,), Setup(on_grippers="ends", hangs=False))
    missing = np.argwhere(np.isnan(prepared.keypoints).any(axis=-1))
    assert missing.tolist() == [[2, 5], [7, 1]]
    assert [text for text in said if "2 keypoints lay up to 1e+03 m from the rest" in text]
    kept = ~np.isnan(prepared.keypoints)
    np.testing.assert_array_equal(prepared.keypoints[kept], points[kept])


def test_angles_that_were_converted_from_degrees_and_were_none_are_told():
    points, pose = motion(0.3)
    assert setup_fault(log_of(points, pose)) is None
    small = pose * [1.0, 1.0, np.pi / 180]
    assert "turns 51 times as far" in str(setup_fault(log_of(points, small)))
    # one that hardly turns, and not with the cable, has an angle of its own
    steady = pose.copy()
    steady[..., 2] = 0.3 + 0.01 * np.random.default_rng(0).standard_normal(pose.shape[:2])
    assert "times as far" not in str(setup_fault(log_of(points, steady)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda angle: -angle, "with the other sign"),
        (lambda angle: angle + np.pi / 2, "a quarter turn back"),
        (lambda angle: angle - np.pi / 2, "a quarter turn further"),
        (lambda angle: np.radians(angle), "turns 5. times as far"),
        (lambda angle: 0 * angle, "is 0 rad in all samples, but the cable at it turns by"),
    ],
    ids=["negated", "quarter turn", "quarter turn back", "converted twice", "dead"],
)
def test_angles_that_another_reading_explains_are_not_diagnosed(change, words):
    points, pose = (whole[: 20 if "rad in all" in words else 12] for whole in motion(samples=20))
    log = log_of(points, np.concatenate([pose[..., :2], change(pose[..., 2:])], axis=-1))
    with pytest.raises(DiagnosisError, match=words):
        prepare_log(longer(log))


@pytest.mark.parametrize("heading", [0.0, 0.5, 1.5])
@pytest.mark.parametrize("offset", [-1.0, -0.6, 0.6, 1.0])
def test_a_clamp_as_askew_as_its_effect_may_be_is_diagnosed(heading, offset):
    points, pose = motion(heading)
    prepare_log(longer(log_of(points, pose + np.array([0.0, 0.0, offset]))))


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_one_gripper_may_stand_still_and_one_may_hardly_turn(noise):
    """Dense keypoints show the tangent with much noise; a gripper that turns by two degrees is not in other units."""
    cable = Cable(length=0.5, n_keypoints=51)
    swing = np.sin(np.linspace(0.0, np.pi, 30))
    for turn in (0.0, np.radians(2.0)):
        pose = np.zeros((30, 2, 3))
        pose[:, 0, 2], pose[:, 1, 0], pose[:, 1, 1], pose[:, 1, 2] = turn * swing, 0.4, 0.1 * swing, 0.8 * swing
        points = np.stack([elastica(one, cable.length, cable.keypoint_arclength) for one in pose])
        points = points + noise * np.random.default_rng(0).standard_normal(points.shape)
        still = Episode("swing", 0.1 * np.arange(30), points, pose, np.zeros((30, 2, 3)), np.zeros(30, bool))
        assert cable_fault(gap_log_from_episodes([still], cable, source="test")) is None


def test_a_gripper_that_does_not_turn_holds_the_end_of_a_cable_that_bends():
    """Its angle is the same in all samples, as the cable's at the clamp is."""
    pose = np.zeros((30, 2, 3))
    pose[:, 1, 0] = np.linspace(0.9, 0.6, 30)
    points = np.stack([elastica(one, CABLE.length, CABLE.keypoint_arclength) for one in pose])
    prepare_log(longer(log_of(points, pose)))


def longer(log: GapLog) -> GapLog:
    """The same motion there and back, until it may be diagnosed."""
    back = {name: np.concatenate([getattr(log, name), getattr(log, name)[:, ::-1]], axis=1) for name in ARRAYS}
    time = np.tile(0.1 * np.arange(back["keypoints"].shape[1]), (len(log.time), 1))
    count = np.full(len(log.time), time.shape[1], np.int32)
    return dataclasses.replace(log, **back, time=time, episode_length=count)


def test_the_end_of_a_short_cable_is_nearer_to_its_gripper():
    """A tenth of the length: a keypoint too few is no cable's end."""
    cable = Cable(length=0.4, n_keypoints=9)
    pose = np.tile([[0.0, 0.0, 0.4], [0.35, 0.0, -0.4]], (5, 1, 1))
    points = np.tile(elastica(pose[0], cable.length, cable.keypoint_arclength), (5, 1, 1))
    still = Episode("rest", 0.1 * np.arange(5), points, pose, np.zeros((5, 2, 3)), np.zeros(5, bool))
    assert cable_fault(gap_log_from_episodes([still], cable, source="test")) is None
    short = dataclasses.replace(still, keypoints=np.concatenate([points[:, :1], points[:, :-1]], axis=1))
    moved = gap_log_from_episodes([still], cable, source="test")
    assert "Keypoint N - 1 is 0.05" in str(cable_fault(dataclasses.replace(moved, keypoints=short.keypoints[None])))


def test_the_ends_of_a_long_cable_may_be_as_far_from_their_grippers_in_lengths_of_the_cable():
    cable = Cable(length=4.0, n_keypoints=9)
    pose = np.tile([[0.0, 0.0, 0.4], [3.5, 0.0, -0.4]], (5, 1, 1))
    points = np.tile(elastica(pose[0], cable.length, cable.keypoint_arclength), (5, 1, 1))
    for off, words in ((0.3, "None"), (0.5, "Keypoint 0 is 0.50 m from gripper 0")):
        seen = Episode(
            "rest", 0.1 * np.arange(5), points + np.array([0.0, off]), pose, np.zeros((5, 2, 3)), np.zeros(5, bool)
        )
        assert words in str(cable_fault(gap_log_from_episodes([seen], cable, source="test")))
