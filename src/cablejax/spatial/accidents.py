"""Windows that say nothing about an effect: those whose simulation is lost, and those that nothing explains.

One of them among seventy moves a mean error more than most effects do. A window is off where its error is more than ten
times the median. Windows that are off are counted and shown, comparisons leave them out, and fits give them little
weight, as long as they are few: where more than a tenth of the windows are off, that is a property of the simulation,
and counts.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from cablejax.spatial.windows import Windows

_TIMES = 10.0
_MOST = 0.1
_SHOWN = 5


def off(error: Float[np.ndarray, "W"]) -> Bool[np.ndarray, "W"]:
    """Windows that are off, by their errors [m]."""
    return error > _TIMES * np.median(error)


def kept(which: Bool[np.ndarray, "W"]) -> Bool[np.ndarray, "W"]:
    """The other windows, or all where those are not few."""
    return ~which if which.mean() <= _MOST else np.ones(len(which), bool)


def moderated(error: Float[np.ndarray, "W"]) -> Float[np.ndarray, "W"]:
    """Errors of which none is more than ten times the median [m]."""
    return np.minimum(error, _TIMES * np.median(error))


def trust(error: Float[np.ndarray, "W"]) -> Float[np.ndarray, "W"]:
    """Weight of each window in a fit: 1 but for few windows that are off, the less the further."""
    weight = (moderated(error) / np.maximum(error, 1e-12)) ** 2
    return np.where(kept(off(error)), 1.0, weight)


def compared(before: Float[np.ndarray, "W"], after: Float[np.ndarray, "W"]) -> tuple[Bool[np.ndarray, "W"], bool]:
    """Windows in which errors before and after an effect came in are compared, and whether the comparison counts.

    It does not count where the effect throws off more windows than may be left out that were not off before: nothing is
    known of an effect whose simulations are lost.
    """
    broken = off(after) & ~off(before)
    return kept(off(before) | off(after)), bool(kept(broken)[broken].sum() == 0)


def accident_sentences(lost: Bool[np.ndarray, "W"], error: Float[np.ndarray, "W"], windows: Windows) -> list[str]:
    """Windows that are off, for a reader.

    Args:
        lost: those with samples that the simulation did not reach.
        error: of every window, as the best explanation leaves it [m].
        windows: these.
    """
    result, without = [], kept(lost | off(error))
    treated = (
        "They have little weight in fits, and are left out of the gap and of comparisons."
        if not without[lost | off(error)].any()
        else "They are too many to be left out, and count in all figures."
    )
    for which, words in (
        (lost, "could not be simulated to their end: the equations of motion have no solution there"),
        (off(error) & ~lost, f"are off by more than {_TIMES:g} times the median with every effect that was found"),
    ):
        if which.any():
            index = np.flatnonzero(which)
            shown = ", ".join(
                f"{windows.name[i]} from {windows.begin[i] * windows.interval:.3g} s ({1e3 * error[i]:.0f} mm)"
                for i in index[:_SHOWN]
            )
            more = f" and {len(index) - _SHOWN} more" if len(index) > _SHOWN else ""
            result.append(
                f"{len(index)} of {len(windows)} windows {words}: file {shown}{more}. {treated} Look for jerks of the "
                "grippers and jumps of keypoints there."
            )
    return result
