"""The chain at rest against an independent boundary-value solver of the elastica."""

from __future__ import annotations

import numpy as np
import pytest

from cablejax.cable import Cable, Discretisation
from cablejax.simulate import MjxEngine
from cablejax.simulate.composite import link_lengths
from cablejax.simulate.elastica import elastica, solve_elastica
from cablejax.simulate.equilibrium import (
    angles_of_keypoints,
    arch_angles,
    beyond_joints,
    equilibrium_state,
    find_equilibrium,
    links_of,
)

POSE = np.array([[-0.3, 0.05, 1.2], [0.35, -0.02, -0.7]])


def error(n_links: int) -> float:
    """Largest distance of a keypoint from the elastica [m]."""
    config = Discretisation(n_links=n_links)
    engine = MjxEngine(config)
    keypoints = np.asarray(engine.keypoints(engine.initial_state(POSE)))
    exact = elastica(POSE, config.cable.length, config.cable.keypoint_arclength, guess=keypoints)
    return float(np.linalg.norm(keypoints - exact, axis=1).max())


@pytest.mark.slow
def test_the_chain_converges_to_the_elastica_with_the_square_of_the_link_length():
    errors = {n: error(n) for n in (13, 24, 25, 49)}
    assert errors[24] <= 1e-3
    assert 3.3 < errors[13] / errors[25] < 4.8
    assert 3.3 < errors[25] / errors[49] < 4.8


def test_equilibrium_is_a_minimum_and_stability_falls_towards_snap_through():
    config = Discretisation(n_links=13)
    stabilities = []
    angles = None
    for lean in (0.6, 0.3, 0.0, -0.15):
        pose = np.array([[-0.45, 0.0, lean], [0.45, 0.0, -lean]])
        found = find_equilibrium(config, pose, arch_angles(config, pose) if angles is None else angles)
        angles = found.angles
        stabilities.append(found.stability)
    assert all(s > 0 for s in stabilities)
    assert stabilities == sorted(stabilities, reverse=True)


@pytest.mark.parametrize("n_links", [5, 13, 33])
def test_a_settled_chain_meets_its_grippers_and_has_no_slope_left(n_links):
    config = Discretisation(n_links=n_links)
    lengths = link_lengths(config)
    for pose in (
        POSE,
        np.array([[-0.4985, 0.0, 0.01], [0.4985, 0.0, -0.01]]),
        np.array([[-0.3, 0, 0.9], [0.3, 0, 0.8]]),
    ):
        angles = find_equilibrium(config, pose, arch_angles(config, pose)).angles
        theta, links = links_of(lengths, angles, pose[0, 2])
        np.testing.assert_allclose(pose[0, :2] + links.sum(axis=0), pose[1, :2], atol=1e-8)
        assert theta[-1] == pytest.approx(pose[1, 2], abs=1e-8)
        # bending moments are balanced by a force and a moment on the far end
        beyond = beyond_joints(links)
        held = np.stack([-beyond[:, 1], beyond[:, 0], np.ones_like(angles)], axis=1)
        moments = angles / config.link_length
        balanced = held @ np.linalg.lstsq(held, moments, rcond=1e-9)[0]
        np.testing.assert_allclose(moments, balanced, atol=1e-6 * np.abs(moments).max())


def test_a_pose_out_of_reach_is_refused():
    config = Discretisation(n_links=13)
    with pytest.raises(ValueError, match=r"1\.2000 m apart"):
        find_equilibrium(config, np.array([[-0.6, 0, 0], [0.6, 0, 0.0]]), np.zeros(12))


def test_a_guess_of_another_number_of_cables_is_refused():
    """One guess of 24 points for two cables was taken for two of 12."""
    pose = np.tile([[-0.4, 0.0, 0.9], [0.4, 0.0, -0.5]], (2, 1, 1))
    with pytest.raises(ValueError, match=r"guess has shape \(24, 2\), expected \(2, N, 2\)"):
        equilibrium_state(Discretisation(n_links=13), pose, guess=np.zeros((24, 2)))


def test_a_guess_is_read_at_the_marks_of_the_cable():
    pose = np.array([[-0.4, 0.0, 0.9], [0.4, 0.0, -0.5]])
    uneven = (0.0, 0.05, 0.1, 0.2, 0.6, 0.8, 1.0)
    config = Discretisation(Cable(n_keypoints=7, marks=uneven), n_links=33)
    exact = solve_elastica(pose, 1.0)
    points = np.stack([np.interp(uneven, exact.arclength, exact.position[:, i]) for i in range(2)], axis=1)
    turned = pose[0, 2] + np.cumsum(angles_of_keypoints(config, pose, points))
    inner = np.interp((np.arange(32) + 1) / 32, exact.arclength, exact.angle)
    assert np.abs(turned - inner).max() < 0.25
