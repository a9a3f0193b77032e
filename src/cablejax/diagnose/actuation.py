"""Effects of the arms, estimated from commands and measured gripper poses before any cable is simulated.

The grippers' encoders are logged, so the cable is always driven by where the grippers were, and errors of the
arms are estimated from commands and poses alone. They neither hide an effect of the cable nor are taken for one.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
import scipy.optimize
from jaxtyping import Bool, Float, Int

from cablejax.diagnose.diagnosis import ParameterEstimate
from cablejax.diagnose.log_faults import integrated, scatter_of, steadied
from cablejax.diagnose.posterior import QUANTILE
from cablejax.diagnose.refits import FOLDS, dealt
from cablejax.effects.arms import lagged
from cablejax.types import ROTATION_WEIGHT

# Poses are believed to this [m].
_ENCODER_NOISE = 5e-5
NEGLIGIBLE = 2e-4
"""A deviation of less than this is none [m]."""
# Nor is one of less than this share of the poses' noise, which is not known better.
_UNSURE = 0.25
# An effect explains the arms' deviation if it leaves no more than this share of it, root mean square.
_EXPLAINED = 0.25
# An effect that leaves more of it than this is not named: a backlash looks like a lag, and leaves more.
_TELLING = 0.5
# Of finite differences by gain and lags [1 and s].
_STEP = 1e-4
ARMS = ("actuation_gain", "actuation_lag")
"""Names of the effects of the arms."""
_GAIN, _LAG = ARMS


@dataclasses.dataclass(frozen=True)
class Actuation:
    """Fits of the arms to their commands.

    Attributes:
        count: coordinates of each episode, shape [E].
        motion: episodes with the same number repeat one another, shape [E].
        commanded: poses that exact arms would have had, shape [E, T, 2, 3].
        predicted: poses with the effects, each motion from a fit without it where there are several, shape
            [E, T, 2, 3].
        deviation: root mean square of measured less commanded poses [m], above their noise.
        leftover: the same after the effects.
        noise: of the measured poses [m].
        deviates: whether measured and commanded poses differ at all.
        effects: what explains the deviation, at most both, with the parameters of each.
        alone: what every effect that was tried leaves by itself, of poses that it was fitted to and of others [m].
        unseen: root mean square error of each episode [m] by set of effects: of poses as commanded for no effect, else
            from fits to the other motions, shape [E] each.
    """

    count: Int[np.ndarray, "E"]
    motion: Int[np.ndarray, "E"]
    commanded: Float[np.ndarray, "E T 2 3"]
    predicted: Float[np.ndarray, "E T 2 3"]
    deviation: float = 0.0
    leftover: float = 0.0
    noise: float = 0.0
    deviates: bool = False
    effects: dict[str, dict[str, ParameterEstimate]] = dataclasses.field(default_factory=dict)
    alone: dict[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    unseen: dict[tuple[str, ...], Float[np.ndarray, "E"]] = dataclasses.field(default_factory=dict)

    def strays(self, negligible: float) -> bool:
        """Whether the arms are off their commands by more than `negligible` [m] and no effect explains a part of it."""
        return self.deviates and not self.effects and self.deviation > negligible

    def explained(self, negligible: float) -> bool:
        """Whether the effects leave at most a small share of the deviation, or at most `negligible` [m]."""
        return not self.deviates or self.leftover <= max(_EXPLAINED * self.deviation, negligible)


@dataclasses.dataclass(frozen=True)
class _Arms:
    """Measured and commanded motion, and fits of one to the other.

    Attributes:
        pose: measured, shape [E, T, 2, 3].
        commanded: poses of exact arms, shape [E, T, 2, 3].
        interval: between samples [s], shape [E].
        valid: samples that are no padding, shape [E, T].
    """

    pose: Float[np.ndarray, "E T 2 3"]
    commanded: Float[np.ndarray, "E T 2 3"]
    interval: Float[np.ndarray, "E"]
    valid: Bool[np.ndarray, "E T"]

    def chosen(self, episodes) -> _Arms:
        return _Arms(self.pose[episodes], self.commanded[episodes], self.interval[episodes], self.valid[episodes])

    def predicted(self, effects: tuple[str, ...], theta) -> Float[np.ndarray, "E T 2 3"]:
        """Poses with the effects: of a gain its value, of a lag the pure delay and the time constant [s]."""
        theta, start = list(theta), self.commanded[:, :1]
        gain = theta.pop(0) if "actuation_gain" in effects else 1.0
        delay, slow = theta if "actuation_lag" in effects else (0.0, 0.0)
        moved = start + gain * (self.commanded - start)
        return np.stack(
            [lagged(p, dt, max(delay, 0.0), max(slow, 0.0)) for p, dt in zip(moved, self.interval, strict=True)]
        )

    def off(self, poses: Float[np.ndarray, "E T 2 3"]) -> Float[np.ndarray, "E T 2 3"]:
        """Errors of the measured poses [m]; 0 in the padding."""
        return np.array([1.0, 1.0, ROTATION_WEIGHT]) * self.valid[:, :, None, None] * (self.pose - poses)

    def each(self, poses: Float[np.ndarray, "E T 2 3"]) -> Float[np.ndarray, "E"]:
        """Root mean square of that in each episode [m]."""
        return np.sqrt(np.sum(self.off(poses) ** 2, axis=(1, 2, 3)) / (6 * np.maximum(self.valid.sum(axis=1), 1)))

    def rms(self, poses: Float[np.ndarray, "E T 2 3"]) -> float:
        """Root mean square of that over coordinates [m], above the noise."""
        return float(np.sqrt(max(np.sum(self.off(poses) ** 2) / (self.valid.sum() * 6) - self.noise**2, 0.0)))

    @functools.cached_property
    def noise(self) -> float:
        """Of the measured poses [m], root mean square over coordinates."""
        return float(np.sqrt(np.mean(scatter_of(self.off(self.commanded), self.valid) ** 2)))

    def fit(self, effects: tuple[str, ...], starts) -> Any:
        """The best of scipy's least squares results."""
        bounds = tuple(zip(*_bounds(effects), strict=True))

        def off(theta):
            return self.off(self.predicted(effects, theta)).ravel() / _ENCODER_NOISE

        def slopes(theta):
            # scipy's own steps are relative: next to a delay of 0 they vanish, and its interval with them
            return np.stack([(off(theta + row) - off(theta)) / _STEP for row in _STEP * np.eye(len(theta))], axis=-1)

        # scipy takes a function, of which its types do not know
        results = [
            scipy.optimize.least_squares(off, start, jac=slopes, bounds=bounds)  # pyright: ignore[reportArgumentType]
            for start in starts
        ]
        return min(results, key=lambda result: result.cost)

    def extreme(self, effects: tuple[str, ...], theta) -> bool:
        """Whether a value is at a bound of the fit other than 0, as no arm has it: something else is the cause."""
        return any(
            value > 0.98 * high or value < 1.02 * low
            for value, (low, high) in zip(theta, _bounds(effects), strict=True)
        )

    def unseen(self, effects: tuple[str, ...], theta, motion: Int[np.ndarray, "E"]) -> Float[np.ndarray, "E T 2 3"]:
        """Poses of each motion from a fit without it, begun at the fit of all; from that where there is one motion.

        Of many motions, several are left out together.
        """
        result, part_of = self.predicted(effects, theta), dealt(motion, FOLDS)
        for part in range(part_of.max() + 1) if part_of.any() else ():
            group, rest = np.flatnonzero(part_of == part), self.chosen(np.flatnonzero(part_of != part))
            inside = np.clip(theta, [1e-3] * len(theta), [2.9] * len(theta))
            result[group] = self.chosen(group).predicted(effects, rest.fit(effects, [inside]).x)
        return result


def _bounds(effects: tuple[str, ...]) -> list[tuple[float, float]]:
    return [(0.1, 3.0)] * (_GAIN in effects) + [(0.0, 5.0)] * (2 * (_LAG in effects))


def actuation(
    pose: Float[np.ndarray, "E T 2 3"],
    command: Float[np.ndarray, "E T 2 3"] | None,
    interval: Float[np.ndarray, "E"],
    length: Int[np.ndarray, "E"],
    motion: Int[np.ndarray, "E"],
    known: Bool[np.ndarray, "E"],
) -> Actuation:
    """Compares measured gripper poses with their commands and fits gain and lag.

    The lag is a pure delay followed by a first-order lag; what is reported is their sum.

    Args:
        pose: measured, theta continuous.
        command: twists held from one sample to the next; None = not logged, nothing is compared.
        interval: between samples [s].
        length: valid samples of each episode.
        motion: episodes with the same number repeat one another.
        known: whether an episode's commands are; the others say nothing of the arms, and move as was measured.
    """
    if command is None or not known.any():
        return Actuation(np.zeros(len(pose), int), motion, pose, pose)
    valid = (np.arange(pose.shape[1])[None] < np.asarray(length)[:, None]) & known[:, None]
    whole = known[:, None, None, None]
    expected = np.where(whole, integrated(pose[:, 0], command, interval), pose)

    def begun_at(start: Float[np.ndarray, "E 2 3"]) -> tuple[_Arms, Actuation]:
        """The arms from better first poses: a reading's noise would be in all that is integrated from it."""
        commanded = np.where(whole, expected + (start - pose[:, 0])[:, None], pose)
        arms = _Arms(pose, commanded, np.asarray(interval), valid)
        off, noise = arms.rms(commanded), max(arms.noise, _ENCODER_NOISE)
        return arms, Actuation(6 * valid.sum(axis=1), motion, commanded, commanded, off, off, noise)

    counted = np.maximum(valid.sum(axis=1), 1)[:, None, None]
    off = np.where(valid[:, :, None, None], pose - expected, 0.0).sum(axis=1) / counted
    _, exact = begun_at(pose[:, 0] + off)
    if exact.deviation < max(NEGLIGIBLE, _UNSURE * exact.noise):
        return exact
    arms, nothing = begun_at(steadied(pose, expected, np.where(known, length, 0))[0][:, 0])
    deviation = nothing.deviation

    lags = [[0.1, 0.05], [0.02, 0.2], [0.4, 0.2]]
    found: dict[tuple[str, ...], Any] = {
        (_GAIN,): arms.fit((_GAIN,), [[1.0]]),
        (_LAG,): arms.fit((_LAG,), lags),
        (_GAIN, _LAG): arms.fit((_GAIN, _LAG), [[1.0, *lag] for lag in lags]),
    }
    left = {effects: arms.rms(arms.predicted(effects, result.x)) for effects, result in found.items()}
    unseen = {effects: arms.unseen(effects, result.x, motion) for effects, result in found.items()}
    best = min((_GAIN,), (_LAG,), key=lambda effects: left[effects])
    # a second effect must take away much of what the first one leaves
    best = (_GAIN, _LAG) if left[_GAIN, _LAG] < 0.5 * left[best] else best
    tried = dataclasses.replace(
        nothing,
        alone={effects[0]: (left[effects], arms.rms(unseen[effects])) for effects in ((_GAIN,), (_LAG,))},
        unseen={(): arms.each(arms.commanded)} | {effects: arms.each(poses) for effects, poses in unseen.items()},
        deviates=True,
    )
    if max(left[best], arms.rms(unseen[best])) >= _TELLING * deviation or arms.extreme(best, found[best].x):
        return tried
    named = _named(best, found[best], max(float(np.hypot(left[best], arms.noise)) / _ENCODER_NOISE, 1.0))
    return dataclasses.replace(tried, effects=named, leftover=left[best], predicted=np.where(whole, unseen[best], pose))


def _named(effects: tuple[str, ...], result: Any, scale: float) -> dict[str, dict[str, ParameterEstimate]]:
    """The parameters of every effect of a fit, with 90 % intervals."""
    # residuals of one motion are far from independent: a hundred samples count as one
    covariance = 100.0 * scale**2 * np.linalg.pinv(result.jac.T @ result.jac)

    def estimate(weights: np.ndarray, unit: str, share: float = 0.0) -> ParameterEstimate:
        """Of a sum of the fit's values, which is good to a share of it at best."""
        value = float(weights @ result.x)
        half = QUANTILE * float(np.sqrt(weights @ covariance @ weights)) + share * value
        return ParameterEstimate(value, (max(value - half, 0.0), value + half), unit)

    each, named = np.eye(len(result.x)), {}
    if _GAIN in effects:
        named[_GAIN] = {"gain": estimate(each[0], "")}
    if _LAG in effects:
        named[_LAG] = {"time_s": estimate(each[-2] + each[-1], "s", 0.01), "delay_s": estimate(each[-2], "s")}
    return named
