"""Estimates of a cable: EI / rho and the parameters of all effects that were tried, with 90 % intervals.

The search keeps an effect only if it improves predictions on held-out recordings. This is strict: drag, a stiffness
profile or a recording's own grip may be present and yet not help elsewhere. Leaving out such an effect biases the
others by the same amount in all recordings, which resampling of the recordings cannot show. Here all effects that were
tried are therefore free, whether the search kept them or not. An interval has three parts: how a value changes when
recordings are left out (jackknife), when the priors move by their standard deviation, and when the rod's edges become
shorter. None covers deviations of the cable from the fitted law; reported intervals (`named`) are widened by the effect
of such deviations on synthetic cables.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Mapping, Sequence
from types import MappingProxyType

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.stats import norm, t

from cablejax.bounded import Result
from cablejax.diagnose.evidence import Evidence
from cablejax.diagnose.fit import Fit, evaluate, improve
from cablejax.diagnose.protocol import Explanation
from cablejax.spatial.cable import TWISTED, SpatialCable
from cablejax.spatial.effects import Layout
from cablejax.spatial.growing import beginning
from cablejax.spatial.uncertainty import resolution, sources

# Predictions may be off by what edges and time steps of finite length do; values are not to make up for it. Fits are
# made in rounds of at most `_STEPS` steps, predictions corrected before each, until no value moves by this share of its
# standard error, but not more often than this. A cable that snaps over in one of the windows keeps them moving closer
# than that: the last round is one after which they move by more than this share of what the one before moved them by.
_SETTLED, _ROUNDS, _STEPS, _STALLED = 0.3, 5, 4, 0.9
# Nats per window: a step that promises less is not made.
_TOLERANCE = 0.01
REPORTED = 0.95
"""Quantile at which reported intervals end."""
# Windows that are fitted where the material frame is followed.
_TWISTED_WINDOWS = 24

Quantity = Callable[[Float[Array, "P"]], Float[Array, ""]]
"""Something that follows from the values of all effects, differentiably."""
UNMODELLED: Mapping[str, float] = MappingProxyType(
    {
        "bending_stiffness": 0.035,
        "bending_damping": 0.075,
        "stiffness_profile": 0.085,
        "gripper_rotation_offset": 0.03,
    }
)
"""By how much an effect's parameter is off besides, in all recordings alike, where neither jackknife nor priors show
it: standard deviation of its logarithm; of an angle in rad. It is what makes 90 % and 95 % intervals hold the true
value as often as that on the next synthetic cable, by those to choose on, of two simulators that have more than the law
that is fitted (`experiments/34_fresh_cables.py --calibrate`). These are 0.85 to 1 m long. Intervals of the drag at the
recording's speed and of the markers' mass were wide enough."""


@dataclasses.dataclass(frozen=True)
class Interval:
    """A value and its 90 % interval.

    Attributes:
        value, low, high: estimate, 5 % and 95 % quantile, in its own unit.
    """

    value: float
    low: float
    high: float

    def wider(self, deviation: float) -> Interval:
        """The interval widened by an independent error with this standard deviation."""
        more = norm.ppf(REPORTED) * deviation
        return Interval(
            self.value,
            self.value - float(np.hypot(self.value - self.low, more)),
            self.value + float(np.hypot(self.high - self.value, more)),
        )

    def among(self, count: int, freedom: int) -> Interval:
        """One of `count` intervals that hold all their true values in nine of ten cases (Bonferroni).

        Args:
            count: of the intervals.
            freedom: of Student's distribution, by which this one is as wide as it is.
        """
        times = float(t.ppf(1 - (1 - REPORTED) / count, freedom) / t.ppf(REPORTED, freedom))
        low, high = self.value - times * (self.value - self.low), self.value + times * (self.high - self.value)
        return Interval(self.value, low, high)

    def wider_by_factor(self, deviation: float) -> Interval:
        """The interval of a positive value, widened by an error of its logarithm."""
        log = Interval(*np.log(dataclasses.astuple(self))).wider(deviation)
        return Interval(self.value, *np.exp([log.low, log.high]).tolist())


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A fit in which everything that was tried is free.

    Attributes:
        layout: of the values.
        explanation: that was fitted.
        moves: what leaving out each recording does to the shared values, see `uncertainty.jackknife`, shape [R, P].
        shifts: what moving each prior by its standard deviation does to them, and last what the error of the corrected
            predictions does, see `uncertainty.resolution`, shape [K + 1, P].
        speed: of the keypoints, root mean square [m/s].
        settled: whether no value moved by more than a small part of its standard error when predictions were last
            corrected for finite edges and time steps.
    """

    layout: Layout
    explanation: Explanation
    moves: Float[np.ndarray, "R P"]
    shifts: Float[np.ndarray, "K P"]
    speed: float
    settled: bool = True

    @property
    def freedom(self) -> int:
        """Of the jackknife: one less than there are recordings."""
        return len(self.moves) - 1

    @property
    def shared(self) -> Float[np.ndarray, "P"]:
        """Values that all recordings share."""
        return self.explanation.vector(self.layout.effects)

    def with_only(self, effects: Collection[str]) -> Explanation:
        """What was fitted, without the effects that are not among these."""
        return self.explanation.without(*(set(self.explanation.names) - set(effects)))

    def of(self, quantity: Quantity) -> Interval:
        """A quantity, its interval by its slope at the fitted values."""
        with jax.enable_x64(True):
            value, slope = jax.value_and_grad(quantity)(jnp.asarray(self.shared, float))
        value, slope = float(value), np.asarray(slope)
        left_out = t.ppf(REPORTED, self.freedom) * np.linalg.norm(self.moves @ slope)
        error = float(np.hypot(left_out, norm.ppf(REPORTED) * np.linalg.norm(self.shifts @ slope)))
        return Interval(value, value - error, value + error)

    def drawn(self, effect: str) -> float:
        """How far a standard deviation of the prior of an effect with one positive value moves its logarithm."""
        names = [name for name in self.explanation.names for _ in self.layout.named(name).parameters]
        where = self.layout.slots(effect).start
        return float(self.shifts[names.index(effect), where] / self.shared[where])

    def ratio(self, log: Quantity) -> Interval:
        """A positive quantity by its logarithm."""
        return Interval(*np.exp(dataclasses.astuple(self.of(log))).tolist())

    def positive(self, field: str) -> Interval:
        """A positive value, by the name of its field in `effects`."""
        where = self.layout.slices[field].start
        return self.ratio(lambda values: jnp.log(values[where]))

    @property
    def drag(self) -> Interval:
        """Linear and quadratic drag together at the speed, per mass [1/s]; the interval may begin below 0."""
        linear, quadratic = (self.layout.slices[name].start for name in ("drag", "quadratic_drag"))
        return self.of(lambda values: values[linear] + self.speed * values[quadratic])

    @property
    def marker_mass(self) -> Interval:
        """Mass of a marker, as length of the cable with its markers of the same mass [m]; may begin below 0."""
        where, laden = self.layout.slices["marker_mass"].start, self.layout.laden
        return self.of(lambda values: values[where] / laden(values))

    @property
    def stiffness(self) -> Interval:
        """EI / rho, geometric mean over the knots of the profile, ends included [m^4/s^2]."""
        ratio, nominal = self.ratio(self.layout.log_stiffness), self.layout.nominal_stiffness
        return Interval(nominal * ratio.value, nominal * ratio.low, nominal * ratio.high)


def estimate(
    cable: SpatialCable,
    starts: Sequence[Explanation],
    tried: Sequence[str],
    *,
    progress: Callable[[str], None] = lambda text: None,
) -> Estimate:
    """Fits all tried effects in rounds, with predictions corrected at the result of the round before.

    Args:
        cable: in the windows to fit.
        starts: explanations with some of the effects; the fit begins at the best of them, see `beginning`.
        tried: names of the effects that are free.
        progress: called with a line of text.
    """
    free = [effect for effect in cable.layout.effects if effect.name in tried]
    # what a start lacks is where its prior has it
    starts = [
        start.plus(*((e, 0, [p.centre for p in e.parameters]) for e in free if e.name not in start.names))
        for start in starts
    ]
    if TWISTED in tried:
        # four times the cost
        cable = cable.some(_TWISTED_WINDOWS)
    progress(f"all effects free: {len(cable.windows)} windows")
    tolerance, rounds, steps = _TOLERANCE * len(cable.windows), 0, _STEPS
    start, before = beginning(cable, starts), np.inf
    while True:
        rounds += 1
        evidence = cable.corrected(start).evidence()
        (fit,) = improve(evidence, evaluate(evidence, [start]), max_iterations=steps, tolerance=tolerance)
        error = np.hypot(*(np.linalg.norm(rows, axis=0) for rows in sources(evidence, fit)))
        moved = float((np.abs(fit.explanation.z - start.z) / error).max(initial=0.0))
        progress(f"corrected for finite edges and time steps: values move by up to {moved:.2f} standard errors")
        # a round of steps that were all too long says nothing, and the next one needs more of them
        stuck = moved == 0 and fit.result is Result.STEP_LIMIT
        steps = 2 * steps if stuck else _STEPS
        settled = moved < _SETTLED and not stuck
        stalled = _STALLED * before < moved < 1 and not stuck
        if settled or stalled or rounds == _ROUNDS:
            return dataclasses.replace(estimate_at(evidence, fit), settled=settled)
        start, before = fit.explanation, before if stuck else moved


def restarts(one: Explanation) -> list[Explanation]:
    """Starts of a fit to half of the recordings: an explanation, and the same with recordings' own values at 0.

    The search may have left those values in a bad minimum, in which a fit from 0 need not end.
    """
    return [one, one.moved(one.z, np.zeros_like(one.own))] if one.own.any() else [one]


def starts_from(one: Explanation, other: Explanation) -> list[Explanation]:
    """Starts of a fit to all recordings: the mean of the fits to both halves, and either of them.

    The mean of two fits that went to different places may be worse than both. Each recording keeps what the fit to its
    own half found for it.
    """
    rows = max(len(one.own), len(other.own))
    both = [np.pad(part.own, ((0, rows - len(part.own)), (0, 0))) for part in (one, other)]
    found = (both[0] != 0).astype(int) + (both[1] != 0)
    own = (both[0] + both[1]) / np.maximum(found, 1)
    return [one.moved(z, own) for z in ((one.z + other.z) / 2, one.z, other.z)]


def estimate_at(evidence: Evidence, fit: Fit) -> Estimate:
    """The estimate from a fit to a cable's windows."""
    cable, one = evidence.simulator, fit.explanation
    assert isinstance(cable, SpatialCable)
    # of the vector by the coordinates
    slopes = cable.directions(one)[0]
    moves, shifts = sources(evidence, fit)
    shifts = np.vstack([shifts, resolution(evidence, fit)])
    return Estimate(cable.layout, one, moves @ slopes, shifts @ slopes, cable.windows.speed)
