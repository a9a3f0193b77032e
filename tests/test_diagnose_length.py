"""A length that is stated wrong is found, and not taken for a cable that stretches."""

import dataclasses
import re

import numpy as np
import pytest

from cablejax.diagnose import diagnose, verdict_json
from cablejax.diagnose.belief import Calibration
from cablejax.diagnose.case import Case
from cablejax.diagnose.caveats import caveats_of
from cablejax.diagnose.length import other_length
from cablejax.diagnose.reading import with_readings
from cablejax.types import GapLog
from diagnose_cases import record

STRETCHING = ("axial_stretch", (4.0,))
SCALED = ("camera_similarity", (0.99, 0.0, 0.0, 0.0))


def stated(log: GapLog, ratio: float) -> GapLog:
    """The log of a cable that is said to be so many times as long as it is."""
    cable = {**log.meta["cable"], "length_m": ratio * log.meta["cable"]["length_m"]}
    marks = [ratio * s for s in log.meta["keypoint_arclength_m"]]
    return dataclasses.replace(log, meta={**log.meta, "cable": cable, "keypoint_arclength_m": marks})


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [0.99, 1.01])
def test_keypoints_show_the_length(ratio):
    log = stated(record(), ratio)
    length = other_length(Case.of(log))
    assert length.stated == ratio
    assert length.measured == pytest.approx(1.0, abs=1e-3)
    assert length.case is not None
    back = length.case.log
    assert back.meta["cable"]["length_m"] == length.measured
    np.testing.assert_allclose(back.meta["keypoint_arclength_m"], np.linspace(0, length.measured, 13))


@pytest.mark.parametrize("noise", [0.0, 1e-2])
def test_a_right_length_is_not_doubted(noise):
    log = record()
    off = noise * np.random.default_rng(0).standard_normal(log.keypoints.shape).astype(np.float32)
    assert other_length(Case.of(dataclasses.replace(log, keypoints=log.keypoints + off))) is None


def test_a_crumpled_nominal_cable_says_nothing_of_the_length():
    log = record()
    case = Case.of(log)
    assert other_length(dataclasses.replace(case, nominal=0.4 * case.nominal)) is None


@pytest.mark.slow
def test_caveat_on_keypoints_that_do_not_fit_the_length():
    log = stated(record(), 1.01)
    case = Case.of(log)
    length = other_length(case)
    (text,) = caveats_of(case, Calibration(), length, 0.0, commissioned=True)
    assert re.match(r"Keypoints are 1\.0 % closer together than the stated arc lengths, in every episode", text)
    assert length.assumes in with_readings(case, [length]).simulator.other_laws


@pytest.mark.slow
def test_a_length_that_is_wrong_is_no_effect():
    found = diagnose(stated(record(), 1.01))
    assert found.verdict == "none" and "This assumes that the cable is 1 m long, not 1.01 m as stated" in found.sentence
    assert "explains this log better than any effect on a cable of the stated 1.01 m" in found.caveats[0]
    assert verdict_json(found)["quantities"]["length_m"]["value"] == pytest.approx(1.0, abs=1e-3)


@pytest.mark.slow
def test_an_effect_is_named_beside_a_length_that_is_wrong():
    found = diagnose(stated(record(("gripper_rotation_offset", (0.15,))), 1.01))
    assert found.verdict == "named" and [effect.name for effect in found.effects] == ["gripper_rotation_offset"]
    assert "length_m" in found.quantities


@pytest.mark.slow
@pytest.mark.parametrize("effect", [STRETCHING, SCALED], ids=lambda e: e[0])
def test_a_cause_that_moves_keypoints_closer_is_named_all_the_same(effect):
    log = record(effect)
    found = diagnose(log)
    assert [one.name for one in found.effects] == [effect[0]] and not found.quantities
