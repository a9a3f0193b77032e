"""The Cosserat rod's plant: rest, grasps, friction law, agreement with the elastica, and what it refuses."""

import dataclasses
import sys

import numpy as np
import pytest

pytest.importorskip("elastica", reason="PyElastica is not installed: pip install pyelastica==1.0.0")

from cablejax.cable import GRAVITY, Cable, Discretisation
from cablejax.control.loop import run_closed_loop
from cablejax.control.targets import make_target, straight_start
from cablejax.effects.given import parse_effect
from cablejax.simulate.elastica import elastica
from cablejax.simulate.plant import Plant, PlantConfig
from closed_loop.rod_plant import ETHERNET, USB, RodPlant, RodPlantConfig

CABLE = Discretisation(n_links=15, timestep=4e-4)
CONFIG = RodPlantConfig(discretisation=CABLE)
ARCH = np.array([[-0.45, 0.0, 0.0], [0.45, 0.0, 0.0]])
STILL = np.zeros((2, 3))


@pytest.fixture(scope="module")
def plant() -> RodPlant:
    return RodPlant(CONFIG)


def rubbing(friction, **changes) -> RodPlant:
    cable = dataclasses.replace(CABLE, cable=Cable(friction_coefficient=friction))
    return RodPlant(dataclasses.replace(CONFIG, discretisation=cable, **changes))


@pytest.mark.slow
@pytest.mark.parametrize("letter", ["U", "S", "Z"])
def test_a_new_cable_has_the_shape_of_the_elastica(letter):
    plant = RodPlant(RodPlantConfig(discretisation=Discretisation(n_links=27, timestep=2e-4)))
    target = make_target(letter, plant.config.cable)
    np.testing.assert_allclose(plant.reset(target.gripper_pose).keypoints, target.keypoints, atol=2e-3)
    assert plant.stretch() < 1e-3


def test_grippers_hold_rigidly_and_without_lag(plant):
    plant.reset(ARCH)
    twist = np.array([[0.03, 0.02, -0.2], [-0.03, 0.03, 0.3]])
    for observation in plant.record(twist, samples=10):
        np.testing.assert_allclose(observation.keypoints[[0, -1]], observation.gripper_pose[:, :2], atol=1e-9)
    np.testing.assert_allclose(observation.gripper_pose, ARCH + twist, atol=1e-12)
    _, directions = plant.nodes()
    angle = np.arctan2(directions[:, 1], directions[:, 0])
    np.testing.assert_allclose(angle[[0, -1]], observation.gripper_pose[:, 2], atol=1e-9)


def test_cable_at_rest_does_not_creep(plant):
    plant.reset(ARCH)
    before = plant.step(np.array([[0.03, 0.02, -0.2], [-0.03, 0.03, 0.3]]))
    rest = plant.step(STILL)
    assert np.abs(plant.step(STILL, 10.0).keypoints - rest.keypoints).max() < 1e-6
    assert np.abs(rest.keypoints - before.keypoints).max() < 2e-3


@pytest.mark.parametrize("speed", [0.01, 0.05])
def test_friction_of_a_sliding_cable_is_stribecks(speed):
    # Dragged along, all of the free cable slides; its nodes gain what the elastic force leaves over, so both agree.
    mu, static_ratio, stribeck_speed = 0.1, 1.5, 0.01
    plant = rubbing(mu, stribeck_speed=stribeck_speed, static_ratio=static_ratio)
    plant.reset(ARCH)
    twist = np.array([[speed, 0.0, 0.0]] * 2)
    plant.step(twist, 2.0)
    rod, free, forces = plant._rod, slice(2, -2), []
    for _ in range(500):
        plant.step(twist, CABLE.timestep)
        forces.append([rod.internal_forces[0, free].sum(), -rod.external_forces[0, free].sum()])
    assert np.abs(rod.velocity_collection[0, free] - speed).max() < 0.1 * speed
    weight = rod.mass[free].sum() * GRAVITY
    expected = mu * weight * (1.0 + (static_ratio - 1.0) * np.exp(-((speed / stribeck_speed) ** 2)))
    np.testing.assert_allclose(np.mean(forces, axis=0), expected, rtol=0.02)


def test_friction_keeps_a_cable_where_a_frictionless_one_springs_back():
    twist = np.array([[0.0, 0.0, 0.4], [0.0, 0.0, -0.2]])
    rest = elastica(ARCH + twist, CABLE.cable.length, CABLE.cable.keypoint_arclength)
    off = []
    for friction in (1.0, 0.0):
        plant = rubbing(friction)
        plant.reset(ARCH)
        plant.step(twist)
        off.append(np.abs(plant.step(STILL, 3.0).keypoints - rest).max())
    assert off[1] < 6e-3
    assert off[0] > 3 * off[1]


def test_a_uniform_rest_curvature_does_not_show_between_two_clamps():
    shapes = []
    for curvature in (0.0, 2.0):
        cable = Cable(friction_coefficient=0.0, rest_curvature=curvature)
        plant = RodPlant(dataclasses.replace(CONFIG, discretisation=dataclasses.replace(CABLE, cable=cable)))
        shapes.append(plant.reset(ARCH).keypoints)
    np.testing.assert_allclose(shapes[1], shapes[0], atol=5e-4)
    assert plant._rod.rest_kappa[0, 3] == pytest.approx(2.0)


def test_bad_set_ups_are_refused():
    for changes, message in [
        ({"discretisation": Discretisation(dimension=3, timestep=1e-4)}, "dimension is 3"),
        ({"discretisation": Discretisation(n_links=27, timestep=1e-3)}, "stable only up to"),
        ({"static_ratio": 0.9}, "static_ratio"),
        ({"axial_ratio": 0.0}, "axial_ratio"),
        (
            {"effects": (parse_effect("obstacle:x_m=0,y_m=0,radius_m=0.1"),)},
            r"RodPlant cannot simulate obstacle.*Plant",
        ),
        ({"effects": (parse_effect("bending_stiffness:ratio=40"),)}, "stable only up to"),
        ({"keypoint_noise": -1.0}, "keypoint_noise"),
        ({"keypoint_dropout": 1.0}, "keypoint_dropout"),
    ]:
        with pytest.raises(ValueError, match=message):
            dataclasses.replace(CONFIG, **changes)


@pytest.mark.parametrize(
    "effect",
    [
        "stiffness_profile:centre_m=0.3,width_m=0.2,ratio=0.3",
        "lumped_mass:centre_m=0.4,mass_kg=0.05",
        "actuation_lag:time_s=0.4,delay_s=0.15",
    ],
)
def test_an_effect_changes_the_rod_as_it_changes_the_contact_plant(effect):
    given, changes = parse_effect(effect), []
    contact = PlantConfig(discretisation=Discretisation(n_links=15, dimension=3, timestep=0.005))
    for kind, config in ((RodPlant, dataclasses.replace(CONFIG, static_ratio=1.0)), (Plant, contact)):
        shapes = []
        for effects in ((), (given,)):
            plant = kind(dataclasses.replace(config, effects=effects))
            plant.reset(np.array([[-0.38, 0.0, 0.5], [0.38, 0.0, -0.5]]))
            moved = plant.record(np.array([[0.04, 0.02, -0.15], [-0.04, 0.03, 0.15]]), 2.0, samples=5)
            shapes.append(np.stack([observation.keypoints for observation in moved]))
        changes.append(shapes[1] - shapes[0])
    sizes = [np.linalg.norm(change) for change in changes]
    assert (changes[0] * changes[1]).sum() > 0.95 * sizes[0] * sizes[1]
    assert sizes[0] == pytest.approx(sizes[1], rel=0.2)


def test_a_missing_library_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "closed_loop.rod_loop", None)
    with pytest.raises(ImportError, match="pip install pyelastica"):
        RodPlant()


def test_the_closed_loop_takes_it_for_a_plant():
    @dataclasses.dataclass(frozen=True)
    class Still:
        def init(self, history):
            return None

        def step(self, state, measurement):
            return None, STILL, None

    run = run_closed_loop(
        RodPlant(CONFIG), Still(), make_target("U", CABLE.cable), 2, start=straight_start(CABLE.cable)
    )
    assert run.stopped is None and len(run.episode.time) == 3 * 10 + 1
    assert np.abs(run.keypoints[-1] - run.keypoints[0]).max() < 1e-6


def test_the_named_cables_differ_from_the_reference_in_opposite_directions():
    nominal = Discretisation()
    assert USB.cable.bending_stiffness < nominal.cable.bending_stiffness < ETHERNET.cable.bending_stiffness
    for config in (ETHERNET, USB):
        assert config.cable.n_keypoints == 13 and config.cable.length == 1.0
        assert config.cable.rest_curvature == 0.0
