"""The plant: rigid grasps, rest, friction, agreement with the elastica."""

import dataclasses

import mujoco
import numpy as np
import pytest

from cablejax.cable import GRAVITY, Cable, Discretisation
from cablejax.effects.given import GivenEffect, parse_effect
from cablejax.simulate.composite import link_bodies
from cablejax.simulate.elastica import elastica
from cablejax.simulate.plant import Plant, PlantConfig, plant_model

CABLE = Discretisation(n_links=14, dimension=3, timestep=0.005)
CONFIG = PlantConfig(discretisation=CABLE, settle_time=0.3)
ARCH = np.array([[-0.45, 0.0, 0.0], [0.45, 0.0, 0.0]])
STILL = np.zeros((2, 3))


def rubbing(friction: float) -> Plant:
    chain = dataclasses.replace(CABLE, cable=Cable(friction_coefficient=friction))
    return Plant(dataclasses.replace(CONFIG, discretisation=chain))


@pytest.fixture(scope="module")
def plant() -> Plant:
    return Plant(CONFIG)


def test_grippers_hold_rigidly_and_without_lag(plant):
    plant.reset(ARCH)
    twist = np.array([[0.03, 0.02, -0.2], [-0.03, 0.03, 0.3]])
    for observation in plant.record(twist, samples=10):
        np.testing.assert_allclose(observation.keypoints[[0, -1]], observation.gripper_pose[:, :2], atol=2e-5)
    np.testing.assert_allclose(observation.gripper_pose, ARCH + twist, atol=1e-12)
    nodes, directions = plant.nodes()
    angle = np.arctan2(directions[:, 1], directions[:, 0])
    np.testing.assert_allclose(nodes[[0, -1], :2], observation.gripper_pose[:, :2], atol=1e-5)
    np.testing.assert_allclose(angle[[0, -1]], observation.gripper_pose[:, 2], atol=1e-4)


def test_cable_at_rest_stays_at_rest(plant):
    before = plant.reset(ARCH)
    after = plant.step(STILL, 10.0)
    assert np.abs(after.keypoints - before.keypoints).max() / 10.0 < 1e-4  # [m/s]
    heights = plant.nodes()[0][:, 2]
    assert (np.abs(heights - CABLE.cable.diameter / 2) < 5e-4).all()


@pytest.mark.parametrize("ratio", [0.5, 3.0])
def test_a_new_cable_has_the_shape_of_the_elastica_whatever_its_stiffness(ratio):
    stiffer = GivenEffect("bending_stiffness", (("ratio", ratio),))
    plant = Plant(dataclasses.replace(CONFIG, effects=(stiffer,)))
    pose = np.array([[-0.3, 0.1, -1.2], [0.3, 0.0, 1.0]])
    expected = elastica(pose, CABLE.cable.length, CABLE.cable.keypoint_arclength)
    np.testing.assert_allclose(plant.reset(pose).keypoints, expected, atol=3e-3)


@pytest.mark.parametrize("angle", [0.15, -0.2])
def test_an_almost_straight_cable_that_is_gripped_askew_snaps_to_where_it_rests(angle):
    """No shape near the guess is one at rest."""
    askew = GivenEffect("gripper_rotation_offset", (("gripper", 1), ("angle_rad", angle)))
    plant = Plant(dataclasses.replace(CONFIG, effects=(askew,)))
    pose = np.array([[-0.4973, 0.0, 0.01], [0.4973, 0.0, -0.01]])
    length, s = CABLE.cable.length, CABLE.cable.keypoint_arclength
    guess = elastica(pose, length, np.linspace(0, length, 101))
    expected = elastica(np.add(pose, [[0, 0, 0], [0, 0, angle]]), length, s)
    np.testing.assert_allclose(plant.reset(pose, guess=guess).keypoints, expected, atol=3e-3)


def test_friction_of_a_sliding_cable_is_coulombs():
    # Dragged along, all of the free cable slides: every contact pushes back with mu times its load.
    plant = rubbing(0.1)
    plant.reset(ARCH)
    plant.step(np.array([[0.05, 0.0, 0.0]] * 2))
    force = contact_force(plant)
    weight = CABLE.cable.linear_density * (CABLE.cable.length - CABLE.link_length) * GRAVITY
    assert force[0] == pytest.approx(-0.1 * force[2], rel=0.01)
    # Friction rolls the cable a little, so the grippers bear down on it.
    assert force[2] == pytest.approx(weight, rel=0.25)


def contact_force(plant) -> np.ndarray:
    """Sum of the table's forces on the cable [N], shape [3]."""
    data, total = plant._data, np.zeros(3)
    for index in range(data.ncon):
        force = np.zeros(6)
        mujoco.mj_contactForce(plant.model, data, index, force)
        total += data.contact[index].frame.reshape(3, 3).T @ force[:3]
    return total


def test_the_table_carries_the_weight_steadily(plant):
    plant.reset(ARCH)
    weight = CABLE.cable.linear_density * (CABLE.cable.length - CABLE.link_length) * GRAVITY
    assert contact_force(plant)[2] == pytest.approx(weight, rel=0.1)
    loads = []
    for _ in range(40):
        plant.step(np.array([[0.03, 0.01, -0.2], [-0.02, 0.01, 0.2]]), CABLE.timestep)
        loads.append(contact_force(plant)[2])
    assert np.std(loads) < 0.1 * weight  # no chatter


def test_friction_keeps_a_cable_where_a_frictionless_one_springs_back():
    twist = np.array([[0.0, 0.0, 0.4], [0.0, 0.0, -0.2]])
    shapes = []
    for plant in (rubbing(1.0), rubbing(0.0)):
        plant.reset(ARCH)
        plant.step(twist)
        shapes.append(plant.step(STILL, 2.0).keypoints)
    rest = elastica(ARCH + twist, CABLE.cable.length, CABLE.cable.keypoint_arclength)
    off = [np.abs(shape - rest).max() for shape in shapes]
    assert off[1] < 4e-3
    assert off[0] > 3 * off[1]


def test_bad_set_ups_are_refused():
    with pytest.raises(ValueError, match="dimension is 2"):
        PlantConfig(discretisation=Discretisation())
    with pytest.raises(ValueError, match="bending_stiffness: ratio is 0"):
        PlantConfig(effects=(GivenEffect("bending_stiffness", (("ratio", 0.0),)),))
    with pytest.raises(ValueError, match="keypoint_dropout"):
        PlantConfig(keypoint_dropout=1.0)


def test_weight_and_plugins():
    model = plant_model(CONFIG)
    free = model.body_mass[link_bodies(model)][1:-1]
    np.testing.assert_allclose(free, CABLE.cable.linear_density * CABLE.link_length)
    assert model.nplugin == 0


def test_a_plant_without_effects_moves_as_it_always_has():
    # recorded with MuJoCo 3.17
    plant = Plant(CONFIG)
    plant.reset(ARCH)
    last = plant.record(np.array([[0.03, 0.02, -0.2], [-0.03, 0.03, 0.3]]), 2.0, samples=5)[-1]
    expected = [
        [-0.1868230990146928, 0.1341781673444908],
        [-0.0005553608131743304, 0.2748947908695313],
        [0.178620209941995, 0.11768644529571269],
    ]
    np.testing.assert_allclose(
        last.keypoints[[3, 6, 9]], expected, rtol=0, atol=1e-9
    )  # other processors round otherwise


@pytest.mark.parametrize("text", ["bending_stiffness:ratio=3", "linear_density:ratio=3"])
def test_an_effect_that_begins_later_changes_nothing_before_and_goes_on_from_the_same_state(text):
    twist, pose = np.array([[0.03, 0.02, -0.2], [-0.03, 0.03, 0.3]]), ARCH
    same = Plant(CONFIG)
    changed = Plant(dataclasses.replace(CONFIG, effects=(parse_effect(f"{text},from_s=1"),)))
    for _ in range(2):  # the second cable begins without the effect, as the first one did
        np.testing.assert_array_equal(changed.reset(pose).keypoints, same.reset(pose).keypoints)
        np.testing.assert_array_equal(changed.step(twist).keypoints, same.step(twist).keypoints)
        at_once = changed.step(twist, 0.005).keypoints - same.step(twist, 0.005).keypoints
        later = changed.step(twist, 2.0).keypoints - same.step(twist, 2.0).keypoints
        assert np.abs(at_once).max() < 5e-5 < 2e-4 < np.abs(later).max()


def test_a_push_moves_the_cable_and_ends():
    push = parse_effect("gravity_tilt:angle_rad=0.5,direction_rad=1.57,from_s=1,until_s=1.5")
    plant = Plant(dataclasses.replace(CONFIG, effects=(push,)))
    start = plant.reset(ARCH).keypoints
    assert np.abs(plant.step(STILL).keypoints - start).max() < 2e-4
    pushed = plant.step(STILL, 0.5).keypoints
    assert np.abs(pushed - start).max() > 1e-3
    rested = plant.step(STILL, 2.0).keypoints
    assert np.abs(plant.step(STILL, 2.0).keypoints - rested).max() < 5e-4


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (
            ("axial_stretch:stiffness_n=30,from_s=1",),
            "axial_stretch begin or end .* None can.*plant can with bend",
        ),
        (("bending_stiffness:ratio=2,from_s=2,until_s=1",), "expected 0 <= from_s < until_s"),
        (("plasticity:yield_curvature_per_m=2", "bending_stiffness:ratio=2,from_s=2"), "memory of bends"),
    ],
)
def test_what_cannot_begin_in_the_middle_of_a_run_is_refused(texts, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(CONFIG, effects=tuple(map(parse_effect, texts)))
