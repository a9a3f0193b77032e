"""Synthetic recordings are what they say they are."""

from __future__ import annotations

import numpy as np
import pytest

from real_cables.protocol import protocol_windows
from real_cables.synthetic import MARKERS, SAMPLES, drawn_cable, synthetic_recordings

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


def test_a_richer_law_moves_the_same_cable_otherwise(fitted):
    cable, recordings = fitted
    richer, other = synthetic_recordings(0, "richer", RECORDINGS)
    assert richer.stiffness == cable.stiffness and richer.rest_curvature.any() and richer.roll
    off = np.abs(other.keypoints - recordings.keypoints).mean(axis=(0, 1, 3))
    np.testing.assert_array_equal(off[[0, 1, -2, -1]], 0)
    assert (off[2:-2] > 1e-3).all()
