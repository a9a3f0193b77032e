"""The boundary-value solver of the clamped elastica, against what is known in closed form and against itself."""

import numpy as np
import pytest
from scipy.special import ellipk

from cablejax.cable import Discretisation
from cablejax.simulate.elastica import ElasticaError, elastica, solve_elastica
from cablejax.simulate.equilibrium import arch_angles, chain_nodes, find_equilibrium


def ends(start: float, end: float, distance: float, *, turn: float = 0.0, shift=(0.0, 0.0)) -> np.ndarray:
    """Grippers `distance` apart, tangents [deg] against the chord, then turned and shifted as a whole."""
    half = 0.5 * distance * np.array([np.cos(turn), np.sin(turn)])
    start, end = np.radians([start, end]) + turn
    return np.array([[*(shift - half), start], [*(shift + half), end]])


def test_circle_is_an_elastica():
    # Half a turn of a circle of radius 1 / pi is in equilibrium without any force.
    shape = solve_elastica(ends(-90, 90, 2 / np.pi), 1.0)
    np.testing.assert_allclose(shape.curvature, np.pi, atol=1e-5)
    np.testing.assert_allclose(shape.force, 0.0, atol=1e-4)


def test_clamped_arch_carries_four_quarter_waves_of_eulers_column():
    # A clamped arch is four quarter waves; each is Euler's column with quarter length K(m) / sqrt(|f|), m = sin^2(a/2)
    # for the largest angle a.
    shape = solve_elastica(ends(0, 0, 0.8), 1.0)
    largest = np.abs(shape.angle).max()
    expected = (4 * ellipk(np.sin(largest / 2) ** 2)) ** 2
    np.testing.assert_allclose(-shape.force[0], expected, rtol=1e-4)
    assert shape.stability() > 0


def test_balance_of_moments_and_inextensibility():
    shape = solve_elastica(ends(100, 80, 0.6), 1.0, n_samples=2001)
    ds = shape.arclength[1]
    bend = np.gradient(np.gradient(shape.angle, ds), ds)
    torque = shape.force[0] * np.sin(shape.angle) - shape.force[1] * np.cos(shape.angle)
    np.testing.assert_allclose(bend[5:-5], torque[5:-5], atol=2e-2)
    np.testing.assert_allclose(np.linalg.norm(np.diff(shape.position, axis=0), axis=1), ds, rtol=1e-4)


@pytest.mark.parametrize(
    ("start", "end", "distance"), [(-90, 90, 0.45), (-90, -90, 0.65), (115, 115, 0.52), (0, 0, 0.99)]
)
def test_ends_are_met_and_the_shape_moves_with_them(start, end, distance):
    pose = ends(start, end, distance)
    shape = solve_elastica(pose, 1.0)
    np.testing.assert_allclose(shape.position[[0, -1]], pose[:, :2], atol=1e-8)
    np.testing.assert_allclose(shape.angle[[0, -1]], pose[:, 2], atol=1e-8)
    turn, shift = 2.5, np.array([3.0, -1.0])
    moved = solve_elastica(ends(start, end, distance, turn=turn, shift=shift), 1.0)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    np.testing.assert_allclose(moved.position, shape.position @ rotation.T + shift, atol=1e-6)
    # Twice the length and twice the distance: the same shape, twice as large.
    large = solve_elastica(ends(start, end, 2 * distance), 2.0)
    np.testing.assert_allclose(large.position, 2 * shape.position, atol=1e-6)


@pytest.mark.parametrize(
    ("start", "end", "distance"),
    [(-70, -60, 0.7), (-70, -30, 0.7), (-80, -40, 0.6), (-60, -70, 0.6), (91, 57, 0.51), (-25, -21, 0.57)],
)
def test_an_s_with_unequal_ends_is_found_where_the_chain_rests(start, end, distance):
    pose, config = ends(start, end, distance), Discretisation(n_links=97)
    shape = solve_elastica(pose, 1.0)
    assert shape.stability() > 0
    angles = find_equilibrium(config, pose, arch_angles(config, pose)).angles
    nodes = chain_nodes(config, pose, angles)
    middle = np.stack([np.interp((np.arange(96) + 0.5) / 96, shape.arclength, shape.position[:, i]) for i in (0, 1)])
    assert np.abs(nodes - middle.T).max() < 2e-3


def test_slack_lies_on_the_side_to_which_the_ends_lean():
    assert solve_elastica(ends(0.5, -0.5, 0.99), 1.0).position[:, 1].max() > 0.05
    assert solve_elastica(ends(-0.5, 0.5, 0.99), 1.0).position[:, 1].min() < -0.05


def test_guess_selects_the_other_arch():
    pose = ends(0, 0, 0.9)
    up = solve_elastica(pose, 1.0)
    down = solve_elastica(pose, 1.0, guess=up.position[::20] * [1, -1])
    np.testing.assert_allclose(down.position, up.position * [1, -1], atol=1e-5)


def test_second_bending_mode_is_unstable():
    # Clamped ends on their chord: the full sine wave in the angle is in equilibrium, but the arch has less energy.
    s = np.linspace(0, 1, 61)
    wave = np.cumsum(
        np.stack([np.cos(0.9 * np.sin(3 * np.pi * s)), np.sin(0.9 * np.sin(3 * np.pi * s))], axis=1) / 60, axis=0
    )
    pose = ends(0, 0, 0.85)
    shape = solve_elastica(pose, 1.0, guess=wave - wave.mean(axis=0))
    assert np.ptp(shape.position[:, 1]) < np.ptp(solve_elastica(pose, 1.0).position[:, 1])
    assert shape.stability() < 0


def test_points_at_arc_lengths():
    s = np.linspace(0, 1, 13)
    points = elastica(ends(-90, 90, 2 / np.pi), 1.0, s)
    radius = 1 / np.pi
    np.testing.assert_allclose(points, radius * np.stack([-np.cos(np.pi * s), -np.sin(np.pi * s)], axis=1), atol=1e-5)


def test_impossible_ends_are_refused():
    with pytest.raises(ElasticaError, match=r"1\.2 m apart .* 1 m long"):
        solve_elastica(ends(0, 0, 1.2), 1.0)
    with pytest.raises(ValueError, match="not finite"):
        solve_elastica(np.full((2, 3), np.nan), 1.0)
