"""Time is cut as finely as the recorded motion needs it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import spatial_cases as cases
from cablejax.simulate.rod import Rod
from cablejax.spatial.fit import Simulator
from cablejax.spatial.identify import layout_of
from cablejax.spatial.time_steps import time_steps_for
from cablejax.spatial.windows import Windows, windows_of

_EDGES = 16


def _swung(factor: float) -> Windows:
    """The recording with grippers that go so many times as far from where they begin, in the same time."""
    windows = windows_of(cases.recording())
    begin = windows.position[:, :1]
    return dataclasses.replace(windows, position=begin + factor * (windows.position - begin))


def _found(windows: Windows):
    return time_steps_for(windows, layout_of(windows, cases.NOMINAL, twisting=False), _EDGES)


@pytest.fixture(scope="module")
def fast():
    windows = _swung(3.0)
    return windows, _found(windows)


def test_a_step_for_every_sample_will_do_for_a_hand():
    found = _found(_swung(1.0))
    assert found.substeps == 1 and found.fine_enough and 0 < found.error < 0.005


def test_fast_grippers_need_more(fast):
    windows, found = fast
    assert found.substeps > 1
    layout = layout_of(windows, cases.NOMINAL, twisting=False)
    damped = np.where(layout.active(["bending_damping", "viscous_drag"]), layout.starts, 0.0)
    once, chosen, exact = (
        Simulator(Rod(_EDGES, substeps, twisting=False), layout).predict(damped, windows)
        for substeps in (1, found.substeps, 8)
    )
    assert np.abs(chosen - exact).mean() < 0.5 * np.abs(once - exact).mean()


def test_says_when_the_finest_are_too_coarse():
    windows = _swung(1.0)
    time = windows.interval * np.arange(windows.position.shape[1])
    shaken = windows.position.copy()
    shaken[:, :, 0, 0] += 0.2 * np.sin(2 * np.pi * 7.0 * time)
    found = _found(dataclasses.replace(windows, position=shaken))
    assert found.substeps == 4 and not found.fine_enough
