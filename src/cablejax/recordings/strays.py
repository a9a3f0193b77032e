"""Removes keypoints that cannot be on the cable, and takes in which the cable would have to stretch."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from cablejax.cable_length import STRETCH, ring_chords
from cablejax.limits import counted
from cablejax.log_geometry import frozen
from cablejax.recordings.take import Take, spacing, typical_spacing

_OUTLIER = 1.5
"""Distance of a keypoint from the median of its sample, in lengths of the cable, from which on it cannot be on it."""

_TAUT = 1.3, 0.01
"""A cable does not stretch: neighbouring keypoints farther apart than usual by this factor, and by more than this part
of the cable's length, are not both on it."""

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


def without_jumps(takes: tuple[Take, ...]) -> tuple[tuple[Take, ...], list[str]]:
    """Marks keypoints as not observed that are too far from those on both sides, where these are not from each other.

    Several next to each other too: a tracker may write the origin for each that it has lost.
    """
    along = np.concatenate([[0.0], np.cumsum(typical_spacing(takes))])

    def off(points: Float[np.ndarray, "T N D"]) -> np.ndarray:
        found = np.zeros(points.shape[:2], bool)
        for t in np.flatnonzero(_too_far_apart(points, along)):
            found[t] = _off_the_cable(points[t], along)
        return found

    words = "is farther from its neighbours than the cable allows in {where}: treated as not observed."
    return _without(takes, off, words)


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

    def off(points: Float[np.ndarray, "T N D"]) -> np.ndarray:
        found = np.zeros(points.shape[:2], bool)
        for pair, part in share.items():
            if 0 < part <= _ONE_MARKER:
                found[:, pair] |= _doubled(points, *pair)[:, None]
        return found

    return _without(takes, off, "is at one place with another one in {where}: treated as not observed.")


def _doubled(points: Float[np.ndarray, "T N D"], one: int, other: int) -> np.ndarray:
    return np.asarray((points[:, one] == points[:, other]).all(axis=-1))


def without_held(takes: tuple[Take, ...]) -> tuple[tuple[Take, ...], list[str]]:
    """Marks keypoints as not observed that a tracker holds while the cable on both sides moves on, see `frozen`."""
    words = "repeats its last value to the last digit in {where}, while its neighbours move: treated as not observed."
    return _without(takes, frozen, words)


def _without(
    takes: tuple[Take, ...], off: Callable[[np.ndarray], np.ndarray], words: str
) -> tuple[tuple[Take, ...], list[str]]:
    """The takes without keypoints [T, N] that are off, and a sentence on each keypoint, `where` in its words."""
    kept, reports = [], []
    for take in takes:
        found = off(take.keypoints)
        kept.append(dataclasses.replace(take, keypoints=np.where(found[..., None], np.nan, take.keypoints)))
        for index in np.flatnonzero(found.any(axis=0)):
            samples = np.flatnonzero(found[:, index])
            where = f"{len(samples)} of {len(found)} samples, from sample {samples[0]}"
            reports.append(f"Take {take.name}: keypoint {index} {words.format(where=where)}")
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


def _reach(along: np.ndarray, length: float) -> np.ndarray:
    """How far apart two points on the cable may be seen [m], by the length of cable between them [m]."""
    factor, part = _TAUT
    return np.maximum(factor * along, along + part * length)


def _too_far_apart(points: Float[np.ndarray, "T N D"], along: Float[np.ndarray, " N"]) -> np.ndarray:
    """The samples in which a keypoint is out of reach of the one observed before it along the cable, shape [T]."""
    seen = np.asarray(np.isfinite(points).all(axis=-1))
    last = np.maximum.accumulate(np.where(seen, np.arange(len(along)), -1), axis=1)[:, :-1]
    before = np.take_along_axis(points, np.maximum(last, 0)[..., None], axis=1)
    distance = np.linalg.norm(points[:, 1:] - before, axis=-1)
    far = seen[:, 1:] & (last >= 0) & (distance > _reach(along[1:] - along[last], along[-1]))
    return np.asarray(far.any(axis=1))


def _off_the_cable(points: Float[np.ndarray, "N D"], along: Float[np.ndarray, " N"]) -> np.ndarray:
    """Keypoints out of reach of the longest chain of keypoints that are within reach of the next, shape [N].

    At an end of the cable only the last one: more may be the part of a cable that is torn.
    """
    off, seen = np.zeros(len(points), bool), np.flatnonzero(np.isfinite(points).all(axis=-1))
    between: np.ndarray = along[seen][None] - along[seen][:, None]
    distance = np.linalg.norm(points[seen][:, None] - points[seen][None], axis=-1)
    within = distance <= _reach(between, along[-1])
    longest, before = np.ones(len(seen), int), np.full(len(seen), -1)
    for j in range(1, len(seen)):
        if (nearer := np.flatnonzero(within[:j, j])).size:
            before[j] = nearer[::-1][np.argmax(longest[nearer[::-1]])]
            longest[j] = longest[before[j]] + 1
    chain = [int(np.argmax(longest))]
    while before[chain[0]] >= 0:
        chain.insert(0, int(before[chain[0]]))
    if 2 * len(chain) <= len(seen):
        return off
    for a, b in itertools.pairwise(chain):
        if b > a + 1 and not within[a, a + 1] and not within[b - 1, b]:
            off[seen[a + 1 : b]] = True
    # an end has one neighbour, which is where it should be by its other one
    for end, (one, other) in ((0, chain[:2]), (len(seen) - 1, chain[:-3:-1])):
        if abs(one - end) == 1 and distance[one, other] <= abs(between[one, other]) + _TAUT[1] * along[-1]:
            off[seen[end]] = True
    return off
