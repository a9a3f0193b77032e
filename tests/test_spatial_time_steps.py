"""Time is cut as finely as the recorded motion needs it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import spatial_cases as cases
from cablejax.diagnose.protocol import explanation
from cablejax.simulate.rod import Rod
from cablejax.spatial.cable import SpatialCable
from cablejax.spatial.identify import layout_of, time_steps_for
from cablejax.spatial.windows import Windows, windows_of

_EDGES = 16


def _swung(factor: float) -> Windows:
    """The recording with grippers that go so many times as far from where they begin, in the same time."""
    windows = windows_of(cases.recording())
    begin = windows.position[:, :1]
    return dataclasses.replace(windows, position=begin + factor * (windows.position - begin))


def _cable(windows: Windows) -> SpatialCable:
    return SpatialCable(Rod(_EDGES, 1, twisting=False), layout_of(windows, cases.NOMINAL), windows)


def _found(windows: Windows):
    return time_steps_for(_cable(windows))


def test_a_step_for_every_sample_will_do_for_a_hand():
    found = _found(_swung(1.0))
    assert found.substeps == 1 and found.fine_enough and 0 < found.error < 0.005


@pytest.mark.slow
def test_fast_grippers_need_more():
    windows = _swung(3.0)
    found = _found(windows)
    assert found.substeps > 1
    layout = _cable(windows).layout
    damped = explanation((layout.named("bending_damping"), 0, [0.03]), (layout.named("viscous_drag"), 0, [0.3]))
    once, chosen, exact = (_cable(windows).finer(substeps).motion(damped) for substeps in (1, found.substeps, 32))
    # in the first half second: later it is torn, and snaps back one way or another
    assert np.abs(chosen - exact)[:, :25].mean() < 0.5 * np.abs(once - exact)[:, :25].mean()


@pytest.mark.slow
def test_says_when_the_finest_are_too_coarse():
    windows = _swung(1.0)
    time = windows.interval * np.arange(windows.position.shape[1])
    shaken = windows.position.copy()
    shaken[:, :, 0, 0] += 0.2 * np.sin(2 * np.pi * 7.0 * time)
    found = _found(dataclasses.replace(windows, position=shaken))
    assert found.substeps == 4 and not found.fine_enough
