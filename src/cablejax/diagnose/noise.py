"""The noise floor of a recording: the scatter of keypoints at rest."""

from __future__ import annotations

import collections
import dataclasses
import math

import numpy as np
from jaxtyping import Bool, Float

from cablejax.arrays import stretches

# Shortest hold that shows how noise is correlated in time, in samples.
_SHORTEST_HOLD = 10
# Shortest hold that shows its level: of three samples a line leaves one.
_THREE = 3
# Levels that differ by less are the same.
_SAME = 0.1
_LAGS = 5
# A gripper that is so far from where it is for most of a hold moves the cable [lengths of it]: further than one goes
# that lags.
_MOVED = 0.02
# Of longer holds [samples] a line takes next to nothing.
_LONG = 300
# A hold of so many times the usual variance is none.
_RESTLESS = 4.0
# First-order noise has the measured correlations to this; a cable that creeps in its holds does not.
_LIKE_FIRST_ORDER = 0.05
# Changes below this share of the largest number are those of single precision.
_REPEATED = 1e-7
# Where more of the samples than this share differ from the one before, they were rounded to less than the noise.
_WHOLE = 0.98
# A keypoint counts as noisier than the others beyond this many standard errors.
_DISTINCT = 4.0

SMALLEST = 5e-5
"""Least noise that is believed [m]: a simulated log may have none, and no camera has less."""


@dataclasses.dataclass(frozen=True)
class NoiseFloor:
    """Noise floor of a recording.

    Attributes:
        std: standard deviation of each keypoint's coordinates [m], shape [N].
        correlation: autocorrelation at lags 1, 2, ... samples, shape [K].
        from_holds: whether the recording had holds to learn it from; otherwise the noise is taken to be white.
        rapid: standard deviation by third differences alone [m]; 0 where too few were observed.
        restless: holds that were left out, since the cable moves in them.
    """

    std: Float[np.ndarray, "N"]
    correlation: Float[np.ndarray, "K"]
    from_holds: bool
    rapid: float = 0.0
    restless: int = 0


def noise_floor(
    keypoints: Float[np.ndarray, "E T N D"], hold: np.ndarray | None, *, smallest: float = SMALLEST, order: int = 3
) -> NoiseFloor:
    """Noise from holds, each detrended by a line since a cable may creep; without holds, from third differences.

    The line takes slow noise with it. Where the correlations are those of a first-order process, like a tracker's that
    smooths, its level is what that process needs to leave such scatter about a line (`_first_order`).

    If the noise in the holds is white, third differences of the whole recording sharpen its level: there are many more
    of them, and no cable moves by jerks that fast. It does between samples a second apart, where holds are short: then
    the level is that of holds of three samples or more. Keypoints share one level unless one is clearly noisier.

    Args:
        keypoints: N points of D coordinates that have the same noise, NaN = not observed.
        hold: whether nothing moves, shape [E, T]; None = not known.
        smallest: least noise that is believed.
        order: of the differences; a higher one for motion that is fast between samples.

    Raises:
        ValueError: fewer than 20 observed samples of every keypoint, or no noise at all.
    """
    rapid, n_rapid = _differences(keypoints, order)
    level, held = _pooled(rapid, n_rapid), None if hold is None else _held(keypoints, hold, _SHORTEST_HOLD)
    brief = _held(keypoints, hold, _THREE) if hold is not None and held is None else None
    if brief and math.sqrt(_pooled(*brief[:2]) / max(level, 1e-30)) < 1.0 - _SAME:
        held = brief
    variance, count, correlation, restless = held or (rapid, n_rapid, np.zeros(_LAGS), 0)
    # white noise has one level at all frequencies; a jerky recording does not
    if held and abs(correlation[0]) < _scattered(count) and abs(level / _pooled(variance, count) - 1) < _SAME:
        variance, count = rapid, n_rapid
    if count.max() < 20:
        raise ValueError(
            "The noise cannot be estimated: no keypoint is observed often enough, expected at least 20 times in holds, "
            f"or 20 times more than {order} in an episode."
        )
    common = _pooled(variance, count)
    smallest = max(smallest, _rounding(keypoints))
    common, variance = max(common, smallest**2), np.maximum(variance, smallest**2)
    if not common > 0:
        raise ValueError("The noise of these observations cannot be estimated: pass its standard deviation as `noise`.")
    error = common * np.sqrt(2.0 / np.maximum(count, 1.0))
    distinct = (np.abs(variance - common) > _DISTINCT * error) & (count >= 20)
    std = np.sqrt(np.where(distinct, variance, common))
    return NoiseFloor(std, correlation, from_holds=held is not None, rapid=math.sqrt(level), restless=restless)


def _pooled(variance: Float[np.ndarray, "N"], count: Float[np.ndarray, "N"]) -> float:
    """One variance of all keypoints."""
    return float(np.average(variance, weights=np.maximum(count, 1e-9)))


def _rounding(keypoints) -> float:
    """Root mean square of what is lost where a tracker reports whole pixels or millimetres; 0 where it does not.

    Then some samples repeat the one before to the last digit, and others are whole steps away from it.
    """
    apart, largest = np.abs(np.diff(keypoints, axis=1)), np.abs(keypoints[np.isfinite(keypoints)]).max(initial=1e-9)
    apart = apart[np.isfinite(apart)]
    moved = apart[apart > _REPEATED * largest]
    if not len(moved) or len(moved) > _WHOLE * len(apart):
        return 0.0
    step = float(moved.min())
    off = np.abs(moved / step - np.round(moved / step)).max()
    return step / math.sqrt(12.0) if off < 0.02 + 10.0 * _REPEATED * largest / step else 0.0


def still(
    hold: Bool[np.ndarray, "E T"], gripper_pose: Float[np.ndarray, "E T 2 3"], length: float
) -> Bool[np.ndarray, "E T"]:
    """The samples of holds in which the grippers of a cable of this length [m] rest: motion is not noise."""
    kept = np.zeros_like(hold)
    for row, flags, poses in zip(kept, hold, gripper_pose[..., :2], strict=True):
        for begin, end in stretches(flags):
            there = poses[begin:end]
            row[begin:end] = np.abs(there - np.median(there, axis=0)).max(axis=(1, 2)) < _MOVED * length
    return kept


def _differences(keypoints, order: int):
    """Of neighbouring samples; of neighbouring observed ones, where a keypoint is seen in every other sample only."""
    power, n_points = math.comb(2 * order, order), keypoints.shape[2]
    variance, count = np.zeros(n_points), np.zeros(n_points)
    for n in range(n_points):
        row = np.diff(keypoints[:, :, n], n=order, axis=1)
        row = row[np.isfinite(row)]
        if len(row) < 20:
            seen = [points[np.isfinite(points).all(axis=-1)] for points in keypoints[:, :, n]]
            row = np.concatenate([np.diff(points, n=order, axis=0).ravel() for points in seen])
        if len(row) >= 20:
            # without the few where something snapped
            inner = row[np.abs(row) <= 4.0 * 1.4826 * np.median(np.abs(row))]
            variance[n] = np.mean(inner**2) / power
            # overlapping differences: 0.43 of third ones are independent
            count[n] = power**2 / math.comb(4 * order, 2 * order) * len(inner)
    return variance, count


def _held(keypoints, hold, shortest: int):
    """Variance and count per keypoint, pooled autocorrelation, and holds left out; None without a hold.

    Holds have at least `shortest` samples; the noise of those too short to show correlations is taken to be white. A
    hold that scatters far more than the others is one in which the cable moves.
    """
    holds = []
    for episode, flags in zip(keypoints, hold, strict=True):
        for begin, end in stretches(flags):
            if end - begin >= shortest:
                holds.append((end - begin, *_about_lines(episode[begin:end], shortest)))
    usual = [float(squares.sum() / count.sum()) for _, squares, count, _ in holds if count.sum() > 0]
    largest = _RESTLESS * float(np.median(usual)) if usual else 0.0
    kept = [one for one in holds if 0 < one[1].sum() <= largest * one[2].sum()]
    if not kept:
        return None
    squares, count, products = (np.sum([one[k] for one in kept], axis=0) for k in (1, 2, 3))
    if count.max() < 20:
        return None
    variance = squares / np.maximum(count, 1)
    if shortest < _SHORTEST_HOLD:
        return variance, count, np.zeros(_LAGS), len(usual) - len(kept)
    level = squares.sum() / count.sum()
    correlation = products[:, 0] / np.maximum(products[:, 1], 1) / level
    slow = _first_order(correlation, collections.Counter(min(one[0], _LONG) for one in kept), _scattered(count))
    factor, correlation = (1.0, correlation) if slow is None else slow
    return variance * factor, count, correlation, len(usual) - len(kept)


def _about_lines(keypoints: Float[np.ndarray, "T N D"], shortest: int):
    """Squares about a line and their number, per keypoint, and products at lags 1, 2, ... with theirs, of one hold.

    Keypoints that are observed in fewer than `shortest` of its samples are left out.
    """
    t, (_, n_points, axes) = np.arange(len(keypoints), dtype=float), keypoints.shape
    squares, count, products = np.zeros(n_points), np.zeros(n_points), np.zeros((_LAGS, 2))
    for n, axis in np.ndindex(n_points, axes):
        values = keypoints[:, n, axis]
        seen = np.isfinite(values)
        if seen.sum() < shortest:
            continue
        rest = values - np.polyval(np.polyfit(t[seen], values[seen], 1), t)
        squares[n] += np.nansum(rest**2)
        count[n] += seen.sum() - 2
        for lag in range(1, min(_LAGS + 1, len(rest))):
            pair = rest[lag:] * rest[:-lag]
            products[lag - 1] += np.nansum(pair), np.isfinite(pair).sum()
    return squares, count, products


def _scattered(count: Float[np.ndarray, "N"]) -> float:
    """A correlation up to this may be chance."""
    return 4.0 / np.sqrt(max(count.sum(), 1)) + 0.02


def _first_order(correlation: Float[np.ndarray, "K"], lengths: collections.Counter[int], smallest: float):
    """What a first-order process with these correlations about a line has before the line is taken out.

    Its correlation time is at most half of a hold: a longer one is indistinguishable from a trend.

    Args:
        correlation: of what is left of holds without their lines, at lags 1, 2, ...
        lengths: how often a hold of each length was used [samples].
        smallest: correlation that is one.

    Returns:
        By how much its variance is larger, and its correlations; None where no such process has the measured ones.
    """
    coefficients = np.linspace(0.0, np.exp(-2.0 / np.mean(list(lengths.elements()))), 50)
    lags = np.arange(1 + _LAGS)
    variance, products = np.zeros(50), np.zeros((50, _LAGS))
    for length, times in lengths.items():
        t = np.arange(length)
        line = np.linalg.qr(np.stack([np.ones(length), t], axis=1))[0]
        apart = np.abs(t[:, None] - t)
        for i, coefficient in enumerate(coefficients):
            whole = coefficient**apart
            # the line taken out of both sides, without products of whole matrices
            along = whole @ line - 0.5 * line @ (line.T @ whole @ line)
            left = whole - along @ line.T - line @ along.T
            variance[i] += times * np.trace(left) / (length - 2)
            products[i] += [times * np.trace(left, lag) / (length - lag) for lag in lags[1:]]
    expected = products / variance[:, None]
    best = int(np.abs(expected - correlation).max(axis=1).argmin())
    if coefficients[best] < smallest or np.abs(expected[best] - correlation).max() > _LIKE_FIRST_ORDER:
        return None
    return sum(lengths.values()) / variance[best], coefficients[best] ** lags[1:]
