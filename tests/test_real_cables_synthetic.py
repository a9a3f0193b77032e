"""Synthetic recordings are what they say they are."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cablejax.recordings.deform import NOMINAL, SAMPLE_INTERVAL
from real_cables import composite
from real_cables.protocol import protocol_windows
from real_cables.synthetic import (
    MARKERS,
    SAMPLES,
    SPEED,
    _motion,
    _rolled,
    _simulated,
    drawn_cable,
    synthetic_recordings,
    with_effects,
)

pytestmark = pytest.mark.slow

RECORDINGS = 1


@pytest.fixture(scope="module")
def fitted():
    return synthetic_recordings(0, "as fitted", RECORDINGS)


def test_windows_read_back_length_places_and_motion(fitted):
    cable, recordings = fitted
    windows = protocol_windows(recordings)
    assert windows.keypoints.shape == (RECORDINGS, SAMPLES, MARKERS, 3)
    assert windows.valid.all()
    np.testing.assert_allclose(windows.arclength[-1], cable.length, rtol=0.02)
    speed = np.linalg.norm(np.diff(windows.position[:, ::10], axis=1), axis=-1) / (10 * windows.interval)
    assert 0.4 < np.sqrt((speed**2).mean()) < 0.8  # 0.6 m/s, over many recordings
    assert not cable.rest_curvature.any() and not cable.roll


def test_a_seed_gives_one_recording_and_a_richer_law_another_one(fitted):
    cable, recordings = fitted
    again, same = synthetic_recordings(0, "as fitted", RECORDINGS)
    np.testing.assert_array_equal(same.keypoints, recordings.keypoints)
    assert again.stiffness == cable.stiffness != drawn_cable(np.random.default_rng(1), RECORDINGS).stiffness


def test_two_simulators_move_a_cable_alike():
    # so much drag that what the cable did before the recording is forgotten
    generator = np.random.default_rng(1)
    cable = dataclasses.replace(drawn_cable(generator, RECORDINGS), drag=8.0)
    position, direction = _motion(generator, RECORDINGS)
    frames = _rolled(direction, np.zeros(direction.shape[:3]))
    arclength = np.linspace(0.0, cable.length, MARKERS + 2)[1:-1]
    rod = _simulated(cable, arclength, position, frames)
    links = composite.simulated(cable, arclength, position, frames, SAMPLE_INTERVAL)[:, -SAMPLES:]
    moved = np.linalg.norm(rod - rod[:, :1], axis=-1).mean()
    assert np.linalg.norm(links - rod, axis=-1).mean() < 0.02 * moved


@pytest.mark.slow
def test_links_that_break_down_are_simulated_in_shorter_steps():
    cable, recordings = synthetic_recordings(1320, "composite", present=["gripper_rotation_offset"])
    assert np.isfinite(recordings.keypoints).all() and cable.grips.any()


@pytest.mark.parametrize("present", [[], ["drag"], ["bending_stiffness", "stiffness_profile"]])
def test_a_cable_has_the_effects_that_it_is_given_and_no_others(present):
    cable = with_effects(drawn_cable(np.random.default_rng(2), 3), present, np.random.default_rng(3))
    believed = NOMINAL.stiffness_over_density
    factor = abs(np.log(cable.stiffness / cable.laden / believed))
    assert (factor > np.log(1.29)) if "bending_stiffness" in present else (factor < 1e-9)
    uneven = np.abs(np.expm1(cable.profile)).max()
    assert (uneven > 0.25) if "stiffness_profile" in present else (uneven == 0)
    strength = cable.drag + SPEED * cable.quadratic_drag
    assert (0.2 <= strength <= 0.8) if "drag" in present else (strength == 0)
    assert not cable.grips.any() and cable.damping_time <= 1e-3


def test_a_richer_law_moves_the_same_cable_otherwise(fitted):
    cable, recordings = fitted
    richer, other = synthetic_recordings(0, "richer", RECORDINGS)
    assert richer.stiffness == cable.stiffness and richer.rest_curvature.any() and richer.roll
    off = np.abs(other.keypoints - recordings.keypoints).mean(axis=(0, 1, 3))
    np.testing.assert_array_equal(off[[0, 1, -2, -1]], 0)
    assert (off[2:-2] > 1e-3).all()
