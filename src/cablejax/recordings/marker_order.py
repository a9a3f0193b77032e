"""Restores the order of markers that motion capture exchanged in part of a recording.

A cable seldom folds back within one spacing of its markers, and no marker crosses the distance to another one within
one sample. Where the order breaks this, and another order does not, the other one is right, unless the cable got there
without a jump. Positions alone cannot show
a reversal of the whole order throughout a take whose spacings read alike from both ends.
"""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from cablejax.recordings.take import Take, spacing, typical_spacing

FOLDED = -0.5
"""Cosine of the turn at a marker below which the cable folds back there: 120 degrees."""

STRETCHED = 1.6
"""Two neighbours this many times their usual distance apart are no neighbours."""

CLEARLY = 0.25
"""Another order must shorten the steps of the markers to this, where the cable does not fold back either way."""

_BREAK, _TOUCHES, _BETWEEN = 2.0, 1.6, 1.15
"""Where a chain goes on at a branch, the next keypoint is this many usual spacings away, another one at most the second
number, and it does not lie between that one and a neighbour: the way by it is longer by more than the third factor."""
_MOSTLY = 0.95

_FEWEST = 4
"""With fewer distances between keypoints an ordinary arch turns as far at one of them as a cable that folds back."""

_DETOUR, _LOOKED_AT = 0.1, 500
"""By this part of the usual spacing a way is shorter, and not by noise; and samples that are looked at."""

# Spacings of a take that differ by more than the first factor from the usual ones, and read from the other end by less
# than the second, are in reverse.
_OTHER, _SAME = np.log(1.25), np.log(1.1)


def restore_order(takes: tuple[Take, ...]) -> tuple[tuple[Take, ...], list[str]]:
    """Puts exchanged markers back in their places.

    Returns:
        The takes, and one sentence for each that was changed.

    Raises:
        ValueError: the cable is branched; or in most samples it folds back: the keypoints are not in the order of the
            cable.
    """
    usual = typical_spacing(takes)
    if branches := _branches(np.concatenate([take.keypoints for take in takes]), usual):
        parent = branches[0][0]
        where = "; ".join(
            f"keypoints {first} to {last} leave it at keypoint {at}"
            if last > first
            else f"keypoint {first} leaves it at keypoint {at}"
            for first, last, at in branches
        )
        last = branches[-1][1]
        rest = f"{parent} to {last}" if last > parent else str(last)
        raise ValueError(
            f"This is a branched cable: after keypoint {parent - 1} the chain continues next to an earlier keypoint "
            f"({where}). Only a cable without branches is simulated. To diagnose the parent alone, give keypoints 0 to "
            f"{parent - 1} and leave out {rest}; the mass of the branches is then missing."
        )
    if len(usual) < _FEWEST:
        return takes, []
    folded = np.concatenate([take.keypoints[_worst_turn(take.keypoints) < FOLDED] for take in takes])
    if len(folded) > 0.5 * sum(len(take.time) for take in takes) and _detours(folded) > 0.5:
        share = len(folded) / sum(len(take.time) for take in takes)
        raise ValueError(
            f"The cable folds back between neighbouring keypoints in {100 * share:.0f} % of the samples: give "
            "the keypoints in their order along the cable, from gripper 0 to gripper 1."
        )
    restored, repairs = [], []
    for take in takes:
        if _reversed(take, usual):
            repairs.append(f"Take {take.name}: its keypoints ran from gripper 1 to gripper 0 and were reversed.")
            take = dataclasses.replace(take, keypoints=take.keypoints[:, ::-1])
        tracked = _tracked(take.keypoints, usual)
        moved = tracked != np.arange(len(usual) + 1)
        if moved.any():
            markers, samples = (np.flatnonzero(moved.any(axis=axis)).tolist() for axis in (0, 1))
            repairs.append(
                f"Take {take.name}: keypoints {', '.join(map(str, markers))} had exchanged their names in "
                f"{len(samples)} of {len(moved)} samples, from sample {samples[0]}, and were reordered."
            )
            points = np.take_along_axis(take.keypoints, tracked[:, :, None], axis=1)
            take = dataclasses.replace(take, keypoints=points)
        restored.append(take)
    return tuple(restored), repairs


def _branches(points: Float[np.ndarray, "T N D"], usual: Float[np.ndarray, " M"]) -> list[tuple[int, int, int]]:
    """First and last keypoint of each branch, and the one that it leaves the chain at; none where the order is wrong.

    A branch begins where the chain breaks off and goes on next to an earlier keypoint that is not an end of the parent.
    """
    base = float(np.median(usual))
    # twice as many as needed; the rest of a long recording adds nothing
    points = points[:: max(1, len(points) // 2000)]

    def mostly(one: int, other: int, quantile: float) -> float:
        distance = np.linalg.norm(points[:, one] - points[:, other], axis=-1)
        seen = np.isfinite(distance)
        return float(np.quantile(distance[seen], quantile)) if seen.any() else np.inf

    ends = np.flatnonzero(usual > _BREAK * base).tolist()
    found: list[tuple[int, int, int]] = []
    for end, last in zip(ends, [*ends, len(usual)][1:], strict=True):
        first, inner = end + 1, [j for j in range(1, end) if j != ends[0]]
        near = {j: mostly(j, first, _MOSTLY) for j in inner}
        at = min(near, key=lambda j: near[j], default=None)
        if at is None or near[at] > _TOUCHES * base:
            return []
        between = (
            mostly(at, first, 0.5) + mostly(first, side, 0.5) < _BETWEEN * mostly(at, side, 0.5)
            for side in (at - 1, at + 1)
        )
        # a first keypoint on top of that of the parent shows no direction
        if mostly(at, first, 0.5) > (_BETWEEN - 1) * base and any(between):
            return []
        found.append((first, last, at))
    return found


def _worst_turn(points: Float[np.ndarray, "*B N D"]) -> Float[np.ndarray, "*B"]:
    """Least cosine between neighbouring segments; 1 where none is observed."""
    along = np.diff(points, axis=-2)
    with np.errstate(invalid="ignore", divide="ignore"):
        along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    cosine = (along[..., 1:, :] * along[..., :-1, :]).sum(axis=-1)
    return np.where(np.isfinite(cosine), cosine, 1.0).min(axis=-1)


def _detours(points: Float[np.ndarray, "T N D"]) -> float:
    """Share of samples whose way along the keypoints is shorter with some part of it, or two at an end, in reverse.

    So it is where the order is wrong. A bend between two parallel arms folds back too, between keypoints that are
    farther apart than the arms, and has no shorter way.
    """
    points = points[:: max(1, len(points) // _LOOKED_AT)]
    distance = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1)
    last, step = points.shape[1] - 1, spacing(points)
    gains = [step[:, 1] - distance[:, 0, 2], step[:, -2] - distance[:, last, last - 2]]
    for first, end in itertools.combinations(range(1, last), 2):
        reversed_ = distance[:, first - 1, end] + distance[:, first, end + 1]
        gains.append(step[:, first - 1] + step[:, end] - reversed_)
    most = np.nan_to_num(np.array(gains), nan=0.0).max(axis=0)
    return float((most > _DETOUR * np.nanmean(step, axis=1)).mean())


def _broken(points: Float[np.ndarray, "*B N D"], usual: Float[np.ndarray, " M"]) -> np.ndarray:
    return (_worst_turn(points) < FOLDED) | _stretched(points, usual)


def _stretched(points: Float[np.ndarray, "*B N D"], usual: Float[np.ndarray, " M"]) -> np.ndarray:
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = spacing(points) / usual
    return np.where(np.isfinite(ratio), ratio, 1.0).max(axis=-1) > STRETCHED


def _reversed(take: Take, usual: Float[np.ndarray, " M"]) -> bool:
    seen = spacing(take.keypoints)
    if not np.isfinite(seen).any(axis=0).all():
        return False
    with np.errstate(divide="ignore", invalid="ignore"):
        own, usually = np.log(np.nanmedian(seen, axis=0)), np.log(usual)
        return bool(abs(own - usually).max() > _OTHER and abs(own[::-1] - usually).max() < _SAME)


def _tracked(points: Float[np.ndarray, "T N D"], usual: Float[np.ndarray, " M"]) -> np.ndarray:
    """Index of the given keypoint at each place of the cable, shape [T, N]."""
    samples, count, _ = points.shape
    order = np.tile(np.arange(count), (samples, 1))
    broken = _broken(points, usual)
    step = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    typical = np.median(np.nan_to_num(step), axis=-1)
    # A sample is looked at where the cable is broken, or where the markers jump by more than half their distance.
    if not broken.any() and not (typical > 0.5 * np.median(usual)).any():
        return order
    swaps = _swaps(count)
    current = np.arange(count)
    for t in range(samples):
        here = points[t]
        before = points[t - 1][order[t - 1]] if t else None
        current = _best(here, before, current, swaps, usual)
        order[t] = current
    return order


def _swaps(count: int) -> np.ndarray:
    """All exchanges of two places, and the reversal, shape [C, N]."""
    rows = [np.arange(count)[::-1]]
    for i, j in itertools.combinations(range(count), 2):
        row = np.arange(count)
        row[[i, j]] = j, i
        rows.append(row)
    return np.array(rows)


def _best(here, before, current, swaps, usual) -> np.ndarray:
    """The order at one sample, given the cable at the sample before, in order, and the order it had.

    A marker that is not observed keeps its place; what it was is compared with nothing.
    """

    def step(there: np.ndarray) -> np.ndarray:
        """Largest motion of a marker since the sample before, infinite where none is seen in both."""
        moved = np.linalg.norm(there - before, axis=-1)
        return np.where(np.isfinite(moved).any(axis=-1), np.nan_to_num(moved, nan=0.0).max(axis=-1), np.inf)

    seen = np.isfinite(here).all(axis=-1)
    broken_now = bool(_broken(here[current], usual))
    now = np.inf if before is None else float(step(here[current]))
    first = not np.isfinite(now)
    jumps = now >= 0.5 * np.median(usual)
    if not broken_now and (first or not jumps):
        return current
    candidates = [np.arange(len(current))[None], current[swaps]]
    if before is not None and seen.all() and np.isfinite(before).all():
        distance = np.linalg.norm(before[:, None] - here[None], axis=-1)
        candidates.append(linear_sum_assignment(distance**2)[1][None])
    orders = np.concatenate(candidates)
    orders = orders[((orders == current) | (seen[orders] & seen[current])).all(axis=1)]
    orders = orders[~_broken(here[orders], usual)]
    if len(orders) == 0:
        return current
    if first:  # of the orders that do not fold back, the shortest way along the markers
        return orders[np.argmin(np.nansum(spacing(here[orders]), axis=-1))]
    moved = step(here[orders])
    best = int(np.argmin(moved))
    # a soft cable may fold back, or leave its gripper steeply, and one that is torn is broken too: no order mends
    # these, for markers would have to cross it
    wrong = broken_now and (jumps or bool(_stretched(here[current], usual)))
    mends = moved[best] < (max(now, STRETCHED * usual.max()) if wrong else CLEARLY * now)
    return orders[best] if mends else current
