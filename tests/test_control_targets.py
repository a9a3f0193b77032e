"""The letters as targets, and targets from files."""

import dataclasses
import json

import numpy as np
import pytest

from cablejax.cable import Cable
from cablejax.control.targets import load_target, make_target, straight_start, target_from_keypoints
from cablejax.simulate.elastica import solve_elastica

CABLE = Cable()


@pytest.mark.parametrize("shape", ["U", "S", "Z"])
def test_letters_are_gentle_stable_equilibria_within_reach(shape):
    target = make_target(shape, CABLE)
    rest = solve_elastica(target.gripper_pose, CABLE.length)
    assert rest.stability() > 5.0
    assert np.abs(rest.curvature).max() < 12.0
    np.testing.assert_allclose(target.keypoints[[0, -1]], target.gripper_pose[:, :2], atol=1e-6)
    distance = np.linalg.norm(np.diff(target.gripper_pose[:, :2], axis=0))
    assert 0.2 < distance < 0.85
    assert target.keypoints.shape == (13, 2)


def test_letters_look_like_letters():
    u, s, z = (make_target(shape, CABLE).keypoints for shape in "USZ")
    mirror = np.array([-1.0, 1.0])
    np.testing.assert_allclose(u, u[::-1] * mirror, atol=1e-6)  # left and right arm alike, open at the top
    assert u[6, 1] == u[:, 1].min()
    for letter in (s, z):
        np.testing.assert_allclose(letter, -letter[::-1], atol=1e-6)  # half a turn maps the letter onto itself
    # The middle stroke crosses back: of an S from lower right to upper left, of a Z from upper right to lower left.
    assert (s[7] - s[5])[0] < 0 < (s[7] - s[5])[1]
    assert (z[7] - z[5])[0] < 0 and (z[7] - z[5])[1] < 0
    assert s[0, 1] < s[-1, 1] and z[0, 1] > z[-1, 1]


def test_letters_scale_with_the_cable():
    large = make_target("S", Cable(length=2.0))
    np.testing.assert_allclose(large.keypoints, 2 * make_target("S", CABLE).keypoints, atol=1e-5)


def test_straight_start_is_a_cable_with_slack_downwards():
    pose = straight_start(CABLE)
    rest = solve_elastica(pose, CABLE.length)
    assert np.linalg.norm(pose[1, :2] - pose[0, :2]) == pytest.approx(0.99)
    assert -0.08 < rest.position[:, 1].min() < -0.03
    assert rest.stability() > 0


@pytest.mark.parametrize("suffix", [".npz", ".json", ".csv"])
def test_target_from_a_file(tmp_path, suffix):
    made = make_target("U", CABLE)
    path = tmp_path / f"mine{suffix}"
    if suffix == ".npz":
        np.savez(path, keypoints=made.keypoints, gripper_pose=made.gripper_pose)
    elif suffix == ".json":
        path.write_text(json.dumps({"keypoints": made.keypoints.tolist(), "gripper_pose": made.gripper_pose.tolist()}))
    else:
        path.write_text("x,y\n" + "\n".join(f"{x:.9f},{y:.9f}" for x, y in made.keypoints))
    target = load_target(path, CABLE)
    assert target.name == "mine"
    np.testing.assert_allclose(target.keypoints, made.keypoints, atol=1e-8)
    # A file without poses gets them from the polyline's ends.
    np.testing.assert_allclose(target.gripper_pose, made.gripper_pose, atol=0.1 if suffix == ".csv" else 1e-8)


@pytest.mark.parametrize("shape", ["U", "S", "Z"])
@pytest.mark.parametrize("points", [2, 3, 4, 5, 13])
def test_length_of_a_polyline_is_not_mistaken_for_another_cable(shape, points):
    # few points cut the corners of a bent cable; that alone must not refuse it, and another length is seen all the same
    cable = dataclasses.replace(CABLE, n_keypoints=points)
    letter = make_target(shape, cable)
    letter.require_length(cable.length, "the model")
    target_from_keypoints("mine", letter.keypoints, cable)
    with pytest.raises(ValueError, match=r"the model is for a cable of 0.6 m: use a target of that length"):
        dataclasses.replace(letter, keypoints=6 * letter.keypoints).require_length(0.6 * cable.length, "the model")


def test_unfit_targets_are_refused():
    points = make_target("U", CABLE).keypoints
    with pytest.raises(ValueError, match=r"1\.\d+ m long, but the cable is 1 m long"):
        target_from_keypoints("mine", 1.2 * points, CABLE)
    with pytest.raises(ValueError, match="12 keypoints, but the cable is seen at 13"):
        target_from_keypoints("mine", points[:-1], CABLE)
    with pytest.raises(ValueError, match=r"not finite, at \[4\]"):
        target_from_keypoints("mine", np.where(np.arange(13)[:, None] == 4, np.nan, points), CABLE)
    with pytest.raises(ValueError, match="grippers are"):
        target_from_keypoints("mine", points, CABLE, gripper_pose=straight_start(CABLE))
    with pytest.raises(ValueError, match="complex"):
        target_from_keypoints("mine", points + 0j, CABLE)
    with pytest.raises(ValueError, match=r"1e.06 m from the origin"):
        target_from_keypoints("mine", points + 1e6, CABLE)
    with pytest.raises(ValueError, match="keypoints 11 and 12 1 m apart"):
        target_from_keypoints("mine", np.where(np.arange(13)[:, None] < 12, 0.0, [[1.0, 0.0]]), CABLE)
    pose = make_target("U", CABLE).gripper_pose
    for wrong in (pose * [1.0, 1.0, 180 / np.pi], pose + np.array([0.0, 0.0, np.pi])):
        with pytest.raises(ValueError, match="expected radians, both along the cable"):
            target_from_keypoints("mine", points, CABLE, gripper_pose=wrong)
    with pytest.raises(ValueError, match="expected one of U, S, Z"):
        make_target("Q", CABLE)


def test_unreadable_files_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_target(tmp_path / "none.npz", CABLE)
    path = tmp_path / "wrong.txt"
    path.write_text("")
    with pytest.raises(ValueError, match="neither U, S or Z nor a file"):
        load_target(path, CABLE)
    path = tmp_path / "wrong.csv"
    path.write_text("x,y\n1.0,apple\n")
    with pytest.raises(ValueError, match="could not be read"):
        load_target(path, CABLE)
    path = tmp_path / "wrong.json"
    path.write_text("{}")
    with pytest.raises(ValueError, match="expected an object with the field"):
        load_target(path, CABLE)
    path = tmp_path / "pickled.npz"
    np.savez(path, keypoints=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="could not be read"):
        load_target(path, CABLE)
