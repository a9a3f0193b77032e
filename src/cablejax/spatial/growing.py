"""Where fits to whole windows begin: at fits to their beginnings, which grow.

The longer a motion is simulated, the rougher is its error in the parameters: oscillations are a whole period off, a
cable swings over or does not, and a fit from afar ends in one of many minima. The first quarter of the windows has far
fewer of them. What fits it is close to what fits the first half, and that is close to what fits all.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from cablejax.diagnose.fit import evaluate, improve
from cablejax.diagnose.protocol import Explanation
from cablejax.spatial.cable import SpatialCable, typical_error

SHARES = (0.25, 0.5)
"""Of windows: their beginnings, the shortest first."""


def beginning(cable: SpatialCable, starts: Sequence[Explanation]) -> Explanation:
    """The best start, or what it becomes by fits to growing beginnings of the windows if that is better.

    Args:
        cable: in the windows to fit.
        starts: the best one simulates whole windows with the least `typical_error`.
    """
    whole = cable.evidence()
    errors = [typical_error(whole, start) for start in starts]
    best = starts[int(np.argmin(errors))]
    grown = _grown(cable, best)
    return grown if typical_error(whole, grown) < min(errors) else best


def early(cable: SpatialCable, share: float = SHARES[0]) -> SpatialCable:
    """The cable in the beginnings of its windows, of this share of the longest one's length."""
    valid = cable.windows.valid
    begun = np.arange(valid.shape[1]) < share * valid.shape[1]
    return cable.on(dataclasses.replace(cable.windows, valid=valid & begun))


def _grown(cable: SpatialCable, start: Explanation) -> Explanation:
    """What a start becomes by fits of its parameters to growing beginnings of the windows."""
    for share in SHARES:
        part = early(cable, share)
        evidence = part.evidence()
        (fit,) = improve(evidence, evaluate(evidence, [start]), part.plan.last_steps)
        start = fit.explanation
    return start
