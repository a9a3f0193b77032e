"""Cables that begin where the table holds them, and not where they would settle."""

import dataclasses

import numpy as np
import pytest

from cablejax.diagnose import diagnose
from cablejax.diagnose.belief import Calibration
from cablejax.diagnose.case import Case
from cablejax.diagnose.reading import Held, held, with_readings
from cablejax.types import GapLog
from diagnose_cases import CABLE, arrived, log_of, noise, record

ROUGH = dataclasses.replace(CABLE, friction_coefficient=0.6)


def held_log(*effects) -> GapLog:
    """Of a cable on a rough table, led to its first pose by the motion backwards, that stayed as this left it."""
    points = arrived(*effects, cable=ROUGH)
    return log_of(points + noise(points.shape, 0.5, 0), cable=ROUGH)


@pytest.mark.slow
def test_a_log_whose_cable_begins_elsewhere_is_read_as_held_by_the_table():
    log = held_log()
    case = Case.of(log)
    reading = held(case, Calibration())
    assert isinstance(reading, Held) and reading.case is not None
    assert 0.003 < reading.off < 0.1
    # it begins where it was seen and stays there: the grippers rest in the first 17 samples
    seen, settled, start = (x[:, :16] for x in (case.recording.keypoints, case.nominal, reading.case.nominal))
    assert np.abs(start - seen.mean(axis=1, keepdims=True)).max() < 0.0012
    assert np.abs(settled - seen.mean(axis=1, keepdims=True)).max() > 0.002
    assert reading.assumes in with_readings(case, [reading]).simulator.other_laws
    assert held(reading.case, Calibration()) is None


def test_a_cable_that_has_settled_is_read_in_one_way():
    log = record()
    assert held(Case.of(log), Calibration()) is None


@pytest.mark.slow
def test_a_start_held_by_the_table_is_no_gap():
    found = diagnose(held_log())
    assert found.verdict == "none" and not found.effects
    assert "the cable starts in its first observed shape, held there by the table" in found.sentence
    assert found.caveats[0].startswith("At the start, keypoints are up to")


@pytest.mark.slow
def test_an_effect_is_named_beside_a_start_held_by_the_table():
    found = diagnose(held_log(("gripper_rotation_offset", (0.15,))))
    assert found.verdict == "named" and [effect.name for effect in found.effects] == ["gripper_rotation_offset"]
    low, high = found.effects[0].parameters["angle_rad"].ci90
    assert low <= 0.15 <= high
