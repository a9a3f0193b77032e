"""The rule by which every diagnosis names a cause, and the sentence that says so."""

from __future__ import annotations

from collections.abc import Sequence

from cablejax.diagnose.diagnosis import NamedEffect, Verdict


def judged(*, resolvable: bool, telling: bool, complete: bool, alike: bool) -> Verdict:
    """The verdict on an explanation of a gap.

    Args:
        resolvable: whether there is a gap above what noise and simulator may be off by.
        telling: whether enough of the gap goes away to name the explanation. In the plane that is a share calibrated
            on labelled logs. Where there are none, in space and for hanging wires, it is a shrinkage on unseen data
            whose 90 % interval excludes zero.
        complete: whether what is left of the gap needs no other cause, see `Calibration.complete`.
        alike: whether other effects explain the log as well.
    """
    if not resolvable:
        return "none"
    if not telling:
        return "unknown"
    if not complete:
        return "named+unknown"
    return "ambiguous" if alike else "named"


def sentence(
    verdict: Verdict, effects: Sequence[NamedEffect], equivalent: Sequence[Sequence[str]], explained: float
) -> str:
    """The verdict in words.

    Args:
        verdict: to put into words.
        effects: named.
        equivalent: sets of effects that the log cannot tell apart.
        explained: share of the squared gap that the best explanation takes away; a negative one reads as none.
    """
    share = f"{100 * max(explained, 0.0):.0f} %"
    names = " and ".join(e.name.replace("_", " ") for e in effects)
    alike = "; ".join(" or ".join(n.replace("_", " ") for n in group) for group in equivalent)
    rivals = f" (this log cannot tell apart: {alike})" if alike else ""
    return {
        "none": "The simulator explains this log within what the noise and its own resolution allow.",
        "named": f"The gap comes from {names}, which explains {share} of it.",
        "ambiguous": f"The gap comes from {names} or a look-alike, which this log cannot tell apart: {alike}.",
        "named+unknown": (
            f"Part of the gap, {share}, is explained by {names}{rivals}; the rest by no effect of the library."
        ),
        "unknown": f"The gap has a cause that is not in the library: the best explanation takes away {share} of it.",
    }[verdict]
