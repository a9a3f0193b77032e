"""Alternative readings of a log: another cable length, or cables that begin where the table holds them.

Each reading is a further law of the simulator (see `laws`), with the same prior probability as any other. If it is the
most probable law, the log is diagnosed again under this reading.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Sequence

import numpy as np

from cablejax.diagnose.belief import Calibration
from cablejax.diagnose.case import Case, first_shapes
from cablejax.diagnose.diagnosis import CableDiagnosis, UnderLaw
from cablejax.diagnose.recording import DiagnosisError


class Reading(abc.ABC):
    """A reading of a log.

    Attributes:
        assumes: in words, for a law of the simulator.
        case: of the log as this reading has it; None where the simulator cannot follow it.
    """

    assumes: str
    case: Case | None

    @abc.abstractmethod
    def caveat(self, probability: float) -> str:
        """What was assumed and why, with its probability among all laws."""

    def noted_in(self, diagnosis: CableDiagnosis, probability: float) -> CableDiagnosis:
        """A diagnosis made with this reading, with a sentence and a caveat that say so."""
        return dataclasses.replace(
            diagnosis,
            sentence=f"{diagnosis.sentence} This assumes that {self.assumes}.",
            caveats=(self.caveat(probability), *diagnosis.caveats),
        )

    def probability(self, laws: Sequence[UnderLaw]) -> float:
        """Of this reading, among all laws that were tried; 0 where it was not tried."""
        return sum(law.probability for law in laws if law.assumes == self.assumes)


def with_readings(case: Case, readings: Sequence[Reading]) -> Case:
    """The case with these readings as further laws of its simulator, where possible."""
    laws = {one.assumes: one.case.simulator for one in readings if one.case is not None}
    return dataclasses.replace(case, simulator=dataclasses.replace(case.simulator, readings=laws))


@dataclasses.dataclass(frozen=True)
class Held(Reading):
    """Cables that begin as they were first seen: the table holds them there, away from where they would settle.

    Attributes:
        case: of the same log, its cables not settled.
        off: largest distance of a keypoint's first place from that of the settled nominal cable [m].
    """

    case: Case
    off: float

    assumes = "the cable starts in its first observed shape, held there by the table"

    def caveat(self, probability):
        """See `Reading`."""
        return (
            f"At the start, keypoints are up to {1e3 * self.off:.2g} mm from where the simulated cable would settle. A "
            "cable that starts in its first observed shape, held there by the table's friction, explains this log best "
            f"(probability {probability:.2f}), so it is simulated in this way."
        )


def held(case: Case, calibration: Calibration) -> Held | None:
    """The reading that the table holds the cable at the start, if it lies noticeably away from the settled shape.

    Args:
        case: of the log, its cables settled.
        calibration: of the judgement.
    """
    if case.simulator.playback.settling == 0:
        return None
    noise, off = float(np.sqrt(np.mean(case.noise.std**2))), []
    for shape, settled in zip(first_shapes(case.recording), case.nominal[:, 0], strict=True):
        apart = np.zeros(1) if shape is None else np.linalg.norm(shape - settled, axis=1)
        off.append(apart[np.isfinite(apart)])
    # per coordinate, as the smallest gap is; a first shape may be of one sample
    smallest = np.hypot(calibration.smallest_gap(noise), noise)
    if max(float(np.sqrt(np.mean(one**2) / 2)) for one in off) <= smallest:
        return None
    try:
        unsettled = Case.of(case.log, case.effects, settling=0.0)
    except DiagnosisError:
        return None
    return Held(unsettled, max(float(one.max()) for one in off))
