"""How the grippers of a log in space hold the cable."""

import dataclasses

import numpy as np
import pytest

import spatial_cases as cases
from cablejax.arrays import quaternion_product
from cablejax.diagnose.protocol import explanation
from cablejax.poses import rotated
from cablejax.simulate.rod import Rod
from cablejax.spatial.cable import SpatialCable
from cablejax.spatial.diagnose import with_roll
from cablejax.spatial.gap import in_log
from cablejax.spatial.grips import clamps, frames_of, held_keypoints
from cablejax.spatial.identify import EDGES, layout_of
from cablejax.spatial.windows import windows_of

SAMPLES = 400


def bending(spacing: float, leaves_at: float, count: int = 9):
    """Keypoints next to two grippers that stand still, of a cable that bends up and down where it leaves them."""
    random = np.random.default_rng(0)
    s = spacing * np.arange(count)
    curvature = 5.0 * random.standard_normal((SAMPLES, 1))
    half = np.stack(
        [
            np.tile(s, (SAMPLES, 1)),
            np.zeros((SAMPLES, count)),
            0.5 * curvature * np.clip(s - leaves_at, 0.0, None) ** 2,
        ],
        axis=-1,
    )
    other = half[:, ::-1] * [-1.0, 1.0, 1.0] + [1.0, 0.0, 0.0]
    points = np.concatenate([half, other], axis=1) + 3e-4 * random.standard_normal((SAMPLES, 2 * count, 3))
    position = np.tile(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), (SAMPLES, 1, 1))
    tangent = np.tile(np.array([1.0, 0.0, 0.0]), (SAMPLES, 2, 1))
    marks = np.concatenate([s, 1.0 - s[::-1]])
    return points[None], position[None], tangent[None], np.ones((1, SAMPLES), bool), marks


@pytest.mark.parametrize(("spacing", "held"), [(0.1, 1), (0.025, 1), (0.025, 2), (0.03, 2), (0.02, 3)])
def test_keypoints_that_bend_with_the_cable_are_not_held(spacing, held):
    """However near to a gripper: a cable is moved across by less than 3 mm there whether or not it is held."""
    assert held_keypoints(*bending(spacing, (held - 1) * spacing)) == (held, held)


def test_a_gripper_that_hides_its_marker_does_not_make_the_clamp_jump():
    """The pose is that of a point 12 mm behind the marker, as a robot's tool centre may be."""
    points, position, tangent, _, s = bending(0.1, 0.0)
    place = position + 0.2 * np.sin(np.linspace(0.0, 9.0, SAMPLES))[:, None, None]
    points = points + (place - position)[:, :, :1]
    behind = place - 0.012 * np.array([1.0, -1.0])[:, None] * tangent
    hidden = points.copy()
    hidden[0, [*range(7), 100, 200, 201, 202], 0] = np.nan
    clamp = clamps(hidden, behind, tangent, s, (1, 1))
    np.testing.assert_allclose(clamp, clamps(points, behind, tangent, s, (1, 1)), atol=2e-3)
    # in an episode that never shows it, the marker is as far from the pose as in the others
    every = np.concatenate([hidden, np.full_like(hidden, np.nan)])
    twice = [np.concatenate([part, part]) for part in (behind, tangent)]
    np.testing.assert_allclose(clamps(every, *twice, s, (1, 1))[1], place[0], atol=1e-3)


def rolling(log):
    """The log with grippers that roll about the cable, and says so."""
    roll = 0.8 * np.sin(np.linspace(0.0, 3.0, log.keypoints.shape[1]))[None, :, None, None]
    about = np.concatenate([np.cos(roll / 2), np.sin(roll / 2), 0.0 * roll, 0.0 * roll], axis=-1)
    pose = log.gripper_pose.astype(float)
    pose[..., 3:] = quaternion_product(pose[..., 3:], np.broadcast_to(about, pose[..., 3:].shape))
    meta = {**log.meta, "cable": {**log.meta["cable"], "bending_damping_s": 0.05}, "roll_observed": True}
    return dataclasses.replace(log, gripper_pose=pose.astype(np.float32), meta=meta)


def unsaid(log):
    return dataclasses.replace(log, meta={name: log.meta[name] for name in log.meta if name != "roll_observed"})


def test_roll_is_that_of_the_log_where_it_was_observed():
    log = cases.recording()
    told, rolled = rolling(log), unsaid(rolling(log))
    pose, valid = told.gripper_pose.astype(float), np.arange(log.keypoints.shape[1]) < log.episode_length[:, None]
    tangent = rotated(pose[..., 3:], np.array([1.0, 0.0, 0.0]))
    unknown, known = frames_of(rolled, tangent, valid)[valid], frames_of(told, tangent, valid)[valid]
    np.testing.assert_allclose(unknown, frames_of(log, tangent, valid)[valid], atol=1e-6)
    for axis in range(3):
        np.testing.assert_allclose(known[..., axis, :], rotated(pose[..., 3:], np.eye(3)[axis])[valid], atol=1e-5)
    turned = np.arccos(np.clip((known[..., 1, :] * unknown[..., 1, :]).sum(axis=-1), -1.0, 1.0))
    assert np.ptp(turned) > 0.5
    assert windows_of(told).rolls and not windows_of(rolled).rolls


def test_roll_that_moves_the_cable_as_recorded_was_observed():
    """Where the log does not say."""
    told = rolling(cases.recording())
    cable, windows = told.meta["cable"], windows_of(told)
    layout = layout_of(windows, cable["bending_stiffness_n_m2"] / cable["linear_density_kg_per_m"], 0.05)
    motion = SpatialCable(Rod(EDGES, 1, twisting=False), layout, windows).motion(explanation())
    moved = in_log(told, windows, motion)
    as_rolled = dataclasses.replace(
        told, keypoints=np.where(np.isfinite(moved), moved, told.keypoints).astype(np.float32)
    )
    assert with_roll(unsaid(as_rolled)).meta["roll_observed"] is True
    for log in (cases.recording(), unsaid(told)):
        assert with_roll(log) is log, "made of markers, or not what the cable did"
    for meta in ({"roll_observed": False}, {"commands_from_poses": True}):
        log = dataclasses.replace(unsaid(as_rolled), meta={**unsaid(told).meta, **meta})
        assert with_roll(log) is log
