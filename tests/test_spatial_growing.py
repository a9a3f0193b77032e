"""Fits that begin with the beginnings of windows find what fits to whole windows miss."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import spatial_cases as cases
from cablejax.diagnose.fit import evaluate, improve
from cablejax.diagnose.protocol import explanation
from cablejax.simulate.rod import Rod
from cablejax.spatial.cable import SpatialCable, typical_error
from cablejax.spatial.growing import beginning
from cablejax.spatial.identify import layout_of
from cablejax.spatial.search import accepted_effects, halves, search

_FOUND = ("bending_stiffness", "bending_damping")


@pytest.fixture(scope="module")
def cable():
    """A cable that swings for six seconds, there and back and there, seen without noise."""
    windows = cases.swinging(3)
    cable = SpatialCable(Rod(16, 1, twisting=False), layout_of(windows, cases.NOMINAL), windows)
    return cable.on(dataclasses.replace(windows, keypoints=cable.motion(_with(cable, 2.5, 0.03))))


def _with(cable, ratio, damping):
    return explanation(*((cable.layout.named(n), 0, (v,)) for n, v in zip(_FOUND, (ratio, damping), strict=True)))


def _fitted(cable, start):
    evidence = cable.evidence()
    (fit,) = improve(evidence, evaluate(evidence, [start]), 40)
    return np.concatenate(fit.explanation.values())


@pytest.mark.slow
@pytest.mark.parametrize("ratio,damping", [(0.1, 0.1), (0.3, 0.05), (0.5, 0.003), (10.0, 0.02)])
def test_a_fit_from_afar_ends_at_the_cable(cable, ratio, damping):
    begun = beginning(cable, [_with(cable, ratio, damping)])
    np.testing.assert_allclose(_fitted(cable, begun), [2.5, 0.03], rtol=0.03)


def test_a_fit_to_whole_windows_alone_ends_elsewhere(cable):
    assert _fitted(cable, _with(cable, 0.5, 0.003))[0] < 1.0


def test_it_begins_at_the_best_start_and_never_at_a_worse_one(cable):
    whole, true = cable.evidence(), _with(cable, 2.5, 0.03)
    starts = [_with(cable, 0.5, 0.003), true]
    begun = beginning(cable, starts)
    assert typical_error(whole, begun) <= typical_error(whole, true) < typical_error(whole, starts[0])


@pytest.mark.slow
def test_windows_too_short_to_have_beginnings_are_fitted_as_they_are(cable):
    short = {name: getattr(cable.windows, name)[:, :8] for name in ("keypoints", "position", "frames", "valid")}
    few = cable.on(dataclasses.replace(cable.windows, **short))
    start = _with(few, 2.4, 0.03)
    begun = beginning(few, [start])
    assert typical_error(few.evidence(), begun) <= typical_error(few.evidence(), start)


@pytest.mark.slow
def test_what_explains_a_soft_cable_is_tried_before_what_calms_it_down(cable):
    true = explanation((cable.layout.named("bending_stiffness"), 0, (0.02,)))
    soft = cable.on(dataclasses.replace(cable.windows, keypoints=cable.motion(true)))
    steps = search(soft, halves(soft.recording), ["viscous_drag", "bending_stiffness"])
    assert steps[1].effect == "bending_stiffness"
    assert accepted_effects(steps) == ["bending_stiffness"]


def test_nothing_is_simulated_after_the_last_recorded_sample(cable):
    one, valid = _with(cable, 2.5, 0.03), cable.windows.valid & (np.arange(cable.windows.valid.shape[1]) < 50)
    cut = cable.on(dataclasses.replace(cable.windows, valid=valid)).motion(one)
    np.testing.assert_array_equal(cut[:, :50], cable.motion(one)[:, :50])
    np.testing.assert_array_equal(cut[:, 50:], np.broadcast_to(cut[:, 49:50], cut[:, 50:].shape))
