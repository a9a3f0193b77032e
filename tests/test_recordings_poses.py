"""Poses from marker pairs, frames and units."""

import dataclasses
import re

import jax
import numpy as np
import pytest

from cablejax.arrays import quaternion_product
from cablejax.log_setup import misread_quaternions
from cablejax.poses import (
    poses_at,
    poses_from_markers,
    rotated,
    smallest_rotation,
    transported_frames,
    twists,
    without_misreadings,
)
from cablejax.recordings.frames import (
    AXES,
    Frame,
    into_frame,
    require_along_x,
    require_hanging,
    require_rigid,
)
from cablejax.recordings.prepare import Setup
from cablejax.recordings.take import Take
from cablejax.recordings.units import METRES, recognised_unit, require_metres
from cablejax.simulate.pose import integrate_pose
from recording_cases import swinging, take

RANDOM = np.random.default_rng(0)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def wandering(samples: int = 200) -> np.ndarray:
    """Quaternions that turn smoothly."""
    steps = 0.05 * RANDOM.normal(size=(samples, 4))
    steps[0, 0] += 1
    return unit(np.cumsum(steps, axis=0))


def test_the_smallest_rotation_turns_one_into_the_other_about_their_normal():
    start, end = unit(RANDOM.normal(size=(2, 100, 3)))
    turn = smallest_rotation(start, end)
    np.testing.assert_allclose(rotated(turn, start), end, atol=1e-12)
    np.testing.assert_allclose((turn[:, 1:] * start).sum(axis=1), 0, atol=1e-12)
    np.testing.assert_allclose(rotated(smallest_rotation(start, -start), start), -start, atol=1e-12)
    np.testing.assert_array_equal(smallest_rotation(np.array([1.0, 0, 0]), np.array([-1.0, 0, 0])), [0, 0, 0, 1])


def test_a_tangent_that_is_not_known_leaves_the_other_frames_known():
    angle = np.linspace(0, 1, 20)[:, None]
    tangent = unit(np.concatenate([np.cos(3 * angle), np.sin(2 * angle), np.sin(5 * angle)], axis=1))
    seen = np.delete(tangent, [0, 7], axis=0)
    tangent[[0, 7]] = np.nan
    quaternion = transported_frames(tangent)
    assert np.isnan(quaternion[[0, 7]]).all()
    np.testing.assert_array_equal(np.delete(quaternion, [0, 7], axis=0), transported_frames(seen))
    assert np.isnan(transported_frames(tangent[[0, 7]])).all()


def test_frames_are_transported_without_turning_about_the_tangent():
    angle = np.linspace(0, 1, 400)[:, None]
    tangent = unit(np.concatenate([np.cos(3 * angle), np.sin(2 * angle), np.sin(5 * angle)], axis=1))
    quaternion = transported_frames(tangent)
    np.testing.assert_allclose(rotated(quaternion, np.tile([1.0, 0, 0], (400, 1))), tangent, atol=1e-12)
    np.testing.assert_allclose(quaternion[0], smallest_rotation(np.array([1.0, 0, 0]), tangent[0]), atol=1e-15)
    spin = quaternion_product(quaternion[1:], quaternion[:-1] * [1.0, -1, -1, -1])[:, 1:]
    middle = unit(tangent[1:] + tangent[:-1])
    assert abs((spin * middle).sum(axis=1)).max() < 1e-12
    assert abs(np.diff(quaternion, axis=0)).max() < 0.02


def test_planar_poses_have_a_continuous_angle():
    angle = np.linspace(0, 9, 50)
    first = RANDOM.normal(size=(50, 2))
    along = 0.03 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    pose = poses_from_markers(first, first + along, first)
    np.testing.assert_allclose(pose[:, 2], angle, atol=1e-12)
    np.testing.assert_array_equal(pose[:, :2], first)


def test_markers_in_one_place_are_refused():
    points = np.zeros((3, 3))
    with pytest.raises(ValueError, match="in one place in sample 0"):
        poses_from_markers(points, points, points)


@pytest.mark.parametrize("width", [3, 7])
def test_twists_lead_from_pose_to_pose(width):
    time = np.cumsum(RANDOM.uniform(0.01, 0.03, 20))
    pose = RANDOM.normal(size=(20, 2, width))
    if width == 7:
        pose[..., 3:] = np.stack([wandering(20), -wandering(20)], axis=1)
    speed = twists(time, pose)
    assert speed.shape == (20, 2, 3 if width == 3 else 6) and (speed[-1] == 0).all()
    with jax.enable_x64(True):
        for t in range(19):
            there = np.asarray(integrate_pose(pose[t], speed[t], float(time[t + 1] - time[t])))
            np.testing.assert_allclose(there, pose[t + 1], atol=1e-9)


@pytest.mark.parametrize("handedness", ["right", "left"])
@pytest.mark.parametrize("up", AXES)
def test_every_frame_becomes_right_handed_with_z_up(up, handedness):
    frame = Frame(up, handedness)
    axis = np.zeros(3)
    axis["xyz".index(up[-1])] = -1 if up[0] == "-" else 1
    np.testing.assert_array_equal(frame.matrix @ axis, [0, 0, 1])
    assert np.linalg.det(frame.matrix) == pytest.approx(1 if handedness == "right" else -1)
    # Orientations follow the positions: a direction fixed to a gripper stays so.
    quaternion = wandering()
    points = swinging()
    points[:, 1] = points[:, 0] + 0.03 * rotated(quaternion, np.tile([0.6, 0.8, 0.0], (200, 1)))
    pose = np.concatenate([points[:, [0, -1]], np.stack([quaternion, wandering()], axis=1)], axis=-1)
    turned = into_frame(take(points, pose=pose), frame)
    require_rigid((turned,), ((0, 1),))
    np.testing.assert_allclose(turned.keypoints @ frame.matrix, points, atol=1e-12)
    # the axis along the cable is a gripper's own x axis, whatever axis points up in the world
    before, after = (rotated(p[..., 3:], np.array([1.0, 0.0, 0.0])) for p in (pose, turned.gripper_pose))
    np.testing.assert_allclose(after, before @ frame.matrix.T, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(turned.gripper_pose[..., 3:], axis=-1), 1.0, atol=1e-12)


def test_a_planar_take_is_mirrored_and_has_no_up():
    flat = dataclasses.replace(take(swinging()[..., :2]), gripper_pose=np.full((len(swinging()), 2, 3), 0.5))
    mirrored = into_frame(flat, Frame("z", "left"))
    np.testing.assert_array_equal(mirrored.keypoints, flat.keypoints * [1, -1])
    np.testing.assert_array_equal(mirrored.gripper_pose, flat.gripper_pose * [1, -1, -1])
    with pytest.raises(ValueError, match="y up, but the keypoints have x and y only"):
        into_frame(flat, Frame("y"))


@pytest.mark.parametrize("up", AXES)
def test_a_cable_that_does_not_hang_down_names_the_vertical(up):
    stated = Frame()
    points = swinging() @ Frame(up).matrix  # a recording whose vertical is `up`
    require_hanging((into_frame(take(points), Frame(up)),), Frame(up))
    if up != "z":
        with pytest.raises(ValueError, match=f"state that {up} is up"):
            require_hanging((into_frame(take(points), stated),), stated)


def test_a_taut_cable_does_not_say_what_is_up():
    straight = np.linspace([0.0, 0, 1], [0.8, 0, 1], 9) + RANDOM.normal(scale=1e-3, size=(50, 9, 3))
    require_hanging((take(straight),), Frame("-z"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda points, pose: (points * [1, -1, 1], pose), "positions are mirrored along y"),
        (lambda points, pose: (points[..., [1, 0, 2]], pose), "x and y of the positions are exchanged"),
        (lambda points, pose: (points, np.concatenate([pose[..., :3], np.roll(pose[..., 3:], -1, -1)], -1)), "last"),
        (lambda points, pose: (points, pose * [1, 1, 1, 1, -1, -1, -1]), "inverted"),
        (lambda points, pose: (points, pose[:, ::-1]), "Check which gripper"),
    ],
    ids=["mirrored", "exchanged", "scalar last", "inverted", "other gripper"],
)
def test_orientations_of_another_frame_are_refused_and_the_frame_named(change, message):
    quaternion = wandering(600)
    points = swinging(600)
    points[:, 1] = points[:, 0] + 0.03 * rotated(quaternion, np.tile([0.6, 0.5, 0.62], (600, 1)))
    pose = np.concatenate([points[:, [0, -1]], np.stack([quaternion, wandering(600)], axis=1)], axis=-1)
    require_rigid((take(points, pose=pose),), ((0, 1),))
    wrong, other = change(points, pose)
    with pytest.raises(ValueError, match=message) as raised:
        require_rigid((take(wrong, pose=other),), ((0, 1),))
    assert "turn against its orientation" in str(raised.value)


@pytest.mark.parametrize(("axis", "name"), [((0.1, 0.99, 0.0), "y"), ((0.2, 0.1, -0.97), "-z"), ((-1.0, 0.1, 0), "-x")])
def test_a_gripper_whose_x_axis_is_not_along_its_markers_is_refused(axis, name):
    quaternion = wandering()
    points = swinging()
    points[:, 1] = points[:, 0] + 0.03 * rotated(quaternion, np.tile(axis, (200, 1)))
    pose = np.concatenate([points[:, [0, -1]], np.stack([quaternion, wandering()], axis=1)], axis=-1)
    require_rigid((take(points, pose=pose),), ((0, 1),))
    with pytest.raises(ValueError, match=f"nearest to its {name} axis; expected x"):
        require_along_x((take(points, pose=pose),), ((0, 1),))
    points[:, 1] = points[:, 0] + 0.03 * rotated(quaternion, np.tile([0.9, 0.3, 0.3], (200, 1)))
    require_along_x((take(points, pose=pose),), ((0, 1),))


@pytest.mark.parametrize("words", ["have their scalar last", "are inverted"])
def test_quaternions_read_in_another_way_are_named_where_only_the_cable_shows_it(words):
    """With one keypoint on each gripper, and the cable bent by 17 degrees until the next one."""
    angle = 0.3 * np.sin(0.05 * np.arange(200))
    tilt = np.stack([np.cos(angle), 0 * angle, np.sin(angle), 0 * angle], axis=1)
    along, points, pose = np.tile([np.cos(0.3), np.sin(0.3), 0.0], (200, 1)), swinging(), []
    for end, inner, turn in ((0, 1, 0.7), (-1, -2, 0.6)):
        quaternion = quaternion_product(np.array([np.cos(turn), 0.0, 0.0, np.sin(turn)]), tilt)
        points[:, inner] = points[:, end] + (1 if inner == 1 else -1) * 0.1 * rotated(quaternion, along)
        pose.append(np.concatenate([points[:, end], quaternion], axis=1))
    right = np.stack(pose, axis=1)
    assert misread_quaternions(points, right[..., 3:]) is None
    wrong = right * [1, 1, 1, 1, -1, -1, -1]
    if "last" in words:
        wrong[..., 3:] = np.roll(right[..., 3:], -1, axis=-1)
    fault = misread_quaternions(points, wrong[..., 3:])
    assert re.search(rf"x axes of grippers 0 and 1 are .* if the quaternions {words}: expected qw", fault or "")


def test_units_are_recognised_by_the_length_of_the_cable():
    assert METRES == {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
    assert recognised_unit(1037.0, (0.3, 3.0)) == ("mm",)
    assert recognised_unit(41.0, (0.3, 3.0)) == ("cm", "in")
    require_metres(1.0, "m")
    with pytest.raises(ValueError, match=r"measures 1037 m, expected 0.05 to 20.*1.04 m if they are in mm"):
        require_metres(1037.0, "m")
    with pytest.raises(ValueError, match="'furlong', expected one of m, cm, mm, in"):
        Setup(unit="furlong")


def test_a_take_of_wrong_shape_is_refused():
    with pytest.raises(ValueError, match=r"sample 2: the time is 0\.1 s after 0\.1 s, expected increasing times"):
        Take("a", np.array([0.0, 0.1, 0.1]), np.zeros((3, 5, 3)))
    with pytest.raises(ValueError, match=r"keypoints has shape \(3, 5\)"):
        Take("a", np.arange(3.0), np.zeros((3, 5)))
    with pytest.raises(ValueError, match=r"gripper_pose has shape \(3, 2, 3\), expected \(3, 2, 7\)"):
        Take("a", np.arange(3.0), np.zeros((3, 5, 3)), np.zeros((3, 2, 3)))


def test_twists_of_angles_that_are_wrapped():
    time = 0.1 * np.arange(60)
    angle = 3.0 + 0.2 * time
    pose = np.zeros((60, 2, 3))
    pose[:, 1, 2] = (angle + np.pi) % (2 * np.pi) - np.pi
    twist = twists(time, pose)
    np.testing.assert_allclose(twist[:-1, 1, 2], 0.2, atol=1e-9)
    np.testing.assert_array_equal(twist[-1], 0.0)


def test_a_pose_that_is_not_known_spoils_its_neighbourhood_alone():
    """Quaternions of either sign are one rotation, before and after the gap."""
    time = np.arange(6.0)
    pose = np.tile(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), (6, 1))
    pose[4:] *= -1.0
    pose[:, 0] = time
    pose[1] = np.nan
    found = poses_at(np.array([0.5, 2.5, 3.5, 4.5]), time, pose)
    assert np.isnan(found[0]).all()
    np.testing.assert_allclose(found[1:, 0], [2.5, 3.5, 4.5])
    np.testing.assert_allclose(np.abs(found[1:, 3:]), np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)), atol=1e-12)


def test_an_angle_between_two_on_either_side_of_half_a_turn_is_near_both():
    """Whole turns are those of the pose before: measured poses stay as they are."""
    time = np.arange(4.0)
    angle = np.array([3.10, 3.14, -3.12, -3.08])
    pose = np.stack([np.zeros(4), np.zeros(4), angle], axis=1)
    found = poses_at(np.array([0.5, 1.5, 2.5]), time, pose)[:, 2]
    np.testing.assert_allclose(found, [3.12, (3.14 - 3.12 + 2 * np.pi) / 2, -3.10], atol=1e-12)


def swaying(width: int) -> tuple[np.ndarray, np.ndarray]:
    """Times and poses of two grippers that sway and turn, at 20 Hz."""
    time = 0.05 * np.arange(200)
    turn = 2.5 + np.sin(0.5 * time)
    place = np.stack([0.2 * np.sin(time), 0.1 * np.cos(0.7 * time), 0.05 * np.sin(0.3 * time)], axis=1)
    if width == 3:
        one = np.concatenate([place[:, :2], turn[:, None]], axis=1)
    else:
        zero = np.zeros_like(time)
        one = np.concatenate([place, np.stack([np.cos(turn / 2), zero, zero, np.sin(turn / 2)], axis=1)], axis=1)
    return time, np.stack([one, one], axis=1)


def test_a_pose_that_is_not_known_changes_no_other():
    time, pose = swaying(3)
    wrong = pose.copy()
    wrong[10, 0] = np.nan
    wrong[150, 0, 2] -= np.pi
    found, words = without_misreadings(time, wrong)
    assert np.isnan(found[10, 0]).all() and "in 1 of 200 samples" in words[0]
    np.testing.assert_allclose(np.delete(found, 10, axis=0), np.delete(pose, 10, axis=0), atol=2e-3)


@pytest.mark.parametrize("width", [3, 7])
def test_readings_that_jump_away_and_back_are_on_a_line(width):
    time, pose = swaying(width)
    wrong = pose.copy()
    if width == 3:
        wrong[50, 0, 2] -= np.pi
        wrong[80:83, 0, 2] += 1.5
    else:
        # half a turn about x, and the same rotation as before by the other sign
        wrong[50, 0, 3:] = quaternion_product(pose[50, 0, 3:], np.array([0.0, 1.0, 0.0, 0.0]))
        wrong[80:83, 0, 3:] *= -1.0
    wrong[120, 1, 0] += 0.4
    found, words = without_misreadings(time, wrong)
    if width == 7:
        found[..., 3:] *= np.sign((found * pose)[..., 3:].sum(axis=-1, keepdims=True))
    np.testing.assert_allclose(found, pose, atol=2e-3)
    first, second = words[0], words[1]
    count = 4 if width == 3 else 1
    assert first.startswith(f"jumps away and back in {count} of 200 samples, for example by 3.")
    assert "rad at 2.5 s: taken" in first and "by 0.41 m at 6 s: taken" in second


@pytest.mark.parametrize("width", [3, 7])
def test_poses_that_arms_can_have_are_not_touched(width):
    """Noise, jumps that stay, a quick motion there and back, and what is not known."""
    time, pose = swaying(width)
    pose[:, :, :2] += np.random.default_rng(0).normal(0.0, 3e-3, (200, 2, 2))
    pose[60:, 0, 0] += 0.5
    pose[100:110, 1, 1] += 0.15 * np.sin(np.linspace(0.0, np.pi, 10))
    pose[150, 1] = np.nan
    found, words = without_misreadings(time, pose)
    assert words == {}
    np.testing.assert_array_equal(found, pose)
