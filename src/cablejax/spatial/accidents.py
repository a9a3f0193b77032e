"""Excludes windows that say nothing about an effect: those whose simulation is lost, or that nothing explains.

One such window among seventy changes a mean error more than most effects do. A window is off if its error is more than
ten times the median. Windows that are off are counted and reported, comparisons leave them out, and fits give them
little weight. If more than a tenth of the windows are off, this is a property of the simulation, and they count.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from cablejax.recordings.gaps import FILLED
from cablejax.spatial.windows import SHORTEST, Windows

_TIMES = 10.0
_MOST = 0.1
_SHOWN = 5
# Part of the samples that may be left out without a word.
_SHORT = 0.01


def off(error: Float[np.ndarray, "W"]) -> Bool[np.ndarray, "W"]:
    """Windows whose error is more than ten times the median, from errors [m]."""
    return error > _TIMES * np.median(error)


def kept(which: Bool[np.ndarray, "W"]) -> Bool[np.ndarray, "W"]:
    """The windows that are not off, or all if those that are off are not few."""
    return ~which if which.mean() <= _MOST else np.ones(len(which), bool)


def moderated(error: Float[np.ndarray, "W"]) -> Float[np.ndarray, "W"]:
    """Errors of which none is more than ten times the median [m]."""
    return np.minimum(error, _TIMES * np.median(error))


def trust(error: Float[np.ndarray, "W"]) -> Float[np.ndarray, "W"]:
    """Weight of each window in a fit: 1 but for few windows that are off, the less the further."""
    weight = (moderated(error) / np.maximum(error, 1e-12)) ** 2
    return np.where(kept(off(error)), 1.0, weight)


def compared(before: Float[np.ndarray, "W"], after: Float[np.ndarray, "W"]) -> tuple[Bool[np.ndarray, "W"], bool]:
    """Windows in which errors with and without a new effect are compared, and whether the comparison counts.

    It does not count where the effect throws off more windows than may be left out that were not off before: nothing is
    known of an effect whose simulations are lost.
    """
    broken = off(after) & ~off(before)
    return kept(off(before) | off(after)), bool(kept(broken)[broken].sum() == 0)


def accident_sentences(
    lost: Bool[np.ndarray, "W"], error: Float[np.ndarray, "W"], windows: Windows, coarse: Bool[np.ndarray, "W"]
) -> list[str]:
    """Sentences on windows that are off, or not simulated properly.

    Args:
        lost: those with samples that the simulation did not reach.
        error: of every window, as the best explanation leaves it [m].
        windows: these.
        coarse: those that were simulated with larger errors of the time steps than these may have.
    """
    result, torn = [], windows.torn
    accidents = lost | off(error) | torn
    treated = (
        "They have little weight in fits, and are excluded from the gap and from comparisons."
        if not kept(accidents)[accidents].any()
        else "They are too many to be excluded, so they count in all figures."
    )
    look = "Check them for jerks of the grippers and jumps of keypoints."
    longest = f"{windows.arclength[-1]:.3g} m"
    for which, words, advice in (
        (
            torn,
            f"have the grippers further apart than the {longest} of cable between them, which would tear it. Leave "
            "those parts out, or correct the arc lengths",
            treated,
        ),
        (
            lost & ~torn,
            "could not be simulated to their end: the equations of motion have no solution there",
            f"{treated} {look}",
        ),
        (
            off(error) & ~lost & ~torn,
            f"are off by more than {_TIMES:g} times the median with every effect that was found",
            f"{treated} {look}",
        ),
        (
            coarse & ~lost & ~torn,
            "have time-step errors above the tolerance, even with the shortest time steps",
            "They count in all figures. " + look,
        ),
    ):
        if which.any():
            index = np.flatnonzero(which)
            shown = ", ".join(_window(windows, i, float(error[i]), torn=bool(torn[i])) for i in index[:_SHOWN])
            more = f" and {len(index) - _SHOWN} more" if len(index) > _SHOWN else ""
            result.append(f"{len(index)} of {len(windows)} windows {words}: file {shown}{more}. {advice}")
    if windows.short > _SHORT:
        result.append(
            f"{100 * windows.short:.0f} % of the samples are in episodes, or ends of episodes, shorter than "
            f"{SHORTEST:g} s, and were left out."
        )
    if windows.left_out:
        count = len(windows.left_out)
        more = f" and {count - _SHOWN} more" if count > _SHOWN else ""
        result.append(
            f"{count} more windows were left out, since none of their seconds begins with two samples of all keypoints "
            f"(gaps of up to {FILLED:g} s are filled), or too little is observed later: "
            f"{', '.join(windows.left_out[:_SHOWN])}{more}."
        )
    return result


def _window(windows: Windows, index: int, error: float, *, torn: bool) -> str:
    """File and time of a window, and how far it is off, or the grippers apart at their furthest."""
    begin = windows.begin[index] * windows.interval
    if not torn:
        return f"{windows.name[index]} from {begin:.3g} s ({1e3 * error:.0f} mm)"
    apart = np.nan_to_num(windows.apart[index])
    at = int(apart.argmax())
    return f"{windows.name[index]} at {begin + at * windows.interval:.3g} s ({apart[at]:.3g} m)"
