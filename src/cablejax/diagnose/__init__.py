"""Where a simulator is wrong, which unmodelled effect causes it, and how far the gap shrinks with it."""

from cablejax.diagnose.belief import Calibration
from cablejax.diagnose.diagnosis import Diagnosis
from cablejax.diagnose.recording import DiagnosisError
from cablejax.diagnose.run import diagnose
from cablejax.diagnose.verdict_json import verdict_json, write_verdict
from cablejax.effects import LIBRARY, Context, Effect, Parameter

__all__ = [
    "LIBRARY",
    "Calibration",
    "Context",
    "Diagnosis",
    "DiagnosisError",
    "Effect",
    "Parameter",
    "diagnose",
    "verdict_json",
    "write_verdict",
]
