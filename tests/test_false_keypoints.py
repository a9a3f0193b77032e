"""Keypoints that a tracker reads somewhere else for a few samples are found, and motion is not taken for them."""

from __future__ import annotations

import numpy as np
import pytest

from cablejax.false_keypoints import FAULTS, misread
from diagnose_cases import INTERVAL, clean
from recording_cases import DATA, SPACING, needs_deform, swinging


def strayed(
    points: np.ndarray, size: float, share: float, longest: int, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Keypoints of which single ones are `size` [m] off for up to `longest` samples, and which those are."""
    rng = np.random.default_rng(seed)
    off, points = np.zeros(points.shape[:2], bool), points.copy()
    for sample, index in np.argwhere(rng.random(off.shape) < share):
        stretch = slice(sample, sample + rng.integers(1, longest + 1))
        way = rng.normal(size=points.shape[2])
        points[stretch, index] += size * way / np.linalg.norm(way)
        off[stretch, index] = True
    return points, off


@pytest.mark.parametrize(
    ("size", "share", "longest"), [(0.03, 0.01, 1), (0.3, 0.003, 1), (0.1, 0.03, 1), (0.1, 0.002, 5)]
)
def test_misread_samples_are_found(size, share, longest):
    right = swinging(1000)
    points, off = strayed(right, size, share, longest)
    found = misread(0.01 * np.arange(len(points)), points, SPACING)
    assert (found & off).sum() > 0.95 * off.sum() > 10
    # where two are close, what lies between them may be lost too
    assert (found & ~off).sum() < 0.2 * off.sum()


def test_samples_that_are_missing_or_late_do_not_hide_them():
    rng = np.random.default_rng(1)
    points, off = strayed(swinging(1000), 0.05, 0.01, 2)
    points[rng.random(off.shape) < 0.1] = np.nan
    kept = rng.random(1000) > 0.05
    off &= np.isfinite(points).all(axis=-1)
    found = misread(0.01 * np.arange(1000)[kept], points[kept], SPACING)
    assert (found & off[kept]).sum() > 0.9 * off[kept].sum()
    assert not found[np.isnan(points[kept]).any(axis=-1)].any()


def test_a_cable_that_only_moves_has_none():
    time = INTERVAL * np.arange(clean().shape[1])
    assert not any(misread(time, points.astype(float), SPACING).any() for points in clean())
    assert not misread(0.01 * np.arange(200), swinging(), SPACING).any()
    # however fast it does: a whip of all keypoints within one sample
    whip = swinging()
    whip[100] += [0.0, 0.2, 0.0]
    assert not misread(0.01 * np.arange(200), whip, SPACING).any()
    # and a marker that has slipped to another place stays there
    slipped = swinging()
    slipped[100:, 4] += [0.0, 0.0, 0.2]
    assert not misread(0.01 * np.arange(200), slipped, SPACING).any()


def test_little_is_no_reason_to_doubt():
    for points in (swinging(4), np.full((20, 9, 3), np.nan), swinging(1)):
        for find in FAULTS.values():
            assert not find(0.01 * np.arange(len(points)), points, SPACING).any()


@needs_deform
def test_a_few_markers_of_real_cables_are():
    """For one or two samples each; see `docs/how_to/own_recording.md`."""
    found = []
    for name in ("DLO1", "DLO2", "DLO3"):
        with np.load(DATA / "deform" / f"{name}.npz") as blocks:
            for number, points in zip(blocks["source_id"], blocks["keypoints"].astype(float), strict=True):
                wrong = misread(
                    float(blocks["dt"]) * np.arange(len(points)), points, np.full(points.shape[1] - 1, 0.08)
                )
                found += [(name, int(number), int(sample), int(index)) for sample, index in np.argwhere(wrong)]
    assert ("DLO1", 66, 325, 7) in found
    assert len(found) < 12
