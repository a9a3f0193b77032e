"""The page of a study: what each round recorded, and the verdict after it."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from cablejax.diagnose.diagnosis import Diagnosis
from cablejax.diagnose.judgement import effect_title, listed, share
from cablejax.diagnose.study import ENDED, Ended, alternatives
from cablejax.effects.given import GivenEffect
from cablejax.limits import counted
from cablejax.report.effect_words import error_falls, millimetres
from cablejax.report.sheet import Sheet
from cablejax.report.style import DIAGNOSIS_STYLE, LIGHT, draw_bars

_SHOWN = 5
_VERDICTS = {
    "none": "no gap",
    "named": "named",
    "ambiguous": "narrowed down",
    "named+unknown": "part of it named",
    "unknown": "unknown",
}


def study_sheet(
    found: Sequence[Diagnosis], motions: Sequence[Sequence[str]], why: Ended, staged: Sequence[GivenEffect]
) -> Sheet:
    """The page of a study that has ended.

    Args:
        found: the diagnosis of each round.
        motions: recorded in each round.
        why: it ended.
        staged: effects of the plant.
    """
    last, rounds = found[-1], len(found)
    none = last.verdict == "none"
    names = _causes(last)
    ranked = any(chance is not None for one in found for chance in _chances(one).values())
    pictures = [(_beliefs(found), "Probability of each cause after each round, given all recordings so far.")]
    return Sheet(
        kind="study",
        title=f"After {counted(rounds, 'recording')}: {names}",
        lead=f"{ENDED[why]} {last.sentence}",
        cards=[
            ("Verdict", _VERDICTS[last.verdict] if why != "clear" or none else "named", "" if none else names),
            ("Recorded", f"{sum(map(len, motions))} motions", f"in {counted(rounds, 'round')}"),
            ("Error", _error(last), "without and with what is named" if last.effects else "nothing is named"),
            (
                "Staged in the plant",
                listed([effect_title(effect.name) for effect in staged]) or "nothing",
                f"{', '.join(map(str, staged))}. The diagnosis was not given this." if staged else "",
            ),
        ],
        figures=pictures if ranked else [],
        tables=[
            (
                "Rounds",
                ("round", "recorded", "left open", "error without and with the cause", "page"),
                [_row(k, one, done) for k, (one, done) in enumerate(zip(found, motions, strict=True), 1)],
            )
        ],
        following=(
            *(
                [
                    "Simulate with the named effects, in this folder: cablejax simulate --with "
                    f"round_{rounds}/verdict.json"
                ]
                if last.effects
                else []
            ),
            *([f"What each recording added: round_{rounds}/report.html"] if rounds > 1 else []),
        ),
        facts={"time of the diagnoses": f"{sum(one.seconds for one in found):.0f} s"},
    )


def _row(number: int, found: Diagnosis, motions: Sequence[str]) -> tuple[str, ...]:
    return (
        str(number),
        listed([name.replace("_", " ") for name in motions]),
        _causes(found),
        _error(found),
        Markup('<a href="round_{}/report.html">diagnosis</a>').format(number),
    )


def _error(found: Diagnosis) -> str:
    """The error without and with what is named; one number where nothing is."""
    return error_falls(found.gap) if found.effects else millimetres(found.gap.before_rmse_mm)


def _causes(found: Diagnosis) -> str:
    """What is named, and what could be in the place of each: "a or b" of one effect, "a (or b) and c" of two."""
    named = [[effect_title(name) for name in names] for names in alternatives(found)]
    if not named:
        return "undecided" if found.undecided else _VERDICTS[found.verdict]
    if len(named) < 2:
        return listed(named[0], "or")
    return listed([f"{name} (or {listed(others, 'or')})" if others else name for name, *others in named])


def _chances(found: Diagnosis) -> dict[str, float | None]:
    """The probability of each cause: in its place where an effect is named, else if it were the only one.

    How good single effects are says nothing of two that act together.
    """
    named = {
        name: chance for one in found.effects for name, chance in ({one.name: one.probability} | one.alike).items()
    }
    single = {entry.name: entry.probability for entry in found.ranking}
    return named if len(alternatives(found)) > 1 else single | named


def _beliefs(found: Sequence[Diagnosis]) -> Figure:
    """Bars of the probabilities of the causes by round."""
    chances = [{name: chance or 0.0 for name, chance in _chances(one).items()} for one in found]
    best = {name: max(c.get(name, 0.0) for c in chances) for name in set().union(*chances)}
    names = sorted(best, key=lambda name: (-best[name], name))[:_SHOWN]
    with matplotlib.rc_context(DIAGNOSIS_STYLE):
        figure = Figure(figsize=(9.0, 0.9 + 0.34 * len(names) * len(found)), layout="constrained")
        axes = np.atleast_1d(figure.subplots(len(found), 1, sharex=True))
        for number, (ax, chance) in enumerate(zip(axes, chances, strict=True), 1):
            values = [chance.get(name, 0.0) for name in names]
            draw_bars(ax, list(map(effect_title, names)), values, list(map(share, values)), LIGHT.residual, 1.0)
            ax.set_title(f"after round {number}")
        axes[-1].set_xlabel("probability, if the cause is one of those tried")
    return figure
