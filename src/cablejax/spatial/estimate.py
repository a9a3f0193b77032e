"""What recordings tell of a cable: EI / rho and the parameters of all effects that were tried, with 90 % intervals.

An effect stays in the search when recordings that no fit has seen are simulated better with it. That is strict: drag, a
stiffness profile or a recording's own grip may be there and yet not help elsewhere, and what is left out pulls the
others' values the same way in all recordings, where no resampling of the recordings shows it. So what is good to
simulate with is not what the cable is. Here all effects that were tried are free, chosen or not, and an interval has
two parts: how a value changes when recordings are left out (jackknife), and how it changes when the priors move by
their standard deviation, which is how far the fit may be drawn towards them. What a cable has beyond the law that is
fitted shows in neither; what is told of an effect (`named`) is wider by what that does to synthetic cables.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from types import MappingProxyType

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.stats import norm, t

from cablejax.spatial.effects import Layout
from cablejax.spatial.identify import Identified, affordable
from cablejax.spatial.newton import improve, jackknife, prior_shifts
from cablejax.spatial.values import Values
from cablejax.spatial.windows import Windows

# Predictions may be off by what a time step does; values are not to make up for it. The fit ends with time steps that
# are so much shorter.
_FINER = 4
_TAIL = 0.95

Quantity = Callable[[Float[Array, "P"]], Float[Array, ""]]
"""Something that follows from the values of all effects, differentiably."""
_PER_MASS = ("drag", "quadratic_drag", "marker_mass")
UNMODELLED: Mapping[str, float] = MappingProxyType(
    {
        "bending_stiffness": 0.05,
        "bending_damping": 0.13,
        "viscous_drag": 1.0,
        "quadratic_drag": 0.19,
        "stiffness_profile": 0.08,
        "gripper_rotation_offset": 0.06,
    }
)
"""By how much an effect's parameter is off besides, in all recordings alike, where neither jackknife nor priors show
it: standard deviation of its logarithm, of an angle in rad. It is what makes nine of ten intervals hold the true value
on synthetic cables of even seeds that have more than the law that is fitted (`experiments/32_interval_coverage.py
--calibrate`). Intervals of the markers' mass were wide enough."""


@dataclasses.dataclass(frozen=True)
class Interval:
    """A value and its 90 % interval."""

    value: float
    low: float
    high: float

    def wider(self, deviation: float) -> Interval:
        """With an independent error of so great a standard deviation besides."""
        more = norm.ppf(_TAIL) * deviation
        return Interval(
            self.value,
            self.value - float(np.hypot(self.value - self.low, more)),
            self.value + float(np.hypot(self.high - self.value, more)),
        )

    def wider_by_factor(self, deviation: float) -> Interval:
        """The same of a positive value and its logarithm."""
        log = Interval(*np.log(dataclasses.astuple(self))).wider(deviation)
        return Interval(self.value, *np.exp([log.low, log.high]).tolist())


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

    def of(self, quantity: Quantity) -> Interval:
        """A quantity, its interval by its slope at the fitted values."""
        with jax.enable_x64(True):
            value, slope = jax.value_and_grad(quantity)(jnp.asarray(self.shared, float))
        value, slope = float(value), np.asarray(slope)
        left_out = t.ppf(_TAIL, len(self.moves) - 1) * np.linalg.norm(self.moves @ slope)
        error = float(np.hypot(left_out, norm.ppf(_TAIL) * np.linalg.norm(self.shifts @ slope)))
        return Interval(value, value - error, value + error)

    def ratio(self, log: Quantity) -> Interval:
        """A positive quantity by its logarithm."""
        return Interval(*np.exp(dataclasses.astuple(self.of(log))).tolist())

    def positive(self, field: str) -> Interval:
        """A positive value, by the name of its block in `effects`; what is per mass is per that of the laden cable."""
        where = self.layout.slices[field].start

        def log(values):
            value = jnp.log(values[where])
            return value - jnp.log(self.layout.laden(values)) if field in _PER_MASS else value

        return self.ratio(log)

    @property
    def stiffness(self) -> Interval:
        """EI / rho, geometric mean along the cable, rho with the markers [m^4/s^2]."""
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
    fit = improve(found.simulator, start, found.tried, chosen, progress=progress)
    progress(f"the same with time steps of 1/{_FINER}")
    fit = improve(found.simulator.finer(_FINER), fit.values, found.tried, chosen, progress=progress)
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
