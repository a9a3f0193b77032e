"""Finds keypoints that were not measured: a tracker holds their last value, or reads them somewhere else."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int

from cablejax.arrays import stretches

# So many samples without any change, while both neighbours move in most of them, are a tracker's last value.
_FROZEN, _MOVING = 10, 0.8
# A misread keypoint is off its path by this part of the cable's length, so many times the usual distance, and so many
# times those of the keypoints around it: a motion of the cable moves these too.
_FAR, _UNUSUAL, _ALONE = 0.01, 8.0, 4.0
# A misreading lasts so many samples at most, and where more than so many are in doubt, none is found.
_AWAY, _DOUBTED = 5, 50
# A path is that of two samples before and two after, which may be so many intervals apart.
_NODES, _SPAN = np.array([-2, -1, 1, 2]), 10.0
# Variance of a sample's distance from its path, where four samples evenly apart give it, in that of their noise.
_SCATTER = 1.0 + (1 + 16 + 16 + 1) / 36
# A cable does not stretch: neighbouring keypoints farther apart than usual by this factor, and by more than this part
# of its length, are not both on it.
_TAUT = 1.3, 0.01


def held(_time: object, points: Float[np.ndarray, "T N D"], _usual: object) -> Bool[np.ndarray, "T N"]:
    """Which keypoints a tracker repeats to the last digit while both their neighbours move on."""
    found = np.zeros(points.shape[:2], bool)
    same = np.asarray((points[1:] == points[:-1]).all(axis=-1))
    for index in 1 + np.flatnonzero(same[:, 1:-1].sum(axis=0) >= _FROZEN):
        for first, after in stretches(same[:, index]):
            beside = points[first : after + 1][:, [index - 1, index + 1]]
            moving = (np.abs(np.diff(beside, axis=0)) > 0).any(axis=-1)
            if after - first >= _FROZEN and moving.mean(axis=0).min() > _MOVING:
                found[first + 1 : after + 1, index] = True
    return found


def off_the_cable(
    _time: object, points: Float[np.ndarray, "T N D"], usual: Float[np.ndarray, " M"]
) -> Bool[np.ndarray, "T N"]:
    """Which keypoints are too far from those on both sides, where these are not from each other.

    Several next to each other too: a tracker may write the origin for each that it has lost.
    """
    along = np.concatenate([[0.0], np.cumsum(usual)])
    found = np.zeros(points.shape[:2], bool)
    for t in np.flatnonzero(_too_far_apart(points, along)):
        found[t] = _beyond(points[t], along)
    return found


def misread(
    time: Float[np.ndarray, " T"], points: Float[np.ndarray, "T N D"], usual: Float[np.ndarray, " M"]
) -> Bool[np.ndarray, "T N"]:
    """Which keypoints leave their paths for a few samples, while those around them keep to theirs.

    A sample is off its path by its distance from the cubic through the two samples before and the two after it. As few
    samples are found as possible without which no other is far off its path. A mode of the cable so short that one
    keypoint moves alone has no such amplitude.
    """
    found = np.zeros(points.shape[:2], bool)
    while True:
        left = np.where(found[..., None], np.nan, points)
        off = np.stack([_off_path(time, path) for path in left.swapaxes(0, 1)], axis=1)
        if not np.isfinite(off).any():
            return found
        least = max(_FAR * usual.sum(), _UNUSUAL * float(np.nanmedian(off)))
        allowed = np.maximum(least, _ALONE * _around(off))
        far, before = off > allowed, found.sum()
        for index in np.flatnonzero(far.any(axis=0)):
            known = np.flatnonzero(np.isfinite(left[:, index]).all(axis=-1))
            # a misread sample is in the paths of two before and two after it
            near = np.convolve(far[known, index], np.ones(5), "same") > 0
            for first, after in stretches(near):
                around = known[max(first - 4, 0) : after + 4]
                if after - first <= _DOUBTED:
                    wrong = _fewest(time[around], left[around, index], allowed[around, index])
                    found[around[wrong], index] = True
        if found.sum() == before:
            return found


def _fewest(
    time: Float[np.ndarray, " S"], path: Float[np.ndarray, "S D"], allowed: Float[np.ndarray, " S"]
) -> Int[np.ndarray, " W"]:
    """Few samples of a path without which no other is farther off it than allowed; none if that takes many.

    Not those from which the path goes on, on either side: a gripper that jerks stays where it is then.
    """

    def excess(rest: Int[np.ndarray, " R"]) -> tuple[float, float]:
        """By how much samples are farther off than allowed, and how far all are, in what is allowed."""
        share = np.nan_to_num(_off_path(time[rest], path[rest]) / allowed[rest])
        return float(np.maximum(share - 1.0, 0.0).sum()), float(share.sum())

    every = rest = np.arange(len(path))
    left, _ = excess(rest)
    while left > 0 and 2 * len(rest) > len(every):
        tried = []
        for size in range(1, _AWAY + 1):
            for begin in range(len(rest) - size + 1):
                fewer = np.delete(rest, np.s_[begin : begin + size])
                over, off = excess(fewer)
                # the shortest stretch that is enough and leaves the smoothest path; else what helps most for its length
                tried.append(((over > 0, (over - left) / size if over else size, off), over, fewer))
        _, left, rest = min(tried, key=lambda one: one[0])
    wrong = every[:0] if left > 0 else np.setdiff1d(every, rest)

    def goes_on(at: int, nodes: Int[np.ndarray, " 2"]) -> bool:
        (one, other), (begin, end) = path[nodes], time[nodes]
        line = one + (other - one) * (time[at] - begin) / (end - begin)
        return bool(np.linalg.norm(path[at] - line) <= allowed[at])

    sides = [(at, side) for at in wrong for side in (rest[rest < at][-2:], rest[rest > at][:2]) if len(side) == 2]
    return np.setdiff1d(wrong, [at for at, side in sides if goes_on(at, side)])


def _around(off: Float[np.ndarray, "T N"]) -> Float[np.ndarray, "T N"]:
    """Median distance from their paths of the two keypoints on either side; infinite where none is known."""
    padded = np.pad(off, ((0, 0), (2, 2)), constant_values=np.nan)
    others = np.stack([padded[:, 2 + by : 2 + by + off.shape[1]] for by in _NODES], axis=-1)
    known = np.isfinite(others).any(axis=-1)
    result = np.full(off.shape, np.inf)
    result[known] = np.nanmedian(others[known], axis=-1)
    return result


def _off_path(time: Float[np.ndarray, " T"], path: Float[np.ndarray, "T D"]) -> Float[np.ndarray, " T"]:
    """Distance of each observed sample from the curve through its neighbours in time [m]; NaN where they are far.

    These are two before and two after it, or fewer at an end of the path. Where the curve passes on more of their noise
    than between four that are evenly apart, the distance is less by that.
    """
    off = np.full(len(path), np.nan)
    known = np.flatnonzero(np.isfinite(path).all(axis=-1))
    if len(known) < 5:
        return off
    nodes = np.arange(len(known))[:, None] + _NODES
    there = (nodes >= 0) & (nodes < len(known))
    nodes = known[np.clip(nodes, 0, len(known) - 1)]
    ahead = np.where(there, time[nodes] - time[known, None], 0.0)
    curve, scatter = np.zeros((len(known), path.shape[1])), np.ones(len(known))
    for i in range(4):
        others, counts = np.delete(ahead, i, axis=1), np.delete(there, i, axis=1) & there[:, [i]]
        ratio = np.divide(others, others - ahead[:, [i]], out=np.ones_like(others), where=counts)
        weight = there[:, i] * ratio.prod(axis=1)
        curve += weight[:, None] * path[nodes[:, i]]
        scatter += weight**2
    near = np.ptp(ahead, axis=1) <= _SPAN * float(np.median(np.diff(time)))
    distance = np.linalg.norm(path[known] - curve, axis=1) / np.sqrt(np.maximum(scatter / _SCATTER, 1.0))
    off[known] = np.where(near, distance, np.nan)
    return off


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


def _beyond(points: Float[np.ndarray, "N D"], along: Float[np.ndarray, " N"]) -> np.ndarray:
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


FAULTS: dict[str, Callable[..., np.ndarray]] = {
    "repeats its last value to the last digit while its neighbours move": held,
    "is farther from its neighbours than the cable allows": off_the_cable,
    "leaves its path while those around it keep to theirs": misread,
}
"""What may be wrong with a keypoint, in words that follow "keypoint 3", and what finds it, in this order.

Each takes the times of the samples, increasing [s], shape [T]; the keypoints [m], NaN = not observed, shape [T, N, D];
how far each is usually from the next one [m], shape [N - 1]; and returns which keypoints have the fault, shape [T, N].
"""
