"""A cable that is shorter than its keypoints are apart is refused, noise, gaps and slight stretch are not."""

import dataclasses

import numpy as np
import pytest

from cablejax.cable import Cable, differing
from cablejax.cable_length import require_fitting_length
from cablejax.recordings.assemble import Nominal, gap_log_from_takes
from cablejax.recordings.take import Take
from cablejax.spatial.windows import windows_of

MARKS = np.linspace(0.0, 1.0, 13)
NAME = "meta.keypoint_arclength_m"
NOMINAL = Nominal(diameter=0.01, linear_density=0.05, bending_stiffness=0.01)


def taut(noise: float = 0.0, scale: float = 1.0) -> np.ndarray:
    """A straight cable that sways, shape [200, 13, 3]."""
    points = np.zeros((200, 13, 3))
    points[..., 0] = scale * MARKS
    points[..., 1] = 0.2 * np.sin(0.1 * np.arange(200))[:, None]
    return points + noise * np.random.default_rng(0).standard_normal(points.shape)


@pytest.mark.parametrize("noise", [0.0, 1e-3, 5e-3, 2e-2])
def test_noise_and_slight_stretch_are_allowed_for(noise):
    require_fitting_length([taut(noise)], MARKS, NAME)
    require_fitting_length([taut(noise, scale=1.01)], MARKS, NAME)


@pytest.mark.parametrize("noise", [0.0, 1e-3, 5e-3])
def test_a_cable_that_is_too_short_is_refused(noise):
    with pytest.raises(ValueError, match=r"gives them .* m of cable.*correct meta\.keypoint_arclength_m"):
        require_fitting_length([taut(noise, scale=1.06)], MARKS, NAME)


def test_one_mark_in_the_wrong_place_is_refused_and_keypoints_not_seen_are_left_out():
    marks = MARKS.copy()
    marks[6] += 0.06
    with pytest.raises(ValueError, match="From keypoint 6 to 7 "):
        require_fitting_length([taut()], marks, NAME)
    hidden = taut()
    hidden[:, 6] = np.nan
    require_fitting_length([hidden], marks, NAME)
    require_fitting_length([hidden[:2]], MARKS, NAME)


def take() -> Take:
    points = taut()
    pose = np.zeros((200, 2, 7))
    pose[..., :3], pose[..., 3] = points[:, [0, -1]], 1.0
    return Take(name="a", time=0.02 * np.arange(200), keypoints=points, gripper_pose=pose)


def test_a_log_in_space_is_checked():
    log = gap_log_from_takes([take()], NOMINAL, source="test")
    # its length fits, but nothing of it moves by itself
    with pytest.raises(ValueError, match="All 13 keypoints move with the grippers, as if the cable were rigid"):
        windows_of(log)
    meta = {**log.meta, "cable": {**log.meta["cable"], "length_m": 0.9}, NAME.split(".")[1]: (0.9 * MARKS).tolist()}
    with pytest.raises(ValueError, match=r"correct meta\.keypoint_arclength_m"):
        windows_of(dataclasses.replace(log, meta=meta))


def test_stated_arc_lengths_are_checked_at_the_import():
    for factor in (1.0, 1.1):
        stated = tuple(factor * MARKS)
        gap_log_from_takes([take()], dataclasses.replace(NOMINAL, arclength=stated), source="test")
    with pytest.raises(ValueError, match="correct keypoint_arclength_m"):
        gap_log_from_takes([take()], dataclasses.replace(NOMINAL, arclength=tuple(0.9 * MARKS)), source="test")


def test_two_keypoints_of_a_cable_may_come_as_near_as_they_like():
    ends = np.zeros((50, 2, 2))
    ends[:, 1, 0] = np.linspace(0.2, 0.95, 50)
    require_fitting_length([ends], np.array([0.0, 1.0]), NAME)


def test_cables_given_by_lists_are_hashable_and_differ_by_more_than_rounding_only():
    listed = Cable(n_keypoints=3, marks=[0.0, 0.3, 1.0], grasp=["clamped", "clamped"])
    assert hash(listed) == hash(Cable(n_keypoints=3, marks=(0.0, 0.3, 1.0)))
    assert not differing(listed, Cable(n_keypoints=3, marks=(0.0, 0.1 + 0.2, 1.0)))
    assert not differing(Cable(n_keypoints=3), Cable(n_keypoints=3, marks=(0.0, 0.5, 1.0)))
    assert "marks" in differing(listed, Cable(n_keypoints=3))


@pytest.mark.parametrize("marks", [[0, 0.1, 0.5, 0.9, 1], [0, 0.03, 0.5, 0.97, 1], [0, 0.5, 1]])
def test_a_ring_is_long_enough_wherever_its_keypoints_are(marks):
    angle = 2 * np.pi * np.array(marks)
    ring = np.stack([np.sin(angle), 1 - np.cos(angle)], axis=-1) / (2 * np.pi)
    require_fitting_length([np.repeat(ring[None], 20, axis=0)], np.array(marks, float), NAME)
    with pytest.raises(ValueError, match="the cable usually measures"):
        require_fitting_length([np.repeat(0.8 * ring[None], 20, axis=0)], np.array(marks, float), NAME)
