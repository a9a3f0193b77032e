"""What every plant does alike: it repeats itself, is sampled without being disturbed, and refuses what it cannot do."""

import dataclasses

import numpy as np
import pytest

from cablejax.cable import Discretisation
from cablejax.simulate.plant import Plant, PlantConfig
from cablejax.simulate.table_plant import PlantError
from closed_loop.rod_plant import RodPlant, RodPlantConfig

ARCH = np.array([[-0.45, 0.0, 0.0], [0.45, 0.0, 0.0]])
STILL = np.zeros((2, 3))
CONFIGS = {
    "mujoco": PlantConfig(discretisation=Discretisation(n_links=14, dimension=3, timestep=0.005), settle_time=0.3),
    "rod": RodPlantConfig(discretisation=Discretisation(n_links=15, timestep=4e-4)),
}
SAME_MOTION = {"mujoco": 1e-9, "rod": 1e-6}
"""How much sampling may change a motion [m]."""


def made(config):
    return RodPlant(config) if isinstance(config, RodPlantConfig) else Plant(config)


@pytest.fixture(params=CONFIGS)
def kind(request):
    if request.param == "rod":
        pytest.importorskip("elastica", reason="PyElastica is not installed: pip install pyelastica==1.0.0")
    return request.param


@pytest.fixture
def plant(kind):
    return made(CONFIGS[kind])


def test_runs_repeat_exactly_and_noise_does_too(kind):
    config = dataclasses.replace(CONFIGS[kind], keypoint_noise=1e-3, keypoint_dropout=0.3, seed=7)
    twist = np.array([[0.02, 0.0, 0.0], [0.0, 0.02, 0.1]])

    def run(plant):
        return np.stack([plant.reset(ARCH).keypoints, plant.step(twist, 0.5).keypoints])

    plant = made(config)
    first, again, other = run(plant), run(plant), run(made(config))
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first, other)
    clean = run(made(CONFIGS[kind]))
    seen = np.isfinite(first)
    assert 0 < (~seen).sum() < first.size / 2 and seen[:, [0, -1]].all()
    assert 2e-4 < (first - clean)[seen].std() < 3e-3
    np.testing.assert_allclose(plant.observe().true_keypoints, clean[1], atol=1e-12)


def test_recording_does_not_change_the_motion(kind, plant):
    twist = np.array([[0.03, 0.0, 0.2], [0.0, -0.03, 0.1]])
    plant.reset(ARCH)
    once = plant.step(twist)
    plant.reset(ARCH)
    samples = plant.record(twist, samples=10)
    np.testing.assert_allclose(samples[-1].keypoints, once.keypoints, atol=SAME_MOTION[kind])
    np.testing.assert_allclose([sample.time for sample in samples], np.arange(1, 11) / 10)


def test_bad_commands_are_refused_and_leave_the_plant_alone(plant):
    before = plant.reset(ARCH)
    with pytest.raises(ValueError, match="twist is not finite"):
        plant.step(np.full((2, 3), np.nan))
    with pytest.raises(ValueError, match=r"shape \(6,\), expected \(2, 3\)"):
        plant.step(np.zeros(6))
    with pytest.raises(ValueError, match="pull the cable of 1 m taut"):
        plant.step(np.array([[-0.06, 0, 0], [0.06, 0, 0]]))
    with pytest.raises(ValueError, match="multiple of the time step"):
        plant.step(STILL, 0.0123)
    with pytest.raises(ValueError, match="do not fall on time steps"):
        plant.record(STILL, 1.0, samples=7)
    after = plant.observe()
    np.testing.assert_array_equal(after.keypoints, before.keypoints)
    assert after.time == before.time


def test_bad_starts_are_refused(plant):
    with pytest.raises(ValueError, match="reset"):
        plant.step(STILL)
    with pytest.raises(ValueError, match="taut"):
        plant.reset(np.array([[-0.6, 0, 0], [0.6, 0, 0]]))
    with pytest.raises(ValueError, match="gripper_pose is not finite"):
        plant.reset(np.full((2, 3), np.inf))


def test_an_unstable_simulation_is_reported(plant):
    plant.reset(ARCH)
    with pytest.raises(PlantError, match="unstable") as refused:
        plant.step(np.array([[0, 1e12, 0], [0, 1e12, 0]], float))
    assert isinstance(refused.value, ValueError), "commands report these"
    with pytest.raises(ValueError, match="reset"):
        plant.step(STILL)
    assert np.isfinite(plant.reset(ARCH).keypoints).all()
