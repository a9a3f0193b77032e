"""The page of a study: what each round recorded, and what was believed after it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from cablejax.diagnose.study import ENDED, Ended, left_open
from cablejax.report.diagnosis_style import STYLE
from cablejax.report.effect_words import effect_title, listed, share
from cablejax.report.sheet import Sheet
from cablejax.report.style import LIGHT

_SHOWN = 5
_VERDICTS = {
    "none": "no gap",
    "named": "named",
    "ambiguous": "narrowed down",
    "named+unknown": "part of it named",
    "unknown": "unknown",
}


def study_sheet(
    verdicts: Sequence[Mapping[str, Any]], motions: Sequence[Sequence[str]], why: Ended, staged: str
) -> Sheet:
    """The page of a study that has ended.

    Args:
        verdicts: of each round, as `verdict_json` writes them.
        motions: recorded in each round.
        why: it ended.
        staged: effects of the plant, in words.
    """
    last, recordings = verdicts[-1], len(verdicts)
    names = listed([effect_title(name) for name in left_open(last)], "or") or _VERDICTS[last["verdict"]]
    seconds = sum(verdict["seconds"] for verdict in verdicts)
    gap = last["gap"]
    ranked = any(entry["probability"] is not None for verdict in verdicts for entry in verdict["ranking"])
    return Sheet(
        kind="study",
        title=f"After {recordings} recording{'s' if recordings > 1 else ''}: {names}",
        lead=f"{ENDED[why]} {last['sentence']}",
        cards=[
            ("Verdict", _VERDICTS[last["verdict"]], names),
            ("Recorded", f"{sum(map(len, motions))} motions", f"in {recordings} rounds"),
            (
                "Error",
                f"{1e3 * gap['before_rmse']:.1f} → {1e3 * gap['after_rmse']:.1f} mm",
                "without and with the cause",
            ),
            ("Staged in the plant", staged, "which no diagnosis was told"),
        ],
        figures=[(_beliefs(verdicts), "How probable each cause was after each round, all recordings together.")]
        if ranked
        else [],
        tables=[
            (
                "Rounds",
                ("round", "recorded", "verdict", "left open", "error without, with the cause", "page"),
                [_row(k, verdict, done) for k, (verdict, done) in enumerate(zip(verdicts, motions, strict=True), 1)],
            )
        ],
        following=(
            f"Simulate with what was named: cablejax simulate --with round_{recordings}/verdict.json",
            "See what each recording added: the page of the last round.",
        ),
        facts={"time of the diagnoses": f"{seconds:.0f} s"},
    )


def _row(number: int, verdict: Mapping[str, Any], motions: Sequence[str]) -> tuple[str, ...]:
    gap = verdict["gap"]
    return (
        str(number),
        listed([name.replace("_", " ") for name in motions]),
        _VERDICTS[verdict["verdict"]],
        listed([effect_title(name) for name in left_open(verdict)]) or "nothing",
        f"{1e3 * gap['before_rmse']:.1f}, {1e3 * gap['after_rmse']:.1f} mm",
        Markup('<a href="round_{}/report.html">diagnosis</a>').format(number),
    )


def _beliefs(verdicts: Sequence[Mapping[str, Any]]) -> Figure:
    """Bars of the probabilities of the causes by round."""
    chances = [{entry["name"]: entry["probability"] or 0.0 for entry in v["ranking"]} for v in verdicts]
    best = {name: max(c.get(name, 0.0) for c in chances) for name in set().union(*chances)}
    names = sorted(best, key=lambda name: -best[name])[:_SHOWN]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 0.9 + 0.34 * len(names) * len(verdicts)), layout="constrained")
        axes = np.atleast_1d(figure.subplots(len(verdicts), 1, sharex=True))
        for number, (ax, chance) in enumerate(zip(axes, chances, strict=True), 1):
            values = [chance.get(name, 0.0) for name in names]
            ax.barh(range(len(names)), values, color=LIGHT.residual, height=0.65)
            for y, value in enumerate(values):
                ax.text(value + 0.01, y, share(value), va="center", color=LIGHT.muted)
            ax.set_yticks(range(len(names)), [effect_title(name) for name in names])
            ax.invert_yaxis()
            ax.set(xlim=(0.0, 1.12), title=f"after round {number}")
        axes[-1].set_xlabel("probability, were the cause one of those tried")
    return figure
