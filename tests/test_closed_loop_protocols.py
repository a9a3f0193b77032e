"""Starts and targets of the protocols: as drawn by the seed, within limits, at rest, and reachable."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.cable import Discretisation
from cablejax.control.targets import make_target
from cablejax.mpc import MPCConfig
from cablejax.mpc.target_pose import target_pose
from cablejax.simulate.elastica import solve_elastica
from cablejax.simulate.equilibrium import angles_of_keypoints, chain_nodes, find_equilibrium
from cablejax.simulate.motions import admissible
from cablejax.simulate.plant import Plant, PlantConfig
from closed_loop import protocols
from closed_loop.protocols import (
    LaidOut,
    ShapeConfig,
    least_time,
    letter_task,
    random_shape,
    random_straight_start,
    random_task,
)

CHAIN = Discretisation()
CABLE = CHAIN.cable


def test_straight_starts_vary_within_their_limits():
    poses = np.stack([random_straight_start(seed) for seed in range(200)])
    way = poses[:, 1, :2] - poses[:, 0, :2]
    heading, middle = np.arctan2(way[:, 1], way[:, 0]), poses[:, :, :2].mean(axis=1)
    slack, lean = 1 - np.linalg.norm(way, axis=1), poses[:, 0, 2] - heading
    for values, bound in ((heading, np.pi / 6), (middle[:, 0], 0.05), (middle[:, 1], 0.05)):
        assert np.abs(values).max() <= bound and values.max() > 0.9 * bound and values.min() < -0.9 * bound
    assert 0.005 <= slack.min() < 0.006 and 0.019 < slack.max() <= 0.02
    assert 60 < (lean > 0).sum() < 140
    np.testing.assert_allclose(np.abs(lean), 0.01, atol=1e-9)
    np.testing.assert_array_equal(random_straight_start(7), poses[7])


def test_letters_of_one_seed_start_alike():
    u, z = letter_task("U", 3), letter_task("Z", 3)
    np.testing.assert_array_equal(u.start_pose, z.start_pose)
    np.testing.assert_array_equal(z.target.keypoints, make_target("Z").keypoints)
    assert (letter_task("U", 4).start_pose != u.start_pose).all()
    np.testing.assert_allclose(u.start_shape[[0, -1]], u.start_pose[:, :2], atol=1e-6)
    # The slack lies on the side to which the ends lean.
    chord = u.start_pose[1, :2] - u.start_pose[0, :2]
    side = np.array([-chord[1], chord[0]]) @ (u.start_shape[50] - u.start_pose[0, :2])
    assert np.sign(side) == np.sign(u.start_pose[0, 2] - np.arctan2(chord[1], chord[0]))


def test_least_time_is_that_of_the_gripper_with_the_longer_way():
    task, config = letter_task("U", 0, CHAIN), MPCConfig()
    there = dataclasses.replace(task, start_pose=np.asarray(target_pose(jnp.asarray(task.target.keypoints))))
    there = dataclasses.replace(there, start_shape=task.target.keypoints)
    assert least_time(there, config) == pytest.approx(0.0, abs=1e-4)
    offset = np.array([[0.0, 0.03, 0.0], [0.3, 0.0, 4.0 / 3.0]])
    moved = dataclasses.replace(there, start_pose=there.start_pose + offset)
    assert least_time(moved, config) == pytest.approx(np.hypot(0.3, 0.2) / 0.05, rel=1e-4)


def test_random_tasks_reproduce_and_share_their_target():
    first, again, other = random_task("diverse", 5), random_task("diverse", 5), random_task("diverse", 6)
    for name in ("start_pose", "start_shape"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
        assert not np.array_equal(getattr(first, name), getattr(other, name))
    np.testing.assert_array_equal(first.target.keypoints, random_task("straight", 5).target.keypoints)
    np.testing.assert_array_equal(random_task("straight", 5).start_pose, letter_task("U", 5).start_pose)
    assert not np.array_equal(first.target.gripper_pose, first.start_pose)


@pytest.mark.parametrize("seed", range(8))
def test_random_targets_are_shapes_in_which_the_cable_rests(seed):
    target = random_task("straight", seed).target
    pose, points = target.gripper_pose, target.keypoints
    np.testing.assert_allclose(points[[0, -1]], pose[:, :2], atol=1e-6)
    assert admissible(CHAIN, ShapeConfig().motion, pose)
    assert 0.15 <= np.linalg.norm(pose[1, :2] - pose[0, :2]) <= 0.98
    assert np.abs(pose[:, :2].mean(axis=0)).max() <= 0.2
    chords = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert chords.max() <= 1 / 12 + 1e-6 and chords.sum() > 0.93
    # The chain, which shares nothing with the boundary-value solution, rests there too.
    rest = find_equilibrium(CHAIN, pose, angles_of_keypoints(CHAIN, pose, points))
    assert rest.stability > 0
    nodes = chain_nodes(CHAIN, pose, rest.angles)
    s = (np.arange(CHAIN.n_joints) + 0.5) * CHAIN.link_length
    middle = [np.interp(CABLE.keypoint_arclength[1:-1], s, nodes[:, i]) for i in range(2)]
    assert np.abs(np.stack(middle, axis=1) - points[1:-1]).max() < 0.004


@pytest.mark.parametrize("seed", range(3))
def test_a_way_of_stable_shapes_leads_from_straight_to_the_target(seed):
    """The first part of the target's curve, enlarged to the cable's length, is a cable at rest, for every part."""
    _, rest = random_shape(np.random.default_rng(seed), "way", CHAIN)
    previous = None
    for fraction in np.linspace(0.1, 1.0, 10):
        s = fraction * np.linspace(0.0, 1.0, 101)
        shape = np.stack([np.interp(s, rest.arclength, rest.position[:, i]) for i in range(2)], axis=1) / fraction
        angle = np.interp(s, rest.arclength, rest.angle)
        pose = np.concatenate([shape[[0, -1]], angle[[0, -1], None]], axis=1)
        found = solve_elastica(pose, 1.0, guess=shape, n_samples=101)
        assert np.abs(found.position - shape).max() < 2e-3
        assert found.stability(61) > 1.0
        moved = 0.0 if previous is None else np.abs((shape - shape[0]) - (previous - previous[0])).max()
        assert moved < 0.25
        previous = shape


def test_crossed_shapes_are_found():
    s = np.linspace(0, 1, 40)[:, None]
    arch = np.concatenate([s, s * (1 - s)], axis=1)
    loop = np.concatenate([np.sin(7 * s) + s, np.cos(7 * s)], axis=1)
    assert not protocols._crosses_itself(arch) and protocols._crosses_itself(loop)


def test_a_plant_is_laid_out_in_the_start_shape():
    cable = Discretisation(n_links=12, dimension=3, timestep=0.005)
    plant = Plant(PlantConfig(discretisation=cable, settle_time=0.2))
    task = random_task("diverse", 1)
    seen = LaidOut(plant, task.start_shape).reset(task.start_pose)
    start = np.stack(
        [np.interp(cable.cable.keypoint_arclength, np.linspace(0, 1, 241), x) for x in task.start_shape.T], 1
    )
    assert np.abs(seen.keypoints - start).max() < 0.02
    observed = LaidOut(plant, task.start_shape).record(np.zeros((2, 3)), 0.1, samples=2)
    assert len(observed) == 2


def test_impossible_requests_are_refused(monkeypatch):
    monkeypatch.setattr(protocols, "MAX_DRAWS", 2)
    with pytest.raises(ValueError, match="None of 2 random shapes"):
        random_task("straight", 0, shapes=dataclasses.replace(ShapeConfig(), min_stability=1e6))
    with pytest.raises(ValueError, match="start is 'far'"):
        random_task("far", 0)  # pyright: ignore[reportArgumentType]
