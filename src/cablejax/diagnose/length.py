"""The cable's length, as its keypoints show it.

A stated length that is 1 % wrong looks like a cable that stretches. Where keypoints are closer together or further
apart than stated in every episode, a cable of the length that they suggest is one more law of the simulator, see
`laws`: it is as likely beforehand as any other, and where the log makes it the most probable one, it is taken.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from cablejax.diagnose.case import Case
from cablejax.diagnose.diagnosis import CableDiagnosis, ParameterEstimate, UnderLaw
from cablejax.diagnose.recording import DiagnosisError
from cablejax.types import GapLog

# Keypoints that are closer together or further apart than stated by more than this share are reported.
_OFF = 0.004


@dataclasses.dataclass(frozen=True)
class Length:
    """A length that differs from the stated one.

    Attributes:
        stated: in the log [m].
        measured: from the keypoints [m].
        case: the log of a cable of the measured length; None where it would be torn.
    """

    stated: float
    measured: float
    case: Case | None

    @property
    def ratio(self) -> float:
        """Measured over stated."""
        return self.measured / self.stated

    @property
    def apart(self) -> str:
        """In words: how far apart keypoints are."""
        word = "closer together" if self.ratio < 1 else "further apart"
        return f"{100 * abs(self.ratio - 1):.1f} % {word} than the stated arc lengths, in every episode"

    @property
    def assumes(self) -> str:
        """In words, for a law of the simulator."""
        return f"the cable is {self.measured:.4g} m long, not {self.stated:.4g} m as stated"

    def probability(self, laws: Sequence[UnderLaw]) -> float:
        """Of this length, among all laws that were tried; 0 where it was not tried."""
        return sum(law.probability for law in laws if law.assumes == self.assumes)

    def told(self, diagnosis: CableDiagnosis, probability: float) -> CableDiagnosis:
        """A diagnosis that was made with this length, which says so."""
        caveat = (
            f"Keypoints are {self.apart}. A cable of {self.measured:.4g} m explains this log better than any "
            f"effect of one of the stated {self.stated:.4g} m (probability {probability:.2f}), and that length is "
            "taken. Measure the cable between the grippers, and correct length_m and keypoint_arclength_m."
        )
        return dataclasses.replace(
            diagnosis,
            sentence=f"{diagnosis.sentence} That is so if {self.assumes}.",
            caveats=(caveat, *diagnosis.caveats),
            quantities={**diagnosis.quantities, "length_m": ParameterEstimate(self.measured, None, "m")},
        )

    def applied(self, log: GapLog) -> GapLog:
        """The log of a cable of the measured length, its keypoints at the same shares of it."""
        cable = log.meta["cable"] | {"length_m": self.measured}
        marks = [float(s * self.ratio) for s in log.meta["keypoint_arclength_m"]]
        return dataclasses.replace(log, meta=log.meta | {"cable": cable, "keypoint_arclength_m": marks})

    def as_law_of(self, case: Case) -> Case:
        """The case of the stated length, its simulator with this length as one more law where that is possible."""
        laws = {} if self.case is None else {self.assumes: self.case.simulator}
        return dataclasses.replace(case, simulator=dataclasses.replace(case.simulator, resized=laws))


def other_length(case: Case, log: GapLog) -> Length | None:
    """The length that the keypoints suggest, if it differs from the stated one in every episode in the same direction.

    Args:
        case: of the log.
        log: with the stated length.
    """
    ratio = _closeness(case)
    if np.abs(ratio - 1).min() <= _OFF or np.ptp(np.sign(ratio - 1)) > 0:
        return None
    stated = float(log.meta["cable"]["length_m"])
    length = Length(stated, stated * float(ratio.mean()), None)
    try:
        return dataclasses.replace(length, case=Case.of(length.applied(log), case.simulator.effects))
    except DiagnosisError:
        return length


def _closeness(case: Case) -> np.ndarray:
    """Distance of neighbouring keypoints over that of the nominal cable's, median of each episode; 1 if not seen."""
    seen, nominal = (
        np.linalg.norm(np.diff(points, axis=2), axis=-1) for points in (case.recording.keypoints, case.nominal)
    )
    ratio = seen / nominal
    return np.array([np.median(one[np.isfinite(one)]) if np.isfinite(one).any() else 1.0 for one in ratio])
