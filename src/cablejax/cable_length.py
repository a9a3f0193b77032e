"""Rejects arc lengths that do not fit the keypoints, and keypoints of a cable that stretches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

TOLERANCE = 0.03
"""By how much keypoints may lie further apart than their arc lengths say, relative to the cable's length: markers sit
off the centreline, and real cables stretch a little."""


BENT = 0.12
"""By how much keypoints may lie closer together than their arc lengths say, relative to it, beyond what a cable bent
into a ring accounts for."""

STRETCH = 0.2
"""By how much the polyline through the keypoints may grow in the course of a recording, relative to it."""


def require_fitting_length(
    episodes: Sequence[Float[np.ndarray, "T N D"]], arclength: Float[np.ndarray, " N"], name: str
) -> None:
    """Rejects arc lengths that are shorter than the polyline through the keypoints, over any stretch, or far longer.

    Args:
        episodes: keypoints [m], NaN = not observed.
        arclength: of each keypoint [m].
        name: what the arc lengths are called where they come from.

    Raises:
        ValueError: they are shorter by more than noise and `TOLERANCE`, longer by more than `BENT`, or the polyline
            grows by more than `STRETCH`.
    """
    chords = np.concatenate([np.linalg.norm(np.diff(points, axis=1), axis=-1) for points in episodes])
    stated = np.diff(arclength)
    seen = np.isfinite(chords).any(axis=0)
    usual = stated.copy()
    usual[seen] = np.nanmedian(chords[:, seen], axis=0)
    # noise across a chord lengthens it
    noise = coordinate_noise(episodes)
    across = (episodes[0].shape[-1] - 1) * noise**2 / np.maximum(stated, 1e-9)
    excess = np.concatenate([[0.0], np.cumsum(usual - stated - across)])
    low = np.minimum.accumulate(excess)
    end = int((excess - low).argmax())
    begin = int(excess[: end + 1].argmin())
    if excess[end] - excess[begin] > TOLERANCE * arclength[-1]:
        raise ValueError(
            f"From keypoint {begin} to {end} it usually is {usual[begin:end].sum():.4g} m from one to the next, but "
            f"{name} gives them {stated[begin:end].sum():.4g} m of cable, and a cable does not stretch that much "
            f"(noise of {1e3 * noise:.2g} mm is allowed for): correct {name}, or the unit of length."
        )
    ring = float(ring_chords(stated).sum() / stated.sum())
    if usual.sum() < (ring - BENT) * stated.sum():
        raise ValueError(
            f"Along its keypoints the cable usually measures {usual.sum():.4g} m, but {name} gives it "
            f"{stated.sum():.4g} m: correct {name}, or the unit of length."
        )
    whole = chords.sum(axis=1)[np.isfinite(chords).all(axis=1)]
    short, long = np.quantile(whole, [0.05, 0.95]) if len(whole) else (1.0, 1.0)
    if long > (1 + STRETCH) / ring * short + 2 * len(stated) * noise:
        raise ValueError(
            f"Along the keypoints the cable measures {short:.4g} m in some samples and {long:.4g} m in others, and a "
            "cable does not stretch that much: check the camera's scale, and that the markers stay on the cable."
        )


def ring_chords(stated: Float[np.ndarray, " M"]) -> Float[np.ndarray, " M"]:
    """Distances between neighbouring keypoints [m] where the cable is bent into a ring, from the arcs between them."""
    length = float(stated.sum())
    return length / np.pi * np.sin(np.pi * stated / length)


def coordinate_noise(episodes: Sequence[Float[np.ndarray, "T N D"]]) -> float:
    """Standard deviation of a coordinate [m], from third differences in time; 0 where there are too few samples."""
    third = np.concatenate([np.diff(points, n=3, axis=0).ravel() for points in episodes])
    third = np.abs(third[np.isfinite(third)])
    return float(1.4826 * np.median(third) / np.sqrt(20)) if len(third) else 0.0
