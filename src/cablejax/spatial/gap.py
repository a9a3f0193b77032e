"""How far a simulation is off the recorded windows, and how much of that an explanation takes away."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from cablejax.diagnose.diagnosis import Gap
from cablejax.spatial.fit import bounded
from cablejax.spatial.search import resampled
from cablejax.spatial.windows import Windows

RESOLVABLE = 3.0
"""A gap up to so many times the noise is none."""


def noise_of(windows: Windows) -> float:
    """Standard deviation of a coordinate [m], from fourth differences in time, which no motion of a cable has."""
    fourth = np.diff(windows.keypoints, n=4, axis=1)
    fourth = fourth[(windows.valid[:, 4:]) & np.isfinite(fourth).all(axis=(2, 3))]
    return float(1.4826 * np.median(np.abs(fourth)) / np.sqrt(70)) if fourth.size else 0.0


def squares(predicted: Float[np.ndarray, "W T F 3"], windows: Windows) -> Float[np.ndarray, "W T F 3"]:
    """Squared errors of free coordinates, bounded by a metre, NaN where nothing was recorded."""
    off = bounded(predicted - windows.keypoints) ** 2
    seen = np.isfinite(windows.keypoints) & windows.valid[:, :, None, None]
    seen[:, :2] = False
    return np.where(seen, off, np.nan)


def mean_of_finite(values: np.ndarray, axis: tuple[int, ...] | int | None) -> np.ndarray:
    """Mean of what is finite; NaN where nothing is."""
    seen = np.isfinite(values)
    count = seen.sum(axis=axis)
    return np.where(count > 0, np.where(seen, values, 0.0).sum(axis=axis) / np.maximum(count, 1), np.nan)


def _until(squared: Float[np.ndarray, "W T F 3"], interval: float) -> dict[float, float]:
    """Root mean square of errors up to some seconds after a window's beginning [mm], from their squares [m^2]."""
    return {s: 1e3 * float(np.sqrt(np.nanmean(squared[:, : round(s / interval)]))) for s in (1.0, 2.0, 5.0)}


def gap_of(
    before: Float[np.ndarray, "W T F 3"], after: Float[np.ndarray, "W T F 3"], windows: Windows, noise: float
) -> Gap:
    """How far two predictions of the windows are off, and how much of that goes from one to the other.

    Args:
        before: of the nominal simulator [m].
        after: with the effects that were found, each window from a fit that has not seen it [m].
        windows: as recorded.
        noise: standard deviation of a coordinate [m].
    """
    squared = [squares(part, windows) for part in (before, after)]
    means = [np.nanmean(s) for s in squared]
    windowed = [mean_of_finite(s, (1, 2, 3)) for s in squared]
    resolvable = means[0] > (RESOLVABLE * noise) ** 2
    shrinkage = float(1 - (means[1] - noise**2) / (means[0] - noise**2)) if resolvable else None
    interval = None
    if shrinkage is not None:
        one, other = (resampled(w, windows.group) for w in windowed)
        low, high = np.quantile(1 - other / one, [0.05, 0.95])
        interval = (float(low), float(high))
    ahead = [_until(s, windows.interval) for s in squared]
    floor, left = float(noise**2 / means[0]), float(means[1] / means[0])
    return Gap(
        horizon_s=float((windows.valid.sum(axis=1).max() - 1) * windows.interval),
        before_rmse_mm=1e3 * float(np.sqrt(means[0])),
        after_rmse_mm=1e3 * float(np.sqrt(means[1])),
        noise_floor_mm=1e3 * noise,
        shrinkage=shrinkage,
        shrinkage_ci90=interval,
        ahead_mm=None,
        horizons_mm={seconds: (ahead[0][seconds], ahead[1][seconds]) for seconds in ahead[0]},
        held_out_episodes=tuple(sorted({int(e) for e in windows.episode})),
        split=split_of(floor, left),
    )


def split_of(floor: float, left: float) -> dict[str, float | None]:
    """`Gap.split` from the shares of the squared error before that are noise and that are left, noise included."""
    floor = min(floor, 1.0)
    unexplained = min(max(left - floor, 0.0), 1.0 - floor)
    return {"noise": floor, "named": 1.0 - floor - unexplained, "learnable": None, "unexplained": unexplained}
