"""Synthetic recordings are what they say they are."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cablejax.recordings.deform import SAMPLE_INTERVAL, repaired_blocks
from real_cables import composite
from real_cables.protocol import protocol_windows
from real_cables.synthetic import (
    LENGTH,
    STIFFNESS,
    _motion,
    _rolled,
    _simulated,
    drawn_cable,
    synthetic_recordings,
    with_effects,
)

pytestmark = pytest.mark.slow

RECORDINGS, SAMPLES = 2, 100


@pytest.fixture(scope="module")
def fitted():
    return synthetic_recordings(0, "as fitted", RECORDINGS, SAMPLES)


def test_windows_read_back_length_places_and_motion(fitted):
    cable = fitted.cable
    windows = protocol_windows(repaired_blocks(fitted.recordings)[0])
    assert windows.keypoints.shape == (RECORDINGS, SAMPLES, len(cable.offset), 3)
    np.testing.assert_allclose(windows.arclength[-1], cable.length, rtol=0.03)
    speed = np.linalg.norm(np.diff(windows.position[:, ::10], axis=1), axis=-1) / (10 * windows.interval)
    assert 0.5 < np.sqrt((speed**2).mean()) / cable.speed < 1.5
    assert not cable.rest_curvature.any() and not cable.roll


def test_cables_span_the_ranges():
    drawn = [drawn_cable(np.random.default_rng(seed), RECORDINGS) for seed in range(200)]
    for (low, high), of in ((LENGTH, [c.length for c in drawn]), (STIFFNESS, [c.stiffness / c.laden for c in drawn])):
        assert low <= min(of) < 1.2 * low and high / 1.2 < max(of) <= high


def test_a_seed_gives_one_recording_and_a_richer_law_another_one(fitted):
    again = synthetic_recordings(0, "as fitted", RECORDINGS, SAMPLES)
    np.testing.assert_array_equal(again.recordings.keypoints, fitted.recordings.keypoints)
    other = drawn_cable(np.random.default_rng(1), RECORDINGS)
    assert again.cable.stiffness == fitted.cable.stiffness != other.stiffness


def test_an_effect_moves_the_markers_and_one_that_is_absent_does_not(fitted):
    assert fitted.moved_by("drag") > 1e-3
    without = dataclasses.replace(fitted, cable=fitted.cable.without("drag"))
    assert without.moved_by("drag") == 0
    with pytest.raises(ValueError, match=r"The effect is 'wind', expected one of bending_stiffness"):
        fitted.moved_by("wind")


def test_two_simulators_move_a_cable_alike():
    # so much drag that what the cable did before the recording is forgotten
    generator = np.random.default_rng(1)
    cable = dataclasses.replace(drawn_cable(generator, RECORDINGS), length=0.9, stiffness=0.05, drag=8.0)
    position, direction = _motion(cable, generator, RECORDINGS, SAMPLES)
    frames = _rolled(direction, np.zeros(direction.shape[:3]))
    arclength = np.linspace(0.0, cable.length, len(cable.offset) + 2)[1:-1]
    rod = _simulated(cable, arclength, position, frames)
    links = composite.simulated(cable, arclength, position, frames, SAMPLE_INTERVAL)[:, -SAMPLES:]
    moved = np.linalg.norm(rod - rod[:, :1], axis=-1).mean()
    assert np.linalg.norm(links - rod, axis=-1).mean() < 0.02 * moved


def test_links_that_break_down_are_simulated_in_shorter_steps(monkeypatch):
    generator = np.random.default_rng(1)
    cable = dataclasses.replace(drawn_cable(generator, 1), length=0.4, stiffness=0.2, damping_time=0.002)
    position, direction = _motion(dataclasses.replace(cable, speed=0.2), generator, 1, 30)
    frames = _rolled(direction, np.zeros(direction.shape[:3]))
    monkeypatch.setattr(composite, "_STABLE", 12.0)
    monkeypatch.setattr(composite, "_SHORTER", (1,))
    arclength = np.linspace(0.0, cable.length, len(cable.offset) + 2)[1:-1]
    assert composite.broken(composite.simulated(cable, arclength, position, frames, SAMPLE_INTERVAL), cable.length)
    monkeypatch.setattr(composite, "_SHORTER", (1, 4, 16))
    found = composite.simulated(cable, arclength, position, frames, SAMPLE_INTERVAL)
    assert not composite.broken(found, cable.length) and cable.grips.any()


@pytest.mark.parametrize("present", [[], ["drag"], ["bending_stiffness", "stiffness_profile"]])
def test_a_cable_has_the_effects_that_it_is_given_and_no_others(present):
    cable = with_effects(drawn_cable(np.random.default_rng(2), 3), present, np.random.default_rng(3))
    factor = abs(np.log(cable.stiffness / cable.laden / cable.believed))
    assert (factor > np.log(1.29)) if "bending_stiffness" in present else (factor < 1e-9)
    uneven = np.abs(np.expm1(cable.profile)).max()
    assert (uneven > 0.25) if "stiffness_profile" in present else (uneven == 0)
    strength = cable.drag + cable.speed * cable.quadratic_drag
    assert (0.2 <= strength <= 0.8) if "drag" in present else (strength == 0)
    assert not cable.grips.any() and cable.damping_time <= 1e-3


def test_a_richer_law_moves_the_same_cable_otherwise(fitted):
    richer = synthetic_recordings(0, "richer", RECORDINGS, SAMPLES)
    assert richer.cable.stiffness == fitted.cable.stiffness
    assert richer.cable.rest_curvature.any() and richer.cable.roll
    off = np.abs(richer.recordings.keypoints - fitted.recordings.keypoints)
    np.testing.assert_array_equal(off[:, :, [0, 1, -2, -1]], 0)
    moved = np.nanmean(off[:, :, 2:-2], axis=(0, 1, 3))
    assert (moved > 0).all() and moved.mean() > 1e-3
