"""Estimates the cable's length from its keypoints.

A stated length that is 1 % wrong looks like a cable that stretches. Where keypoints are closer together or further
apart than stated in every episode, a cable of the length that they suggest is one more reading of the log.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from cablejax.diagnose.case import Case
from cablejax.diagnose.diagnosis import ParameterEstimate
from cablejax.diagnose.reading import Reading
from cablejax.diagnose.recording import DiagnosisError

# Keypoints that are closer together or further apart than stated by more than this share are reported.
_OFF = 0.004
# Of the arc between two keypoints: their distance where the cable is hardly bent.
_STRETCHED = 0.9


@dataclasses.dataclass(frozen=True)
class Length(Reading):
    """A length that differs from the stated one.

    Attributes:
        case: of a cable of the measured length, its keypoints at the same shares of it; None where it would be torn.
        stated: in the given log [m].
        measured: from the keypoints [m].
    """

    case: Case | None
    stated: float
    measured: float

    @property
    def ratio(self) -> float:
        """Measured over stated."""
        return self.measured / self.stated

    @property
    def apart(self) -> str:
        """Words for how far apart keypoints are, compared with the stated length."""
        word = "closer together" if self.ratio < 1 else "further apart"
        return f"{100 * abs(self.ratio - 1):.1f} % {word} than the stated arc lengths, in every episode that shows it"

    @property
    def assumes(self) -> str:
        """See `Reading`."""
        return f"the cable is {self.measured:.4g} m long, not {self.stated:.4g} m as stated"

    def caveat(self, probability):
        """See `Reading`."""
        return (
            f"Keypoints are {self.apart}. A cable length of {self.measured:.4g} m explains this log better than any "
            f"effect on a cable of the stated {self.stated:.4g} m (probability {probability:.2f}), so the diagnosis "
            "assumes that length. Measure the cable between the grippers, and correct length_m and "
            "keypoint_arclength_m."
        )

    def noted_in(self, diagnosis, probability):
        """With the measured length among the quantities."""
        quantities = diagnosis.quantities | {"length_m": ParameterEstimate(self.measured, None, "m")}
        return super().noted_in(dataclasses.replace(diagnosis, quantities=quantities), probability)


def other_length(case: Case) -> Length | None:
    """The length that the keypoints suggest, if all their deviations from the stated one have the same sign."""
    log = case.log
    ratio = _closeness(case)
    if not len(ratio) or np.abs(ratio - 1).min() <= _OFF or np.ptp(np.sign(ratio - 1)) > 0:
        return None
    stated = float(log.meta["cable"]["length_m"])
    measured = stated * float(ratio.mean())
    cable = log.meta["cable"] | {"length_m": measured}
    marks = [float(s * measured / stated) for s in log.meta["keypoint_arclength_m"]]
    other = dataclasses.replace(log, meta=log.meta | {"cable": cable, "keypoint_arclength_m": marks})
    try:
        settling = case.simulator.playback.settling
        return Length(Case.of(other, case.effects, settling=settling), stated, measured)
    except DiagnosisError:
        return Length(None, stated, measured)


def _closeness(case: Case) -> np.ndarray:
    """Distance of neighbouring keypoints over that of the nominal cable's, median of each episode that shows it.

    Where the nominal cable is bent so much between two keypoints that these are far closer than along it, they say
    nothing of the length.
    """
    seen, nominal = (
        np.linalg.norm(np.diff(points, axis=2), axis=-1) for points in (case.recording.keypoints, case.nominal)
    )
    # noise across the cable lengthens every distance
    noise = case.noise.std**2
    seen = np.sqrt(np.maximum(seen**2 - (noise[1:] + noise[:-1]), 0.0))
    marks = case.simulator.playback.arclength
    stretched = nominal > _STRETCHED * np.diff(marks)
    ratio = np.where(stretched, seen / np.where(stretched, nominal, 1.0), np.nan)
    return np.array([np.median(one[np.isfinite(one)]) for one in ratio if np.isfinite(one).any()])
