"""Significance tests for few episodes and correlated samples."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import chi2

from cablejax.arrays import mean_of_finite, stretches
from cablejax.diagnose.evidence import episodes_by_motion
from cablejax.types import GapLog

LEVEL = 0.05
"""Family-wise level of every statement."""
NOISE_TOLERANCE = 1.15
"""The noise floor is itself an estimate: a variance this much larger than stated is still held to be noise."""
# Correlation time that is assumed where there is no hold to measure it in [s].
_DEFAULT_CORRELATION = 0.5
_LAGS = 8
_MAX_EXACT_FLIPS = 12
_RANDOM_FLIPS = 4096


def variance_inflation(whitened: Float[np.ndarray, "E T N 2"], log: GapLog, hold: Bool[np.ndarray, "E T"]) -> float:
    """Factor by which correlation in time widens a sum of squares, `1 + 2 sum rho_k^2`, measured in holds if any.

    In a hold the residual less its mean is noise. Where no hold is long enough, correlation over half a second is
    assumed.
    """
    products, count, samples = np.zeros(_LAGS + 1), 0, 0
    for e in range(len(whitened)):
        for begin, end in stretches(hold[e]):
            if end - begin < 2 * _LAGS:
                continue
            piece = whitened[e, begin:end].reshape(end - begin, -1)
            piece = piece[:, np.isfinite(piece).mean(axis=0) > 0.5]
            piece = piece - np.nanmean(piece, axis=0)
            pairs = [piece[: len(piece) - k] * piece[k:] for k in range(_LAGS + 1)]
            products += [mean_of_finite(both, 0).sum() for both in pairs]
            count += piece.shape[1]
            samples += np.isfinite(piece).sum()
    if count == 0 or products[0] <= 0:
        steps = log.intervals
        return 1.0 + (_DEFAULT_CORRELATION / float(np.median(steps)) if len(steps) else 0.0)
    rho = products[1:] / products[0]
    # scatter alone is no correlation
    rho = np.where(np.abs(rho) > 3 / np.sqrt(samples), rho, 0.0)
    return 1.0 + 2.0 * float((rho**2).sum())


def exceedance_p(squared: Float[np.ndarray, "G M"], inflation: float) -> Float[np.ndarray, "G"]:
    """p-values of "nothing but noise" for several groups, by chi-square tests corrected after Holm (1979).

    Args:
        squared: mean square of the two whitened coordinates of every sample of a group, NaN = not observed.
        inflation: from `variance_inflation`.
    """
    raw = np.ones(len(squared))
    for g, values in enumerate(squared):
        values = values[np.isfinite(values)]
        if len(values):
            freedom = 2 * len(values) / inflation
            raw[g] = chi2.sf(freedom * values.mean() / NOISE_TOLERANCE, freedom)
    order = np.argsort(raw)
    stepped = np.maximum.accumulate(raw[order] * np.arange(len(raw), 0, -1))
    corrected = np.empty_like(raw)
    corrected[order] = np.minimum(stepped, 1.0)
    return corrected


def smallest_gap(noise: Float[np.ndarray, "N"], freedom: float, level: float) -> float:
    """The gap [mm] that a test of `freedom` independent coordinates at this level would just find."""
    excess = NOISE_TOLERANCE * float(chi2.isf(level, freedom)) / freedom - 1.0
    return 1e3 * float(np.sqrt(max(excess, 0.0) * (noise**2).mean()))


def contrast_p(values: Float[np.ndarray, "E C"], motion: Int[np.ndarray, "E"]) -> Float[np.ndarray, "C"]:
    """p-values of "no contrast" for several contrasts, the signs of each motion's episodes flipped together.

    A contrast's |sum| over the root of its sum of squares is held against the largest of all contrasts under each flip
    (Westfall and Young 1993), which keeps the chance of any false statement below the level.

    Args:
        values: of each contrast in each episode, symmetric about 0 if there is none; NaN = not to be had.
        motion: episodes with the same number repeat one another.
    """
    each = np.where(np.isfinite(values), values, 0.0)
    filled = np.stack([each[own].sum(axis=0) for own in episodes_by_motion(motion)])
    scale = np.sqrt((filled**2).sum(axis=0)) + 1e-12
    n_episodes = len(filled)
    if n_episodes <= _MAX_EXACT_FLIPS:
        bits = (np.arange(2**n_episodes)[:, None] >> np.arange(n_episodes)) & 1
    else:
        bits = np.random.default_rng(0).integers(0, 2, (_RANDOM_FLIPS, n_episodes))
        bits[0] = 0
    statistics = np.abs((1 - 2 * bits) @ filled) / scale
    largest = statistics.max(axis=1)
    return (largest[:, None] >= statistics[0] - 1e-9).mean(axis=0)
