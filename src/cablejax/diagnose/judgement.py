"""The rule by which every diagnosis names a cause, and the sentence of its verdict."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from cablejax.diagnose.diagnosis import NamedEffect, Verdict

_CONFIRMED = 0.5
"""Share of the squared gap that has to go away on motions left out of the fit."""


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


def beside_unknown(effect: NamedEffect, causes: float | None) -> NamedEffect:
    """A named effect of an incomplete explanation, less probable: the missing part may be the cause that it resembles.

    Args:
        effect: with its probability among those of the library.
        causes: see `Simulator.beside_unknown`.
    """
    if causes is None or effect.probability is None:
        return dataclasses.replace(effect, probability=None, alike={})
    alike = {name: causes * chance for name, chance in effect.alike.items()}
    return dataclasses.replace(effect, probability=causes * effect.probability, alike=alike)


FAINT = 0.01
"""Probability below which a look-alike is not listed with the named effect."""


def look_alikes(group: Sequence[str], effects: Sequence[NamedEffect]) -> tuple[list[str], list[str]]:
    """Members of a set of look-alikes: the probable ones, and those that merely leave as little of the gap."""
    chances = next((effect.alike for effect in effects if effect.name in group), {})
    faint = [name for name in group if chances.get(name, 1.0) < FAINT]
    return [name for name in group if name not in faint], faint


def in_its_place(name: str, equivalent: Sequence[Sequence[str]], effects: Sequence[NamedEffect]) -> list[str]:
    """A named effect, followed by the effects that could replace it and are not improbable."""
    group = next((names for names in equivalent if name in names), ())
    return [name, *(other for other in look_alikes(group, effects)[0] if other != name)]


def verdict_sentence(
    verdict: Verdict,
    effects: Sequence[NamedEffect],
    equivalent: Sequence[Sequence[str]],
    explained: float,
    shrinkage: float | None = None,
) -> str:
    """The verdict in words.

    Args:
        verdict: to put into words.
        effects: named.
        equivalent: sets of effects that are indistinguishable on the log.
        explained: share of the squared gap that the best explanation takes away.
        shrinkage: the same on motions left out of the fit; None where none could be.
    """
    # what acts in one motion alone cannot be found from the others
    fitted_only = verdict in ("named", "ambiguous") and shrinkage is not None and shrinkage < _CONFIRMED
    gone = _spelled(max(explained if shrinkage is None or fitted_only else shrinkage, 0.0))
    distinct = list(dict.fromkeys(effect_title(e.name) for e in effects))
    names = listed(distinct)
    split = [look_alikes(group, effects) for group in equivalent]
    alike = "; ".join(listed([*map(effect_title, likely)], "or") for likely, _ in split if len(likely) > 1)
    faint = listed([effect_title(name) for _, members in split for name in members])
    explains = "which explains" if len(distinct) == 1 else "which together explain"
    rivals = f" (this log cannot tell apart: {alike})" if alike else ""
    too = (
        f" {faint[:1].upper()}{faint[1:]} would leave as little of the gap, but with a probability below 1 %."
        if faint
        else ""
    )
    either = f" or a look-alike, which this log cannot tell apart: {alike}" if alike else ""
    better = shrinkage is None or shrinkage > 0
    best = (
        f"the best explanation removes {gone} of it"
        if better
        else "on motions left out of the fit, the best explanation predicts no better than the nominal simulator"
    )
    said = {
        "none": "The simulator explains this log to within the noise and its own resolution.",
        "named": f"The gap comes from {names}, {explains} {gone} of it.",
        "ambiguous": f"The gap comes from {names}{either}.{too}",
        "named+unknown": (
            f"Part of the gap, {gone}, looks like {names}{rivals}; the rest resembles no effect of the library.{too}"
        ),
        "unknown": f"No effect of the library explains the gap: {best}.",
    }[verdict]
    if not fitted_only:
        return said
    confirmed = _spelled(max(shrinkage or 0.0, 0.0))
    again = "Repeat the motions in which the gap shows."
    return f"{said} This is unconfirmed: on motions left out of the fit, it explains {confirmed}. {again}"


def share(value: float) -> str:
    """A share in per cent; never 0 or 100 where it is only close."""
    percent = 100 * value
    if percent > 99:
        return "> 99 %"
    if 0 < percent < 1:
        return "< 1 %"
    return "0 %" if -0.5 <= percent <= 0 else f"{percent:.0f} %"


def _spelled(value: float) -> str:
    return share(value).replace("> ", "more than ").replace("< ", "less than ")


def listed(words: Sequence[str], last: str = "and") -> str:
    """Joins words as in "a, b and c"."""
    return "" if not words else words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}"


def effect_title(name: str) -> str:
    """The name of an effect as words."""
    return name.replace("_", " ")
