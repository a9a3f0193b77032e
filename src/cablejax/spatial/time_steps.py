"""Chooses the number of time steps between two samples for the recorded motion.

A cable is simulated with steps of a sample's length where that is fine enough: on recordings at 100 Hz of clamps that
move like a hand it is. Clamps that swing by decimetres twice a second, or samples that are far apart, need more. How
many follows from the recorded motion alone, before anything is fitted: steps are halved until a cable with the believed
stiffness and ordinary damping moves as it does with half of them.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from cablejax.diagnose.protocol import explanation
from cablejax.spatial.cable import GOOD_FIT, SpatialCable, bounded

_FINEST = 4
# Errors of the time steps may be so large a part of what a good fit leaves, on half of the windows. The others may hold
# a cable that snaps through, as the believed one often does where the true one is stiffer: there any error grows.
_SHARE = 0.5
# A damping time [s] and a drag [1/s] as cables have them.
_ORDINARY = {"bending_damping": 0.03, "viscous_drag": 0.3}


@dataclasses.dataclass(frozen=True)
class TimeSteps:
    """Steps between two samples.

    Attributes:
        substeps: their number.
        error: by which half the steps would change the motion, as a mean over coordinates and samples, median over
            windows [m].
    """

    substeps: int
    error: float

    @property
    def fine_enough(self) -> bool:
        """Whether finer steps would change less than a part of what a good fit leaves."""
        return self.error <= _SHARE * GOOD_FIT


def time_steps_for(cable: SpatialCable) -> TimeSteps:
    """The fewest steps that are fine enough, or `_FINEST`.

    Args:
        cable: with one step between two samples, in windows whose motion is to be simulated.
    """
    ordinary = [(cable.layout.named(name), 0, (value,)) for name, value in _ORDINARY.items()]

    def predicted(substeps):
        return cable.finer(substeps).motion(explanation(*ordinary))

    substeps, coarse = 1, predicted(1)
    while True:
        fine = predicted(2 * substeps)
        off = bounded(coarse - fine)
        each = [part[valid].mean() for part, valid in zip(off, cable.windows.valid, strict=True)]
        found = TimeSteps(substeps, float(np.median(each)))
        if found.fine_enough or substeps >= _FINEST:
            return found
        substeps, coarse = 2 * substeps, fine
