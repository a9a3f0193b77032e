"""The depth camera: where its points lie, what hides the cable, and the plant seen through it."""

import dataclasses

import numpy as np
import pytest

from cablejax.cable import Cable, Discretisation
from cablejax.control.loop import run_closed_loop
from cablejax.control.run import shape_error_cm
from cablejax.control.targets import make_target, straight_start
from cablejax.perceive.camera import CameraConfig, DepthCamera
from cablejax.perceive.plant import CloudPlant, tracker_for
from cablejax.simulate.elastica import solve_elastica
from cablejax.simulate.plant import PlantConfig
from perceive_cases import TRACKER

CABLE = Discretisation(n_links=40, dimension=3, timestep=0.005)
CAMERA = CameraConfig(resolution=(480, 360), distance=1.5)
TARGET = make_target("U", CABLE.cable)
SMALL_PLANT = PlantConfig(discretisation=dataclasses.replace(CABLE, n_links=12), settle_time=0.1)


def lying(pose):
    """Nodes and directions of the links of a cable that rests on the table."""
    solution = solve_elastica(pose, CABLE.cable.length, n_samples=CABLE.n_links)
    height = np.full((CABLE.n_links, 1), CABLE.cable.diameter / 2)
    directions = np.stack([np.cos(solution.angle), np.sin(solution.angle), np.zeros(CABLE.n_links)], axis=1)
    return np.concatenate([solution.position, height], axis=1), directions, pose


def look(config: CameraConfig, pose=TARGET.gripper_pose) -> np.ndarray:
    return DepthCamera(config, CABLE).look(*lying(pose))


def offsets(points: np.ndarray) -> np.ndarray:
    """Signed distance of every point across the cable [m], shape [S]."""
    curve = solve_elastica(TARGET.gripper_pose, CABLE.cable.length, n_samples=2001)
    nearest = np.linalg.norm(points[:, None, :2] - curve.position[::4], axis=-1).argmin(axis=1) * 4
    normal = np.stack([-np.sin(curve.angle), np.cos(curve.angle)], axis=1)[nearest]
    return np.sum((points[:, :2] - curve.position[nearest]) * normal, axis=1)


@pytest.mark.parametrize("tilt", [0.0, 0.6])
def test_points_lie_on_both_sides_of_the_axis_alike(tilt):
    points = look(dataclasses.replace(CAMERA, tilt=tilt, outliers=0.0))
    across = offsets(points)
    near = np.abs(across) < 0.02
    assert near.mean() > 0.95 and near.sum() > 500  # a few strays of the table are left
    points, across = points[near], across[near]
    assert abs(across.mean()) < 4e-4  # without correction 1.5 mm at this tilt
    bottom = points[:, 1] < -0.3  # seen from the side there
    assert abs(across[bottom].mean()) < 6e-4


def test_grippers_and_occluders_hide_the_cable():
    clear = look(CAMERA)
    hidden = look(dataclasses.replace(CAMERA, occluders=((0.0, -0.35, 0.15, 0.1, 0.1, 0.02),)))
    bottom = lambda points: np.sum(np.abs(points[:, 0]) < 0.05)  # noqa: E731
    assert bottom(clear) > 50 and bottom(hidden) == 0
    ends = TARGET.gripper_pose[:, :2]
    near = lambda points: np.linalg.norm(points[:, None, :2] - ends, axis=-1).min()  # noqa: E731
    large = look(dataclasses.replace(CAMERA, gripper_size=(0.1, 0.1, 0.15), gripper_overlap=0.08))
    assert near(clear) < 0.03 < 0.05 < near(large)
    assert look(dataclasses.replace(CAMERA, occluders=((0.0, 0.0, 0.3, 1.0, 1.0, 0.01),))).shape == (0, 3)


def test_noise_is_the_seeds():
    camera = DepthCamera(CAMERA, CABLE)
    first, second = (camera.look(*lying(TARGET.gripper_pose)) for _ in range(2))
    assert not np.array_equal(first, second)
    camera.reset()
    np.testing.assert_array_equal(camera.look(*lying(TARGET.gripper_pose)), first)


def test_stray_pixels_of_the_table_are_left_out():
    far = lambda points: np.mean(np.abs(offsets(points)) > 0.02)  # noqa: E731
    assert far(look(CAMERA)) < 0.05 < far(look(dataclasses.replace(CAMERA, min_neighbours=0)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tilt": 1.5}, "tilt"),
        ({"dropout": 2.0}, "dropout"),
        ({"range_noise": -1.0}, "range_noise"),
        ({"centre": (np.nan, 0.0)}, "centre is nan"),
        ({"azimuth": np.inf}, "azimuth is inf"),
        ({"gripper_overlap": -0.1}, r"gripper_overlap is -0\.1"),
        ({"occluders": ((0.0, 0.0, 0.0, 0.1, 0.1),)}, "occluders has .*expected .x, y, z, half x"),
        ({"occluders": ((0.0, 0.0, 0.0, 0.1, 0.1, -0.1),)}, "with positive halves"),
    ],
)
def test_impossible_cameras_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        CameraConfig(**change)


@pytest.mark.parametrize(("diameter", "noise"), [(0.005, 0.002), (0.01, 0.004), (0.003, 0.001)])
def test_the_table_is_not_taken_for_a_cable_in_noise(diameter, noise):
    thin = dataclasses.replace(CABLE, cable=dataclasses.replace(CABLE.cable, diameter=diameter))
    points = DepthCamera(dataclasses.replace(CAMERA, range_noise=noise), thin).look(*lying(TARGET.gripper_pose))
    assert len(points) > 50 and (np.abs(offsets(points)) < 0.02).mean() > 0.95
    with pytest.raises(ValueError, match=r"hides a cable of .* mm on the table: expected at most half of that"):
        DepthCamera(dataclasses.replace(CAMERA, range_noise=0.6 * diameter), thin)


def test_a_camera_that_sees_the_horizon_is_refused():
    with pytest.raises(ValueError, match="horizon"):
        DepthCamera(CameraConfig(tilt=1.2, field_of_view=1.0), CABLE)


@pytest.mark.parametrize(
    ("wrong", "message"), [({"field_of_view": 45.0}, "field_of_view is 45"), ({"min_neighbours": 9}, "expected 0 to 8")]
)
def test_a_camera_that_cannot_see_a_cable_is_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        CameraConfig(**wrong)


@pytest.fixture(scope="module")
def plant() -> CloudPlant:
    return CloudPlant(SMALL_PLANT, camera=CAMERA, tracker=TRACKER)


def test_keypoints_of_clouds_are_near_the_true_ones(plant):
    seen = plant.reset(straight_start(SMALL_PLANT.cable))
    assert np.linalg.norm(seen.keypoints - seen.true_keypoints, axis=1).mean() < 3e-3
    twist = np.array([[0.03, 0.02, -0.2], [-0.03, 0.02, 0.2]])
    for seen in plant.record(twist, samples=5):
        error = np.linalg.norm(seen.keypoints - seen.true_keypoints, axis=1)
        assert 0 < error.mean() < 3e-3
    assert plant.lost == 0


@dataclasses.dataclass(frozen=True)
class Still:
    """Commands nothing."""

    def init(self, history):
        return 0

    def step(self, state, measurement):
        return state, np.zeros((2, 3)), None


def test_the_error_of_a_run_is_that_of_the_true_keypoints(plant):
    run = run_closed_loop(plant, Still(), TARGET, 2, start=straight_start(SMALL_PLANT.cable), record_hz=1.0)
    observed = shape_error_cm(run.keypoints, TARGET.keypoints)
    assert (run.error_cm != observed).all()
    np.testing.assert_allclose(run.error_cm, observed, atol=0.2)


def test_a_hidden_cable_is_reported_as_not_observed():
    blind = dataclasses.replace(CAMERA, occluders=((0.0, 0.0, 0.3, 1.0, 1.0, 0.01),))
    plant = CloudPlant(SMALL_PLANT, camera=blind, tracker=TRACKER)
    seen = plant.reset(straight_start(SMALL_PLANT.cable))
    assert np.isnan(seen.keypoints[1:-1]).all() and np.isfinite(seen.true_keypoints).all()
    np.testing.assert_array_equal(seen.keypoints[[0, -1]], seen.gripper_pose[:, :2])
    assert plant.lost == 1


def test_tracker_and_plant_must_be_about_the_same_cable():
    other = dataclasses.replace(
        SMALL_PLANT, discretisation=dataclasses.replace(CABLE, cable=Cable(n_keypoints=9), n_links=12)
    )
    with pytest.raises(ValueError, match="13 keypoints"):
        CloudPlant(other, camera=CAMERA, tracker=TRACKER)


def test_noise_that_a_camera_would_not_use_is_refused():
    noisy = dataclasses.replace(SMALL_PLANT, keypoint_noise=1e-3)
    with pytest.raises(ValueError, match=r"no use for keypoint_noise: .* `CameraConfig`"):
        CloudPlant(noisy, camera=CAMERA, tracker=TRACKER)


def test_a_tracker_finds_evenly_spaced_keypoints_only():
    with pytest.raises(ValueError, match="a tracker finds evenly spaced ones"):
        tracker_for(Cable(n_keypoints=3, marks=(0.0, 0.3, 1.0)))
    assert tracker_for(Cable(n_keypoints=3, marks=(0.0, 0.5, 1.0))) == tracker_for(Cable(n_keypoints=3))
