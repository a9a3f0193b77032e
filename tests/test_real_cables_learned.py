"""Corrections learned on top of the rod: the graph network, wherever the cable hangs, and the ridge residual."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import spatial_cases as cases
from cablejax.spatial.cable import errors
from cablejax.spatial.windows import windows_of
from real_cables import network
from real_cables.residual import fit_residual


@pytest.fixture(scope="module")
def learned():
    windows = windows_of(cases.recording(6))
    chord = np.linalg.norm(windows.position[:, :, 1] - windows.position[:, :, 0], axis=-1)
    off = (0.02 + 0.1 * (chord - 0.5))[..., None] * np.sin(np.pi * windows.arclength[:-1] / windows.arclength[-1])
    simulated = windows.keypoints - off[..., None] * np.array([0.0, 0.0, 1.0])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(network, "_ROUNDS", 6)
        patch.setattr(network, "_PASSES", 2)
        patch.setattr(network, "_FOLDS", 2)
        patch.setattr(network, "_SIZES", (16,))
        yield windows, simulated, network.fit_network(simulated, windows)


@pytest.mark.slow
def test_corrects_recordings_that_were_left_out(learned):
    windows, simulated, fitted = learned
    before = errors(simulated, windows).mean()
    assert errors(fitted.left_out, windows).mean() < 0.5 * before
    corrected = fitted.correct(simulated, windows)
    assert errors(corrected, windows).mean() < 0.2 * before
    np.testing.assert_array_equal(corrected[:, :2], simulated[:, :2])
    assert fitted.rounds > 0 and fitted.unseen[1] < fitted.unseen[0]


@pytest.mark.slow
def test_turns_and_moves_with_the_room(learned):
    windows, simulated, fitted = learned
    turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    shift = np.array([1.0, -2.0, 0.3])
    moved = dataclasses.replace(
        windows,
        keypoints=windows.keypoints @ turn.T + shift,
        position=windows.position @ turn.T + shift,
        frames=windows.frames @ turn.T,
    )
    corrected = fitted.correct(simulated @ turn.T + shift, moved)
    np.testing.assert_allclose(corrected, fitted.correct(simulated, windows) @ turn.T + shift, atol=1e-5)


@pytest.mark.slow
def test_no_rounds_correct_nothing(learned):
    windows, simulated, fitted = learned
    untrained = dataclasses.replace(fitted, rounds=0, weights=None)
    np.testing.assert_array_equal(untrained.correct(simulated, windows), simulated)


def test_the_residual_learns_what_the_clamps_tell():
    windows = windows_of(cases.recording())
    generator = np.random.default_rng(1)
    weights = generator.normal(size=(3, windows.keypoints.shape[2]))
    off = 0.05 * np.einsum("wtc,cf->wtf", windows.position[:, :, 1] - windows.position[:, :, 0], weights)
    simulated = windows.keypoints - off[..., None] * np.array([0.0, 0.0, 1.0])
    residual = fit_residual(simulated, windows)
    left = errors(residual.correct(simulated, windows), windows).mean()
    assert left < 0.2 * errors(simulated, windows).mean()
    np.testing.assert_array_equal(residual.correct(simulated, windows)[:, :2], simulated[:, :2])
