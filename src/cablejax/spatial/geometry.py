"""Local changes of the set-up between recordings: markers or grips that sit elsewhere than in the other files.

The distance between neighbouring keypoints is read at its largest over an episode, where the cable between them is
straightest; between two keypoints of one gripper it does not change at all. An episode stands out where this distance
differs from the median over episodes by far more than episodes scatter.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from cablejax.gaplog import labels
from cablejax.types import GapLog

_SCATTERS = 6.0
_SMALLEST = 0.002  # [m]
# Differences of free neighbours move with bending; they need to be larger.
_SMALLEST_FREE = 0.006  # [m]
_QUANTILE = 0.9


def local_changes(log: GapLog, held: tuple[int, int]) -> tuple[str, ...]:
    """Says where the geometry of some episodes differs from that of the others, the largest change first."""
    points = log.keypoints.shape[2]
    grippers = [0 if k + 1 < held[0] else 1 if k >= points - held[1] else None for k in range(points - 1)]
    spacing = pair_distances(log, [gripper is not None for gripper in grippers])
    s, names, found = np.asarray(log.meta["keypoint_arclength_m"], float), labels(log, "file", "take"), []
    for k, gripper in enumerate(grippers):
        column = spacing[:, k]
        if not np.isfinite(column).any():
            continue
        usual = np.nanmedian(column)
        scatter = 1.4826 * np.nanmedian(np.abs(column - usual))
        if gripper is None:
            least, where, why = _SMALLEST_FREE, "on the free cable", "a marker has moved, or the cable between them"
        else:
            least, where, why = _SMALLEST, f"at gripper {gripper}", "it was gripped again"
        odd = np.flatnonzero(np.abs(column - usual) > max(_SCATTERS * scatter, least))
        for sign in (-1, 1):
            part = odd[np.sign(column[odd] - usual) == sign]
            if len(part):
                here, files = np.median(column[part]), list(dict.fromkeys(names[e] for e in part))
                sentence = (
                    f"In file{'' if len(files) == 1 else 's'} {_ranges(files)}, keypoints {k} and {k + 1} {where} "
                    f"({s[k]:.2f} to {s[k + 1]:.2f} m) are {1e3 * here:.1f} mm apart instead of {1e3 * usual:.1f} mm: "
                    f"{why}."
                )
                found.append((abs(here - usual), sentence))
    return tuple(sentence for _, sentence in sorted(found, key=lambda one: -one[0]))


def pair_distances(log: GapLog, rigid: Sequence[bool]) -> Float[np.ndarray, "E M"]:
    """Distance of neighbouring keypoints in every episode [m]: the median where `rigid`, else nearly the largest.

    NaN where the two are never observed together.
    """
    rows = np.full((len(log.keypoints), len(rigid)), np.nan)
    for row, points, count in zip(rows, log.keypoints, log.episode_length, strict=True):
        distance = np.linalg.norm(np.diff(np.asarray(points[:count], float), axis=1), axis=-1)
        for k in np.flatnonzero(np.isfinite(distance).any(axis=0)).tolist():
            row[k] = np.nanquantile(distance[:, k], 0.5 if rigid[k] else _QUANTILE)
    return rows


def _ranges(files):
    """Runs of numbers, as in: 102 to 106, 111."""
    if not all(name.isdecimal() for name in files):
        return ", ".join(files)
    numbers = sorted(int(name) for name in files)
    runs = [[numbers[0], numbers[0]]]
    for number in numbers[1:]:
        if number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return ", ".join(str(first) if first == last else f"{first} to {last}" for first, last in runs)
