"""Diagnoses where a simulator is wrong, which unmodelled effect causes it, and how far the gap shrinks with it.

`diagnose` takes a gap log of a cable on a table; `diagnose_simulator` a simulator of your own, see `protocol`.
"""

from cablejax.diagnose.belief import Calibration
from cablejax.diagnose.diagnosis import CableDiagnosis, Diagnosis
from cablejax.diagnose.planar_run import diagnose
from cablejax.diagnose.protocol import Explanation, Simulator, explanation, in_batches
from cablejax.diagnose.recording import DiagnosisError
from cablejax.diagnose.run import diagnose_simulator
from cablejax.diagnose.verdict_json import verdict_json, write_verdict
from cablejax.effects import LIBRARY, CableEffect, Effect, Parameter

__all__ = [
    "LIBRARY",
    "CableDiagnosis",
    "CableEffect",
    "Calibration",
    "Diagnosis",
    "DiagnosisError",
    "Effect",
    "Explanation",
    "Parameter",
    "Simulator",
    "diagnose",
    "diagnose_simulator",
    "explanation",
    "in_batches",
    "verdict_json",
    "write_verdict",
]
