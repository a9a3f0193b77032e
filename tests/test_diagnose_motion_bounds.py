"""Bounds of a motion: their file, and what they find on grippers and on the cable."""

from __future__ import annotations

import numpy as np
import pytest

from cablejax.cable import Cable, Discretisation
from cablejax.diagnose.motion_bounds import (
    Bounds,
    _near_snapping,
    cable_beyond,
    curvature,
    grippers_beyond,
    read_bounds,
    refined,
)
from cablejax.diagnose.safe_motions import INTERVAL, safe_motions
from cablejax.simulate.elastica import elastica

CONFIG = Discretisation(n_links=17)
ARCH = np.array([[0.0, 0.0, 0.4], [0.85, 0.0, -0.4]])
EVERY = """
workspace_m = [[-0.5, -0.4], [1.5, 0.9]]
keep_out_m = [[0.4, 0.6, 0.05], [0.1, -0.3, 0.1]]
speed_m_per_s = 0.04
turn_rate_rad_per_s = 0.2
min_distance_m = 0.3
max_distance_m = 0.9
bend_radius_m = 0.05
duration_s = 25
"""


def test_file_gives_the_bounds(tmp_path):
    (tmp_path / "bounds.toml").write_text(EVERY)
    assert read_bounds(tmp_path / "bounds.toml") == Bounds(
        workspace=((-0.5, -0.4), (1.5, 0.9)),
        keep_out=((0.4, 0.6, 0.05), (0.1, -0.3, 0.1)),
        speed=0.04,
        turn_rate=0.2,
        min_distance=0.3,
        max_distance=0.9,
        bend_radius=0.05,
        duration=25,
    )
    (tmp_path / "empty.toml").write_text("")
    assert read_bounds(tmp_path / "empty.toml") == Bounds()


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("speed = 0.1", "speed without its unit: write speed_m_per_s, in m/s"),
        ("bend_radius_mm = 30", "Did you mean bend_radius_m"),
        ("colour = 1", "unknown key 'colour'. Expected workspace_m, keep_out_m"),
        ("speed_m_per_s = -0.1", "speed_m_per_s is -0.1, expected a number from 0.0001 to 10 m/s"),
        ("speed_m_per_s = 50", "expected a number from 0.0001 to 10 m/s"),
        ("turn_rate_rad_per_s = 'fast'", "turn_rate_rad_per_s is 'fast'"),
        ("bend_radius_m = nan", "bend_radius_m is nan"),
        ("duration_s = 1e5", "expected a number from 5 to 300 s"),
        ("workspace_m = [[1, 1], [0, 0]]", "expected"),
        ("workspace_m = [0, 0, 1, 1]", r"expected [[x, y], [x, y]], the lowest and the highest corner, in metres"),
        ("keep_out_m = [[0.1, 0.2]]", r"expected [[x, y, radius], ...], in metres"),
        ("keep_out_m = [[0.1, 0.2, -0.1]]", "keep_out_m"),
        ("keep_out_m = 3", "keep_out_m is 3"),
        ("min_distance_m = 0.5\nmax_distance_m = 0.4", "expected the first below the second"),
        ("speed_m_per_s =", "is no TOML"),
    ],
)
def test_file_is_refused_with_what_is_wrong(tmp_path, line, words):
    path = tmp_path / "bounds.toml"
    path.write_text(line)
    with pytest.raises(ValueError) as error:
        read_bounds(path)
    assert words in str(error.value) and str(path) in str(error.value)


def test_file_that_is_not_there(tmp_path):
    with pytest.raises(ValueError, match="There is no file"):
        read_bounds(tmp_path / "none.toml")


def test_safe_motions_keep_the_default_bounds():
    for name, poses in safe_motions(CONFIG, ARCH).items():
        assert grippers_beyond(Bounds(), CONFIG, poses, INTERVAL) == {}, name


@pytest.mark.parametrize(
    ("bounds", "name"),
    [
        (Bounds(workspace=((-1, -1), (1, 0.1))), "workspace"),
        (Bounds(keep_out=((0.0, 0.15, 0.02),)), "keep_out"),
        (Bounds(speed=0.02), "speed"),
        (Bounds(turn_rate=0.01), "turn_rate"),
        (Bounds(max_distance=0.8), "distance"),
        (Bounds(min_distance=0.9), "distance"),
        (Bounds(duration=20), "duration"),
    ],
)
def test_each_bound_on_the_grippers_is_found(bounds, name):
    moved = safe_motions(CONFIG, ARCH)["translation" if name != "turn_rate" else "ramp_hold"]
    beyond = grippers_beyond(bounds, CONFIG, moved, INTERVAL)
    assert list(beyond) == [name] and beyond[name] > 0


def test_disc_between_the_grippers_is_free_for_them_and_not_for_the_cable():
    still = np.repeat(ARCH[None], 20, axis=0)
    straight = np.linspace(ARCH[0, :2], ARCH[1, :2], 13)[None, None].repeat(20, axis=1)
    # between two keypoints, which are 7 cm apart
    bounds = Bounds(keep_out=((0.46, 0.0, 0.02),))
    assert grippers_beyond(bounds, CONFIG, still, INTERVAL) == {}
    assert list(cable_beyond(bounds, CONFIG, still, straight)) == ["keep_out"]
    away = Bounds(keep_out=((0.46, 0.035, 0.02),))
    assert cable_beyond(away, CONFIG, still, straight) == {}
    assert list(cable_beyond(away, CONFIG, still, straight, margin=0.02)) == ["keep_out"]


def test_curvature_of_a_circle_and_its_bound():
    angle = np.linspace(0, 2.5, 13)
    circle = 0.2 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    np.testing.assert_allclose(curvature(circle, 0.2 * angle), 5.0, rtol=1e-6)
    fine = refined(circle, 0.2 * angle)
    np.testing.assert_allclose(np.linalg.norm(fine - [0.0, 0.2], axis=1), 0.2, rtol=3e-4)
    still, points = np.repeat(ARCH[None], 5, axis=0), np.repeat(circle[None, None], 5, axis=1)
    assert cable_beyond(Bounds(bend_radius=0.19), CONFIG, still, points) == {}
    assert list(cable_beyond(Bounds(bend_radius=0.21), CONFIG, still, points)) == ["bend_radius"]


def test_cable_that_jumps_or_breaks_down_is_found():
    still = np.repeat(ARCH[None], 20, axis=0)
    points = np.linspace(ARCH[0, :2], ARCH[1, :2], 13)[None, None].repeat(20, axis=1)
    points[:, 10:, 3:-3, 1] += 0.1
    assert "snap_through" in cable_beyond(Bounds(), CONFIG, still, points)
    points[:] = np.nan
    assert list(cable_beyond(Bounds(), CONFIG, still, points)) == ["snap_through"]


def test_way_through_a_snap_is_found():
    # both grippers turn from one side to the other while they are close: the arch has to change sides
    share = np.linspace(0, 1, 300)[:, None, None]
    poses = ARCH * [0.8, 1, 1] * (1 - share) + ARCH * [0.8, 1, -3.5] * share
    assert list(grippers_beyond(Bounds(), CONFIG, poses, INTERVAL)) == ["snap_through"]


def test_snapping_does_not_depend_on_the_size_of_the_cable():
    """A gripper that only turns: its way is compared with the cable's, which is as much longer as the cable is."""
    begin, end = (np.array([[0.0, 0.0, angle], [0.87, 0.0, -0.17]]) for angle in (0.17, -1.05))
    found = []
    for length in (0.2, 1.0, 3.0):
        config = Discretisation(Cable(length=length, diameter=0.01 * length), n_links=17)
        poses = np.linspace(begin, end, 101) * [length, length, 1.0]
        points = np.linspace(poses[:, 0, :2], poses[:, 1, :2], 13, axis=1)
        points[50:, 3:-3, 1] += 0.02 * length
        simulated = cable_beyond(Bounds(), config, poses, points[None])
        found.append([_near_snapping(config, poses), simulated["snap_through"]])
    np.testing.assert_allclose(found, found[1:2] * 3, rtol=1e-3)
    assert min(found[1]) > 0 and max(found[1]) < 10


def test_angles_that_need_more_cable_are_out_of_reach():
    poses = np.repeat(np.array([[[0.0, 0.0, 1.2], [0.97, 0.0, -1.2]]]), 20, axis=0)
    assert list(grippers_beyond(Bounds(), CONFIG, poses, INTERVAL)) == ["reach"]


def test_bounds_in_lengths_follow_the_cable():
    short = Cable(length=0.6)
    assert Bounds().distances(short.length) == pytest.approx((0.09, 0.597))
    assert Bounds().radius(short.length) == pytest.approx(0.018)
    assert Bounds(max_distance=5.0).distances(short.length)[1] == pytest.approx(0.597)


def test_three_keypoints_show_the_curvature_of_their_circle():
    angle = np.linspace(0.0, 1.0, 3)
    points = 0.25 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=-1)
    np.testing.assert_allclose(curvature(points, 0.25 * angle), 4.0)
    straight = refined(points[:2], 0.25 * angle[:2])
    assert len(straight) == len(refined(points, 0.25 * angle)) == 41
    np.testing.assert_allclose(straight, np.linspace(points[0], points[1], 41), atol=1e-12)


def test_bounds_hold_for_keypoints_that_are_not_evenly_spaced():
    pose, marks = np.array([[-0.225, 0, -1.6], [0.225, 0, 1.6]]), np.array([0, 0.02, 0.3, 0.5, 0.7, 0.98, 1.0])
    cable, seen = (elastica(pose, 1.0, along) for along in (np.linspace(0, 1, 201), marks))
    away, supposed = (
        np.linalg.norm(cable[:, None] - refined(seen, along), axis=-1).min(axis=1)
        for along in (marks, np.linspace(0, 1, 7))
    )
    assert away.max() < 0.015 < supposed.max()
    poses, points = np.repeat(pose[None], 5, axis=0), np.repeat(seen[None, None], 5, axis=1)
    # a disc on the cable where a line through evenly spaced keypoints is farthest from it
    bounds, reach = Bounds(keep_out=((*cable[supposed.argmax()], 0.01),)), 0.01 + 0.5 * CONFIG.cable.diameter
    stated, even = (cable_beyond(bounds, CONFIG, poses, points, arclength=along)["keep_out"] for along in (marks, None))
    assert even < 0.5 * reach < 0.8 * reach < stated <= reach
    # linear to an end that is as near to its neighbour
    turns = curvature(seen, marks)
    assert abs(turns[0] - turns[1]) < 0.2 * abs(turns[1] - turns[2])


def test_the_smallest_distance_is_below_a_largest_one_that_is_small():
    low, high = Bounds(max_distance=0.1).distances(1.0)
    assert low < high == 0.1
