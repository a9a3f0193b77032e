"""Effects of the arms: what shows between commands and measured gripper poses, before any cable is simulated.

The grippers' encoders are logged, so the cable is always driven by where the grippers were, and whatever the arms do
wrong is told from commands and poses alone. It neither hides an effect of the cable nor is taken for one.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np
import scipy.optimize
from jaxtyping import Float

# Poses are believed to this [m]; radians count for 0.15 m.
_ENCODER_NOISE = 5e-5
_ROTATION_WEIGHT = 0.15
# A deviation of less than this is none [m].
_NEGLIGIBLE = 2e-4
# An effect explains the arms' deviation if it leaves no more than this share of it, root mean square.
_EXPLAINED = 0.25


@dataclasses.dataclass(frozen=True)
class Actuation:
    """How the arms follow their commands.

    Attributes:
        effects: names and parameters (value, 90 % interval, unit) of what explains the deviation, at most both.
        deviation: root mean square of measured less commanded poses [m].
        leftover: the same after the effects.
        commanded: poses that exact arms would have had, shape [E, T, 2, 3].
        predicted: poses with the effects, shape [E, T, 2, 3].
        deviates: whether measured and commanded poses differ at all.
    """

    effects: dict[str, tuple[float, tuple[float, float], str]]
    deviation: float
    leftover: float
    commanded: Float[np.ndarray, "E T 2 3"]
    predicted: Float[np.ndarray, "E T 2 3"]
    deviates: bool

    @property
    def explained(self) -> bool:
        """Whether the effects leave nothing of note."""
        return not self.deviates or self.leftover <= max(_EXPLAINED * self.deviation, _NEGLIGIBLE)


def actuation(
    pose: Float[np.ndarray, "E T 2 3"],
    command: Float[np.ndarray, "E T 2 3"] | None,
    interval: Float[np.ndarray, "E"],
    length: Float[np.ndarray, "E"],
) -> Actuation:
    """Compares measured gripper poses with their commands and fits gain and lag.

    The lag is a pure delay followed by a first-order lag; what is reported is their sum.

    Args:
        pose: measured, theta continuous.
        command: twists held from one sample to the next; None = not logged, nothing can be told.
        interval: between samples [s].
        length: valid samples of each episode.
    """
    if command is None:
        return Actuation({}, 0.0, 0.0, pose, pose, deviates=False)
    valid = np.arange(pose.shape[1])[None] < np.asarray(length)[:, None]
    weight = np.array([1.0, 1.0, _ROTATION_WEIGHT]) * valid[:, :, None, None]
    wanted = _integrated(pose[:, 0], command, interval)

    def rms(predicted):
        return float(np.sqrt(np.sum((weight * (pose - predicted)) ** 2) / (valid.sum() * 6)))

    def model(theta, gain_free, lag_free):
        theta = list(theta)
        gain = theta.pop(0) if gain_free else 1.0
        delay, slow = theta if lag_free else (0.0, 0.0)
        moved = pose[:, :1] + gain * (wanted - pose[:, :1])
        return _lagged(moved, interval, max(delay, 0.0), max(slow, 0.0))

    deviation = rms(wanted)
    if deviation < _NEGLIGIBLE:
        return Actuation({}, deviation, deviation, wanted, wanted, deviates=False)

    best: tuple[float, Any, bool, bool] | None = None
    for gain_free, lag_free in ((True, False), (False, True), (True, True)):
        starts = [[0.1, 0.05], [0.02, 0.2], [0.4, 0.2]] if lag_free else [[]]
        for start in starts:
            first = ([1.0] if gain_free else []) + start
            low = ([0.1] if gain_free else []) + [0.0] * len(start)
            high = ([3.0] if gain_free else []) + [5.0] * len(start)
            result = scipy.optimize.least_squares(
                lambda t, g=gain_free, f=lag_free: (weight * (pose - model(t, g, f))).ravel() / _ENCODER_NOISE,
                first,
                bounds=(low, high),
                diff_step=1e-4,
            )
            left = rms(model(result.x, gain_free, lag_free))
            # a second effect must take away much of what the first one leaves
            threshold = 0.5 if gain_free and lag_free else 0.999
            if best is None or left < threshold * best[0]:
                best = left, result, gain_free, lag_free
    assert best is not None  # there are always starts
    left, result, gain_free, lag_free = best
    scale = max(left / _ENCODER_NOISE, 1.0)
    # residuals of one motion are far from independent: a hundred samples count as one
    covariance = 100.0 * scale**2 * np.linalg.pinv(result.jac.T @ result.jac)
    effects = {}
    if left < 0.7 * deviation:
        if gain_free:
            half = 1.645 * float(np.sqrt(covariance[0, 0]))
            effects["actuation_gain"] = (float(result.x[0]), (result.x[0] - half, result.x[0] + half), "")
        if lag_free:
            total = float(result.x[-2:].sum())
            half = 1.645 * float(np.sqrt(covariance[-2:, -2:].sum())) + 0.01 * total
            effects["actuation_lag"] = (total, (max(total - half, 0.0), total + half), "s")
    predicted = model(result.x, gain_free, lag_free) if effects else wanted
    return Actuation(effects, deviation, left if effects else deviation, wanted, predicted, deviates=True)


def _integrated(first, command, interval):
    steps = command * np.asarray(interval)[:, None, None, None]
    return first[:, None] + np.concatenate([np.zeros_like(steps[:, :1]), np.cumsum(steps, axis=1)[:, :-1]], axis=1)


def _lagged(poses, interval, delay, slow):
    """A pure delay [s], then a first-order lag of time constant `slow` [s], exact for piecewise linear input."""
    result = np.empty_like(poses)
    for e, (pose, dt) in enumerate(zip(poses, np.asarray(interval), strict=True)):
        n = len(pose)
        back = np.clip(np.arange(n) - delay / dt, 0.0, n - 1.0)
        before = np.minimum(back.astype(int), n - 2)
        t = (back - before)[:, None, None]
        late = (1 - t) * pose[before] + t * pose[before + 1]
        if slow > 1e-6:
            decay = np.exp(-dt / slow)
            state, out = late[0].copy(), [late[0]]
            for a, b in itertools.pairwise(late):
                slope = (b - a) / dt
                # exact response of slow * y' + y = u on a ramp u = a + slope t
                state = (state - a + slope * slow) * decay + b - slope * slow
                out.append(state)
            late = np.stack(out)
        result[e] = late
    return result
