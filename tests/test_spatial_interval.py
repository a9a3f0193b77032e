"""Intervals of EI/rho hold the true value, and know what the recordings cannot tell."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import spatial_cases as cases
from cablejax.spatial.fit import Simulator
from cablejax.spatial.identify import Identified, layout_of
from cablejax.spatial.interval import stiffness_interval
from cablejax.spatial.newton import improve
from cablejax.spatial.rod import Rod
from cablejax.spatial.values import shared_by_all
from cablejax.spatial.windows import windows_of

_FOUND = ("bending_stiffness", "bending_damping")


@pytest.fixture(scope="module")
def found():
    windows = windows_of(cases.recording())
    simulator = Simulator(Rod(16, twisting=False), layout_of(windows, cases.NOMINAL, twisting=False))
    start = shared_by_all(np.zeros(simulator.layout.size), windows.group)
    start.shared[simulator.layout.slices["damping_time"]] = 0.05
    values = improve(simulator, start, _FOUND, windows, iterations=8).values
    first = np.arange(len(windows)) < 2
    return windows, Identified(simulator, _FOUND, _FOUND, (), values, (values, values), (), first)


def _width(interval):
    return np.log(interval[1] / interval[0])


def test_is_wider_the_more_may_be_true_and_holds_the_true_value(found):
    windows, identified = found
    intervals = []
    for more in ((), ("viscous_drag",), ("viscous_drag", "lumped_mass")):
        tried = dataclasses.replace(identified, tried=(*_FOUND, *more))
        intervals.append(stiffness_interval(tried, identified.values, windows))
    widths = [_width(interval) for interval in intervals]
    assert 0 < widths[0] < widths[1] < widths[2] < 0.3
    # mass that sits all along the cable makes it slower just as a softer cable is
    assert widths[2] > 1.5 * widths[1]
    # the others are as narrow as the few per cent by which the coarse rod at 20 ms is off, which no interval tells
    low, high = intervals[2]
    assert low < cases.TRUE_RATIO * cases.NOMINAL < high


def test_says_more_from_more_recordings(found):
    windows, identified = found
    every = _width(stiffness_interval(identified, identified.values, windows))
    two = _width(stiffness_interval(identified, identified.values, windows.chosen([0, 1])))
    assert every < 0.7 * two
