"""Effects staged in the contact plant: the same change as in the chain, causal arms and camera, null values."""

import dataclasses
import importlib.util
import pathlib
import sys

import numpy as np
import pytest

from cablejax.cable import Cable, Discretisation
from cablejax.effects.arms import executed
from cablejax.effects.given import EFFECTS, parse_effect, with_effects
from cablejax.effects.physics import nominal_physics
from cablejax.perceive.plant import CloudPlant
from cablejax.simulate.arms import Arms
from cablejax.simulate.plant import Plant, PlantConfig

CABLE = Discretisation(n_links=14, dimension=3, timestep=0.005)
CONFIG = PlantConfig(discretisation=CABLE, settle_time=0.3)
ARCH = np.array([[-0.45, 0.0, 0.0], [0.45, 0.0, 0.0]])
TWIST = np.array([[0.03, 0.02, -0.2], [-0.03, 0.03, 0.3]])


def staged_effects():
    """The experiment that compares plant and chain."""
    script = pathlib.Path(__file__).parents[1] / "experiments" / "14_staged_effects.py"
    spec = importlib.util.spec_from_file_location("staged_effects", script)
    assert spec is not None and spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def check_agreement(staged, effects: list[str], twists) -> None:
    for change in staged.changes(tuple(parse_effect(text) for text in effects), twists):
        assert change.similarity > 0.95, (str(change.effect), change.similarity, change.sizes)
        assert change.ratio == pytest.approx(1.0, abs=0.2), (str(change.effect), change.sizes)


def test_effects_change_the_plant_as_they_change_the_chain():
    staged = staged_effects()
    staged.LINKS = CABLE.n_links
    check_agreement(
        staged,
        [
            "plasticity:yield_curvature_per_m=3,hardening=0.3",
            "gripper_slip:gripper=0,time_s=0.7,distance_m=-0.02",
            "gripper_compliance:gripper=0,stiffness_n_m_per_rad=0.3",
        ],
        staged.TWISTS[:1],
    )


@pytest.mark.slow
def test_every_effect_changes_the_plant_as_it_changes_the_chain():
    staged = staged_effects()
    assert {parse_effect(text).name for text in staged.EFFECTS} == set(EFFECTS)
    check_agreement(staged, list(staged.EFFECTS), staged.TWISTS)


@pytest.mark.slow
def test_static_friction_shows_where_a_cable_is_dragged_slowly_as_in_the_chain():
    staged = staged_effects()
    plain, excess = (parse_effect(f"table_friction:coefficient=0.3{extra}") for extra in ("", ",static_excess=1"))
    (change,) = staged.changes((excess,), staged.SLOW, (plain,))
    plant, chain = change.plant, change.chain
    sizes = np.linalg.norm(plant), np.linalg.norm(chain)
    assert (plant * chain).sum() > 0.95 * sizes[0] * sizes[1]
    assert sizes[0] == pytest.approx(sizes[1], rel=0.25)


@pytest.mark.parametrize(
    "effect",
    [
        "plasticity:yield_curvature_per_m=100",
        "bending_hysteresis:moment_n_m=1e-5,transition_curvature_per_m=20",
        "friction_patch:x_m=0,y_m=0.2,radius_m=0.1,coefficient=0.1",
        "gripper_slip:gripper=0,time_s=0.5,distance_m=0",
        "camera_similarity:scale=1,angle_rad=0,x_m=0,y_m=0",
        "actuation_gain:gain=1",
    ],
)
def test_an_effect_of_no_strength_changes_nothing(effect):
    runs = []
    for effects in ((), (parse_effect(effect),)):
        plant = Plant(dataclasses.replace(CONFIG, effects=effects))
        plant.reset(ARCH)
        runs.append(plant.step(TWIST).keypoints)
    np.testing.assert_allclose(runs[1], runs[0], rtol=0, atol=1e-6)


@pytest.mark.parametrize("delay", [0.0, 0.137, 0.4])
def test_arms_execute_one_command_after_the_other_as_the_diagnosis_replays_them(delay):
    lag = parse_effect(f"actuation_lag:time_s=0.4,delay_s={delay}")
    physics = PlantConfig(effects=(lag, parse_effect("actuation_gain:gain=0.9"))).physics
    dt, twists = 0.005, [TWIST, -0.5 * TWIST, np.zeros((2, 3))]
    arms, poses = Arms(physics, ARCH), [ARCH]
    for twist in twists:
        for moved, count in arms.follow(twist, 40, dt):
            assert count == 1
            poses.append(poses[-1] + dt * moved)
    moves = dt * np.repeat(np.stack(twists), 40, axis=0)
    commanded = np.concatenate([ARCH[None], ARCH + np.cumsum(moves, axis=0)])
    np.testing.assert_allclose(np.stack(poses), executed(physics, commanded, dt), atol=1e-12)


def test_encoders_report_where_lagging_arms_are():
    plant = Plant(dataclasses.replace(CONFIG, effects=(parse_effect("actuation_lag:time_s=0.5,delay_s=0.5"),)))
    plant.reset(ARCH)
    early, late = plant.record(TWIST, 1.0, samples=2)
    np.testing.assert_allclose(early.gripper_pose, ARCH, atol=1e-12)
    np.testing.assert_allclose(late.gripper_pose, ARCH + 0.5 * TWIST, atol=1e-6)
    np.testing.assert_allclose(late.keypoints[[0, -1]], late.gripper_pose[:, :2], atol=2e-5)


def test_a_late_camera_reports_the_past_and_knows_the_truth():
    plant = Plant(dataclasses.replace(CONFIG, effects=(parse_effect("camera_lag:time_s=0.3"),)))
    plant.reset(ARCH)
    seen = plant.record(TWIST, 1.0, samples=10)
    for before, now in zip(seen, seen[3:], strict=False):
        np.testing.assert_allclose(now.keypoints, before.true_keypoints, atol=1e-8)
    np.testing.assert_array_equal(seen[-1].keypoints, plant.observe().keypoints)


@pytest.mark.parametrize("kind", [Plant, CloudPlant])
def test_a_new_cable_has_forgotten_the_last_one(kind):
    effects = "plasticity:yield_curvature_per_m=1", "gripper_slip:gripper=1,time_s=0.2,distance_m=0.02"
    plant = kind(dataclasses.replace(CONFIG, effects=tuple(map(parse_effect, effects))))
    runs = []
    for _ in range(2):
        plant.reset(ARCH)
        plant.step(TWIST)
        runs.append(plant.nodes()[0])
    np.testing.assert_array_equal(runs[0], runs[1])


def test_a_cable_that_slipped_out_is_taut_sooner():
    plant = Plant(
        dataclasses.replace(CONFIG, effects=(parse_effect("gripper_slip:gripper=0,time_s=0,distance_m=-0.05"),))
    )
    plant.reset(ARCH)
    with pytest.raises(ValueError, match=r"pull the cable of 0\.95 m taut"):
        plant.step(np.array([[-0.03, 0.0, 0.0], [0.03, 0.0, 0.0]]))


def test_bad_effects_are_refused():
    with pytest.raises(ValueError, match="expected GivenEffect objects"):
        PlantConfig(effects=("camera_lag:time_s=1",))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"more than the cable's own radius, 0\.005 m"):
        PlantConfig(effects=(parse_effect("obstacle:x_m=0,y_m=0,radius_m=0.005"),))
    with pytest.raises(ValueError, match="friction_patch: radius"):
        PlantConfig(effects=(parse_effect("friction_patch:x_m=0,y_m=0,radius_m=9,coefficient=1"),))
    with pytest.raises(ValueError, match=r"CloudPlant cannot simulate camera_lag.*Simulators that have: Plant"):
        CloudPlant(dataclasses.replace(CONFIG, effects=(parse_effect("camera_lag:time_s=1"),)))


def test_the_rest_curvature_of_a_cable_shows_at_a_soft_section():
    shapes = []
    for curvature in (0.0, 3.0):
        cable = dataclasses.replace(CABLE, cable=Cable(rest_curvature=curvature))
        soft = parse_effect("stiffness_profile:centre_m=0.25,width_m=0.3,ratio=0.2")
        shapes.append(Plant(PlantConfig(discretisation=cable, effects=(soft,), settle_time=0.3)).reset(ARCH).keypoints)
    assert np.abs(shapes[1] - shapes[0]).max() > 5e-3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("bending_stiffness:ratio=0.2,ratio=3", "has a parameter twice: ratio, ratio"),
        ("gripper_rotation_offset:gripper=0.5,angle_rad=0.1", "gripper is 0.5, expected a whole number"),
        ("keypoint_bias:index=1.5,offset_m=0.01", "index is 1.5, expected a whole number"),
    ],
)
def test_an_effect_that_is_misspelt_is_not_another_one(text, message):
    with pytest.raises(ValueError, match=message):
        parse_effect(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("keypoint_bias:index=99,offset_m=0.01", "index is 99, expected 0 to 12"),
        ("keypoint_bias:index=3,across=2,offset_m=0.01", "across is 2, expected 0 or 1"),
        ("intrinsic_curvature:centre_m=2.5,width_m=0.1,curvature_per_m=3", "centre_m is 2.5, expected 0 to 0.6 m"),
        ("intrinsic_curvature:centre_m=0.3,width_m=2,curvature_per_m=3", r"width_m is 2, expected 0.018 to 0.6 m"),
        ("stiffness_profile:centre_m=0.3,width_m=0,ratio=2", r"width_m is 0, expected 0.018 to 0.6 m"),
    ],
)
def test_a_place_out_of_bounds_is_told_as_it_was_given(text, message):
    config = Discretisation(Cable(length=0.6))
    with pytest.raises(ValueError, match=message):
        with_effects(nominal_physics(config), [parse_effect(text)], config)


def test_an_effect_begins_and_ends_within_a_command():
    """Half of a second of tilt moves the cable, whether the second is one command or ten."""
    staged = parse_effect("gravity_tilt:angle_rad=0.5,direction_rad=1.5,from_s=0.5,until_s=0.8")
    shapes = []
    for count in (1, 10):
        plant = Plant(dataclasses.replace(CONFIG, effects=(staged,)))
        plant.reset(ARCH)
        for _ in range(count):
            seen = plant.step(np.zeros((2, 3)), 1.0 / count)
        shapes.append(seen.true_keypoints)
    still = Plant(CONFIG)
    still.reset(ARCH)
    assert np.abs(shapes[0] - still.step(np.zeros((2, 3)), 1.0).true_keypoints).max() > 1e-3
    np.testing.assert_allclose(*shapes, atol=1e-6)


def test_arms_forget_what_is_longer_ago_than_their_delay():
    physics = dataclasses.replace(nominal_physics(CABLE, np.float64), actuation_delay=np.float64(0.3))
    arms = Arms(physics, ARCH)
    for _ in range(200):
        executed_part = list(arms.follow(TWIST, 20, 0.005))
    np.testing.assert_allclose(executed_part[-1][0], TWIST, atol=1e-12)
    assert len(arms._times) < 10
