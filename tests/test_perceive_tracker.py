"""The first frame without a prior, tracking, and everything that a camera may send instead of a cable."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.cable import Cable
from cablejax.perceive import Status, Tracker, TrackerConfig, track
from cablejax.perceive.initial import cloud_path, padded, path_length
from cablejax.perceive.plant import tracker_for
from perceive_cases import ARCH, CAPACITY, S_SHAPE, TRACKER, cloud, mean_error, moved, shape

FRAMES = 12
NOTHING = np.zeros((0, 2))


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return Tracker(TRACKER)


@pytest.fixture(scope="module")
def motion():
    """A cable in slow motion: 5 mm and 0.025 rad between frames, as at 10 Hz under the fastest commands."""
    cables = [shape(ARCH)]
    for _ in range(FRAMES):
        cables.append(shape(moved(cables[-1].pose, shift=0.005, turn=0.025), guess=cables[-1]))
    return cables


@pytest.fixture(scope="module")
def started(tracker, motion):
    return tracker.init(cloud(motion[0], 0), motion[0].pose)


@pytest.mark.parametrize("pose", [ARCH, S_SHAPE, S_SHAPE * [1, -1, -1]], ids=["arch", "S", "mirrored S"])
@pytest.mark.parametrize("clutter", [{}, {"hidden": (0.3, 0.6), "outliers": 0.1}], ids=["clear", "cluttered"])
def test_the_first_frame_needs_no_prior_and_no_count_of_turns(tracker, pose, clutter):
    cable = shape(pose)
    state, seen = tracker.init(cloud(cable, 1, **clutter), pose + np.array([0.0, 0.0, 2 * np.pi]))
    assert seen.status == Status.TRACKED and state.found
    assert mean_error(seen.keypoints, cable) < 3e-3
    # A pose modulo a turn is the same pose.
    _, seen = tracker.step(state, cloud(cable, 2, **clutter), pose)
    assert seen.status == Status.TRACKED and mean_error(seen.keypoints, cable) < 3e-3


def test_a_moving_cable_is_followed_behind_clutter(tracker, motion, started):
    state, _ = started
    for frame, cable in enumerate(motion[1:]):
        state, seen = tracker.step(state, cloud(cable, frame, hidden=(0.1, 0.4), outliers=0.1), cable.pose)
        assert seen.status == Status.TRACKED and seen.lost == 0
        assert mean_error(seen.keypoints, cable) < 3e-3
        assert tracker.explain(seen, NOTHING, cable.pose) is None


@pytest.mark.parametrize("sent", ["nothing", "not a number", "strays"])
def test_a_second_without_a_cable_is_held_reported_and_recovered_from(tracker, motion, started, sent):
    clouds = {
        "nothing": NOTHING,
        "not a number": np.full((CAPACITY, 3), np.nan),
        "strays": np.random.default_rng(0).uniform(-0.5, 0.5, (CAPACITY, 2)),
    }
    status = Status.NO_FIT if sent == "strays" else Status.FEW_POINTS
    state, _ = started
    for frame, cable in enumerate(motion[1:11]):
        state, seen = tracker.step(state, clouds[sent], cable.pose)
        assert seen.status == status and seen.lost == frame + 1
        assert np.isfinite(seen.keypoints).all()
    assert mean_error(seen.keypoints, motion[10]) < 0.05  # the ends went with the grippers
    np.testing.assert_allclose(seen.keypoints[jnp.array([0, -1])], motion[10].pose[:, :2], atol=2e-3)
    shown = tracker.explain(seen, clouds[sent], cable.pose)
    assert shown is not None and ("usable points" in shown) == (status == Status.FEW_POINTS)
    state, seen = tracker.step(state, cloud(motion[11], 3), motion[11].pose)
    assert seen.status == Status.TRACKED and seen.lost == 0
    assert mean_error(seen.keypoints, motion[11]) < 1e-3


def seen_at(length, motion):
    """Two frames of a cable of this length, by a camera whose noise is as large beside it; lengths in its length."""
    config = tracker_for(Cable(length=length))
    by_camera = ("min_sigma", "settled_sigma")
    registration = dataclasses.replace(
        config.registration, **{name: length * getattr(config.registration, name) for name in by_camera}
    )
    size = {"reach": length * config.reach, "max_sigma": length * config.max_sigma, "capacity": CAPACITY}
    tracker, state = Tracker(dataclasses.replace(config, registration=registration, **size)), None
    for frame, cable in enumerate(motion[:2]):
        points = length * cloud(cable, frame, hidden=(0.3, 0.6), outliers=0.1)
        pose = cable.pose * [length, length, 1.0]
        state, seen = tracker.init(points, pose) if state is None else tracker.step(state, points, pose)
        yield int(seen.status), np.asarray(seen.keypoints) / length, float(seen.sigma) / length


@pytest.mark.parametrize("length", [0.3, pytest.param(3.0, marks=pytest.mark.slow)])
def test_a_cable_of_any_length_is_followed_as_one_of_a_metre_is(motion, length):
    """The same shapes and random numbers, scaled: every penalty has the dimension that its definition says."""
    for (status, keypoints, sigma), (_, expected, expected_sigma) in zip(
        seen_at(length, motion), seen_at(1.0, motion), strict=True
    ):
        assert status == Status.TRACKED
        np.testing.assert_allclose(keypoints, expected, atol=2e-6)
        assert sigma == pytest.approx(expected_sigma, rel=1e-4)


@pytest.mark.slow
def test_in_double_precision_too(tracker, motion):
    with jax.enable_x64(True):
        state, seen = tracker.init(cloud(motion[0], 1), motion[0].pose)
        state, seen = tracker.step(state, cloud(motion[1], 2), motion[1].pose)
        assert seen.status == Status.TRACKED and seen.keypoints.dtype == np.float64
        assert mean_error(seen.keypoints, motion[1]) < 1e-3


def test_some_points_that_are_not_finite_do_no_harm(tracker, motion, started):
    points = cloud(motion[1], 4)
    points[::5] = np.nan
    points[1] = np.inf
    _, seen = tracker.step(started[0], points, motion[1].pose)
    assert seen.status == Status.TRACKED and mean_error(seen.keypoints, motion[1]) < 1e-3


@pytest.mark.parametrize("length", [0.85, 1.15])
def test_another_cable_is_not_taken_for_this_one(tracker, motion, started, length):
    other = shape(ARCH, length=length)
    state, seen = tracker.init(cloud(other, 5), ARCH)
    assert seen.status == Status.NO_FIT and not state.found
    assert np.isnan(seen.keypoints).all()
    state, seen = tracker.step(started[0], cloud(other, 6), ARCH)
    assert seen.status == Status.NO_FIT and np.isfinite(seen.keypoints).all()
    shown = tracker.explain(seen, cloud(other, 6), ARCH)
    assert shown is not None and "cable of 1 m" in shown and "shortest way along its points" in shown
    # The right one is found again.
    state, seen = tracker.step(state, cloud(motion[0], 7), ARCH)
    assert seen.status == Status.TRACKED and mean_error(seen.keypoints, motion[0]) < 1e-3


@pytest.mark.parametrize(
    ("turn", "scale", "shift", "words"),
    [
        (np.pi, 1.0, 0.0, "is theta not the direction"),
        (0.0, 1e3, 0.0, "Are both in metres"),
        (0.0, 1.0, 0.3, "another frame than the grippers"),
    ],
)
def test_a_lost_frame_is_explained_by_what_is_wrong(tracker, motion, turn, scale, shift, words):
    points = scale * cloud(motion[0], 9) + shift
    pose = np.asarray(ARCH, float) + np.array([0.0, 0.0, turn])
    _, seen = tracker.init(points, pose)
    assert seen.status == Status.NO_FIT
    assert words in tracker.explain(seen, points, pose)


def test_a_cable_that_was_not_there_at_first_is_found_when_it_comes(tracker, motion):
    state, seen = tracker.init(NOTHING, ARCH)
    assert seen.status == Status.FEW_POINTS and np.isnan(seen.keypoints).all()
    state, seen = tracker.step(state, cloud(motion[0], 8), ARCH)
    assert seen.status == Status.TRACKED and mean_error(seen.keypoints, motion[0]) < 1e-3


def test_a_jump_is_noticed_and_the_cable_found_on_the_other_side(tracker):
    pose = np.array([[-0.3, 0.0, 0.0], [0.3, 0.0, 0.0]])
    up = shape(pose + np.array([[0, 0, 0.3], [0, 0, -0.3]]))
    down = shape(pose + np.array([[0, 0, -0.3], [0, 0, 0.3]]))
    state, _ = tracker.init(cloud(up, 9), up.pose)
    _, seen = tracker.step(state, cloud(down, 10), down.pose)
    assert seen.status == Status.TRACKED and mean_error(seen.keypoints, down) < 1e-3


def test_a_batch_of_trackers_is_its_members(tracker, motion, started):
    rows = [padded(cloud(motion[1], seed), CAPACITY) for seed in (11, 12)]
    points, mask = jnp.stack([r.points for r in rows]), jnp.stack([r.mask for r in rows])
    mask = mask.at[1].set(False)
    pose = jnp.asarray(motion[1].pose, jnp.float32)
    _, batch = jax.vmap(lambda p, m: track(TRACKER, started[0], p, m, pose))(points, mask)
    for index in range(2):
        _, one = track(TRACKER, started[0], points[index], mask[index], pose)
        np.testing.assert_allclose(batch.keypoints[index], one.keypoints, atol=2e-5)
        assert batch.status[index] == one.status


def test_what_cannot_be_a_cloud_is_refused(tracker, started):
    with pytest.raises(ValueError, match=r"shape \(5,\)"):
        tracker.step(started[0], np.zeros(5), ARCH)
    with pytest.raises(ValueError, match=r"shape \(5, 4\)"):
        tracker.init(np.zeros((5, 4)), ARCH)
    with pytest.raises(ValueError, match="gripper_pose"):
        tracker.init(np.zeros((5, 2)), np.full((2, 3), np.nan))
    with pytest.raises(ValueError, match=r"type complex128, expected real numbers of shape"):
        tracker.init(np.zeros((5, 2), complex), ARCH)
    with pytest.raises(ValueError, match=r"gripper_pose has complex values, expected real numbers"):
        tracker.init(np.zeros((5, 2)), ARCH + 0j)
    with pytest.raises(ValueError, match=r"config is of type NoneType, expected a TrackerConfig"):
        Tracker(None)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="min_support"):
        TrackerConfig(min_support=2.0)
    with pytest.raises(ValueError, match="capacity"):
        dataclasses.replace(TRACKER, capacity=0)


def test_a_capacity_below_the_fewest_points_is_refused():
    with pytest.raises(ValueError, match="capacity is 20, expected at least min_points, 30"):
        TrackerConfig(capacity=20)


def test_a_cloud_is_thinned_and_padded():
    points = np.random.default_rng(0).standard_normal((50, 3))
    points[3] = np.nan
    kept = padded(points, 100)
    assert kept.mask.sum() == 49 and kept.dropped == 1 and not kept.points[49:].any()
    thinned = padded(points, 20)
    assert thinned.mask.all() and {tuple(p) for p in thinned.points} < {tuple(p) for p in kept.points}


def test_the_path_along_a_cloud_is_as_long_as_the_cable():
    cable = shape(S_SHAPE)
    path = cloud_path(cloud(cable, 13), S_SHAPE, 1.0)
    assert path_length(path) == pytest.approx(1.0, abs=0.04)
    np.testing.assert_allclose(path[[0, -1]], S_SHAPE[:, :2], atol=0.02)


def test_where_everything_is_at_one_place_there_is_a_path_of_no_length():
    assert path_length(cloud_path(np.zeros((50, 2)), np.zeros((2, 3)), 1.0)) == 0
