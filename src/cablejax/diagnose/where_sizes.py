"""Sizes of the gap along the cable and by episode, without tests, for cables off the table."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from cablejax.arrays import mean_of_finite
from cablejax.diagnose.where import Where, above
from cablejax.diagnose.where_words import describe


def sizes_of(
    squares: Float[np.ndarray, "E T N D"],
    noise: float,
    arclength: Float[np.ndarray, "N"],
    *,
    smallest_mm: float,
    names: Sequence[str],
    gap_mm: float | None = None,
    horizons_mm: Mapping[float, float] = MappingProxyType({}),
    regimes: Mapping[str, float] = MappingProxyType({}),
    first: Sequence[str] = (),
) -> Where:
    """Keypoints and episodes at which a nominal simulation is off.

    Args:
        squares: squared errors of every coordinate [m^2], NaN = not observed.
        noise: standard deviation of a coordinate [m].
        arclength: of the keypoints [m].
        smallest_mm: the least gap that would have been seen.
        names: what to call each episode.
        gap_mm: over all that is compared, where that is not all of `squares`.
        horizons_mm: see `Where`.
        regimes: see `Where`.
        first: sentences that come before all others.
    """
    where = Where(
        gap_mm=float(above(squares, noise)) if gap_mm is None else gap_mm,
        smallest_mm=smallest_mm,
        along_cable_mm=above(squares, noise, (0, 1, 3)),
        per_episode_mm=above(squares, noise, (1, 2, 3)),
        heat=np.sqrt(mean_of_finite(squares, -1)) / max(noise, 1e-6),
        horizons_mm=dict(horizons_mm),
        regimes=dict(regimes),
    )
    found = describe(where, np.asarray(arclength), np.array([noise]), names)
    return dataclasses.replace(where, sentences=(*first, *found))
