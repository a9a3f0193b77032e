"""What recordings tell of a cable: EI / rho and the parameters of all effects that were tried, with 90 % intervals.

An effect stays in the search when recordings that no fit has seen are simulated better with it. That is strict: drag, a
stiffness profile or a recording's own grip may be there and yet not help elsewhere, and what is left out pulls the
others' values the same way in all recordings, where no resampling of the recordings shows it. So what is good to
simulate with is not what the cable is. Here all effects that were tried are free, chosen or not, and an interval has
two parts: how a value changes when recordings are left out (jackknife), and how it changes when the priors move by
their standard deviation, which is how far the fit may be drawn towards them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.stats import norm, t

from cablejax.spatial.effects import Layout
from cablejax.spatial.identify import Identified, affordable
from cablejax.spatial.newton import improve, jackknife, prior_shifts
from cablejax.spatial.values import Values
from cablejax.spatial.windows import Windows

_ITERATIONS = 12
_TAIL = 0.95

Linear = Callable[[Float[np.ndarray, "*B P"]], Float[np.ndarray, "*B"]]
"""Something linear in the values of all effects."""


@dataclasses.dataclass(frozen=True)
class Interval:
    """A value and its 90 % interval."""

    value: float
    low: float
    high: float


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A fit in which everything that was tried is free.

    Attributes:
        layout: of the values.
        shared: values that all recordings share, shape [P].
        moves: what leaving out each recording does to them, see `newton.jackknife`, shape [R, P].
        shifts: what moving each value's prior does to them, see `newton.prior_shifts`, shape [P, P].
    """

    layout: Layout
    shared: Float[np.ndarray, "P"]
    moves: Float[np.ndarray, "R P"]
    shifts: Float[np.ndarray, "P P"]

    def half_width(self, linear: Linear) -> float:
        """Half the 90 % interval of something linear in the values."""
        left_out = t.ppf(_TAIL, len(self.moves) - 1) * np.linalg.norm(linear(self.moves))
        return float(np.hypot(left_out, norm.ppf(_TAIL) * np.linalg.norm(linear(self.shifts))))

    def of(self, linear: Linear) -> Interval:
        """Something linear in the values."""
        value, error = float(linear(self.shared)), self.half_width(linear)
        return Interval(value, value - error, value + error)

    def ratio(self, log: Linear) -> Interval:
        """Something whose logarithm is linear in the values."""
        return Interval(*np.exp(dataclasses.astuple(self.of(log))).tolist())

    def positive(self, field: str) -> Interval:
        """A value that is fitted in its logarithm, by the name of its block in `effects`."""
        where = self.layout.slices[field].start
        value = float(self.shared[where])
        factor = float(np.exp(self.half_width(lambda values: values[..., where]) / value))
        return Interval(value, value / factor, value * factor)

    @property
    def stiffness(self) -> Interval:
        """EI / rho, geometric mean along the cable [m^4/s^2]."""
        ratio, nominal = self.ratio(self.layout.log_stiffness), self.layout.nominal_stiffness
        return Interval(nominal * ratio.value, nominal * ratio.low, nominal * ratio.high)


def estimate(
    found: Identified,
    start: Values,
    windows: Windows,
    *,
    progress: Callable[[str], None] = lambda text: None,
) -> Estimate:
    """Fits everything that was tried.

    Args:
        found: what was tried.
        start: values to start from, fitted to the same windows with the effects that stayed.
        windows: to fit.
        progress: called with a line of text.
    """
    layout = found.simulator.layout
    # a positive value that is off starts at its prior's median: the logarithm of nothing leads nowhere
    off = layout.active(found.tried) & ~np.isnan(layout.starts) & (start.shared == 0)
    start = dataclasses.replace(start, shared=np.where(off, layout.starts, start.shared))
    chosen = windows.chosen(np.flatnonzero(affordable(found.simulator, windows)))
    progress(f"all effects free: {len(chosen)} windows")
    fit = improve(found.simulator, start, found.tried, chosen, iterations=_ITERATIONS, progress=progress)
    return Estimate(layout, fit.values.shared, jackknife(fit, layout), prior_shifts(fit, layout))


def estimates_of_halves(
    found: Identified, windows: Windows, *, progress: Callable[[str], None] = lambda text: None
) -> tuple[Estimate, Estimate]:
    """`estimate` from either half of the recordings, as the search split them.

    Args:
        found: from these windows.
        windows: of all recordings.
        progress: called with a line of text.
    """
    one, other = (
        estimate(found, values, windows.chosen(np.flatnonzero(half)), progress=progress)
        for values, half in zip(found.half_values, (found.first, ~found.first), strict=True)
    )
    return one, other
