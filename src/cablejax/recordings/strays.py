"""Removes keypoints that cannot be on the cable, and takes in which the cable would have to stretch."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from cablejax.cable_length import STRETCH, ring_chords
from cablejax.false_keypoints import FAULTS
from cablejax.limits import counted
from cablejax.recordings.take import Take, spacing, typical_spacing

_OUTLIER = 1.5
"""Distance of a keypoint from the median of its sample, in lengths of the cable, from which on it cannot be on it."""

_ONE_MARKER = 0.5
"""Two keypoints that are at one place in more than this part of the samples are one marker."""

_FEW_STRETCHED = 0.2
"""Up to this part of the takes is left out where the cable stretches; more have a cause that needs another mend."""


def without_outliers(takes: tuple[Take, ...]) -> tuple[tuple[Take, ...], list[str]]:
    """Marks keypoints as not observed that lie farther from the rest of their sample than the cable is long."""
    length, kept, count, farthest = float(typical_spacing(takes).sum()), [], 0, 0.0
    for take in takes:
        middle = np.full((len(take.time), 1, take.keypoints.shape[2]), np.nan)
        shown = np.asarray(np.isfinite(take.keypoints).all(axis=2)).any(axis=1)
        middle[shown, 0] = np.nanmedian(take.keypoints[shown], axis=1)
        distance = np.nan_to_num(np.linalg.norm(take.keypoints - middle, axis=2), nan=0.0)
        far = distance > _OUTLIER * length
        count, farthest = count + int(far.sum()), max(farthest, float(distance.max(initial=0.0)))
        kept.append(dataclasses.replace(take, keypoints=np.where(far[..., None], np.nan, take.keypoints)))
    if not count:
        return takes, []
    return tuple(kept), [
        f"{counted(count, 'keypoint')} lay up to {farthest:.3g} m from the rest of the cable, which is "
        f"{length:.3g} m long: treated as not observed."
    ]


def without_doubles(takes: tuple[Take, ...]) -> tuple[tuple[Take, ...], list[str]]:
    """Marks keypoints as not observed that are at one place with another one: a tracker puts all it has lost at one.

    A branch may begin with the keypoint that it leaves the cable at: those are at one place throughout, and stay.

    Raises:
        ValueError: two neighbours are at one place in most samples: it is one marker.
    """
    points = np.concatenate([take.keypoints for take in takes])
    pairs = itertools.combinations(range(points.shape[1]), 2)
    share = {pair: float(_doubled(points, *pair).mean()) for pair in pairs}
    if neighbours := [(i, j) for (i, j), part in share.items() if part > _ONE_MARKER and j == i + 1]:
        i, j = neighbours[0]
        raise ValueError(
            f"Keypoints {i} and {j} are at one place in {100 * share[i, j]:.0f} % of the samples, "
            "expected a marker of its own for each: leave one of the two out, or check which columns or topic are read."
        )

    def off(take: Take) -> np.ndarray:
        points = take.keypoints
        found = np.zeros(points.shape[:2], bool)
        for pair, part in share.items():
            if 0 < part <= _ONE_MARKER:
                found[:, pair] |= _doubled(points, *pair)[:, None]
        return found

    return _without(takes, off, "is at one place with another one")


def _doubled(points: Float[np.ndarray, "T N D"], one: int, other: int) -> np.ndarray:
    return np.asarray((points[:, one] == points[:, other]).all(axis=-1))


def without_false_keypoints(takes: tuple[Take, ...]) -> tuple[tuple[Take, ...], list[str]]:
    """Marks keypoints as not observed that a tracker holds or misreads, see `false_keypoints`."""
    usual, repairs = typical_spacing(takes), []
    for words, find in FAULTS.items():
        takes, reports = _without(takes, lambda take, find=find: find(take.time, take.keypoints, usual), words)
        repairs += reports
    return takes, repairs


def _without(
    takes: tuple[Take, ...], off: Callable[[Take], np.ndarray], words: str
) -> tuple[tuple[Take, ...], list[str]]:
    """The takes without keypoints [T, N] that are off, and a sentence on each keypoint."""
    kept, reports = [], []
    for take in takes:
        found = off(take)
        kept.append(dataclasses.replace(take, keypoints=np.where(found[..., None], np.nan, take.keypoints)))
        for index in np.flatnonzero(found.any(axis=0)):
            samples = np.flatnonzero(found[:, index])
            reports.append(
                f"Take {take.name}: keypoint {index} {words} in {len(samples)} of {len(found)} samples, from sample "
                f"{samples[0]}: treated as not observed."
            )
    return tuple(kept), reports


def without_stretched(takes: tuple[Take, ...]) -> tuple[tuple[Take, ...], list[str]]:
    """Leaves out a few takes in which the keypoints are farther apart than the cable is long."""
    spacings, kept, reports = typical_spacing(takes), [], []
    usual = float(spacings.sum())
    # chords grow where a bent cable is pulled straight
    longest_usual = (1 + STRETCH) * usual**2 / float(ring_chords(spacings).sum())
    for take in takes:
        whole = spacing(take.keypoints).sum(axis=1)
        longest = float(np.nanquantile(whole, 0.95)) if np.isfinite(whole).any() else 0.0
        if longest <= longest_usual:
            kept.append(take)
            continue
        reports.append(
            f"Take {take.name}: along the keypoints the cable measures up to {longest:.3g} m, usually {usual:.3g} m, "
            "and a cable does not stretch that much: the take was left out. Was the cable torn, or did a marker come "
            "off?"
        )
    return (tuple(kept), reports) if len(reports) <= _FEW_STRETCHED * len(takes) else (takes, [])
