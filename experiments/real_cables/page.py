"""Page and figure of the errors on real cables, for any number of cables."""

from __future__ import annotations

import csv
import dataclasses
import math
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from pages import markdown_table

_NINETY = 1.645
_PANELS = 3
# Methods of the table that are drawn as lines: its first ones.
_DRAWN = ("-", ":")
_TITLES = {"rod": "rod with all effects, fitted together"}
_NONE = "-"
# Sentences on repairs of a cable that are shown.
_SHOWN = 8

Published = Mapping[str, Mapping[str, float]]
"""Error of each method [mm], by cable."""


def read_published(path: pathlib.Path) -> Published:
    """Published errors from a table: a line for each method, a column for each cable, an empty cell = not published.

    Raises:
        ValueError: no column `method`, or a cell that is no number.
    """
    with path.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    if rows and "method" not in rows[0]:
        raise ValueError(f"{path} has the columns {', '.join(rows[0])}, expected method and one for each cable.")
    try:
        return {
            row["method"]: {cable: float(cell) for cable, cell in row.items() if cable != "method" and cell}
            for row in rows
        }
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path} has a cell that is no number of millimetres: {error}.") from None


def errors_figure(scores: Mapping[str, Any], published: Published, path: pathlib.Path) -> None:
    """One panel for each cable: the error by recording after every step, and published errors as lines."""
    columns = min(len(scores), _PANELS)
    rows = -(-len(scores) // columns)
    with matplotlib.rc_context({"axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(max(4.0 * columns, 6.0), 4.2 * rows), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for (cable, score), ax in zip(scores.items(), axes, strict=False):
        stages = [(name, unseen) for name, unseen, _ in score["stages"]]
        learned = [(name.replace("rod + ", "+ "), unseen["mean"]) for name, unseen, *_ in score["learned"]]
        stages += [("all effects together", learned[0][1]), *learned[1:]]
        names, values = [s[0].replace("_", " ") for s in stages], [s[1] for s in stages]
        ax.barh(range(len(values)), values, color="#0072b2", tick_label=names)
        for y, value in enumerate(values):
            right = value + 0.02 * max(values)
            ax.text(right, y, f"{value:.1f}", va="center", fontsize=9, bbox={"color": "white", "pad": 0.5})
        for (method, errors), style in zip(published.items(), _DRAWN, strict=False):
            if cable in errors:
                ax.axvline(errors[cable], color="#d55e00", ls=style, label=method)
        ax.invert_yaxis()
        ax.set_xlim(0, 1.15 * max(values))
        ax.set_title(cable)
        ax.set_xlabel("error by recording [mm]")
    for ax in axes[len(scores) :]:
        ax.remove()
    lines = {
        text: line for ax in axes[: len(scores)] for line, text in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    if lines:
        figure.legend(lines.values(), lines.keys(), loc="outside upper center", ncols=2, frameon=False)
    figure.savefig(path, dpi=130)


@dataclasses.dataclass(frozen=True)
class Notes:
    """What was found in recordings before they were scored.

    Attributes:
        repairs: sentences on the repairs, by cable.
        refused: why a cable is not scored, by its name.
    """

    repairs: Mapping[str, Sequence[str]] = dataclasses.field(default_factory=dict)
    refused: Mapping[str, str] = dataclasses.field(default_factory=dict)


def page(scores: Mapping[str, Any], published: Published, picture: str, made: str, notes: Notes = Notes()) -> str:
    """The page in Markdown.

    Args:
        scores: fields of a `CableScore` by cable.
        published: by `read_published`.
        picture: path of the figure, from the page.
        made: versions and machine, see `rows.made_on`.
        notes: on the recordings.
    """
    every, scored = list(scores), [cable for cable in scores if scores[cable]["learned"][0][2] is not None]
    learned = [name for name, *_ in scores[every[0]]["learned"]]
    # by recordings that were not learned from, never by eval
    best = min(range(len(learned)), key=lambda i: sum(scores[c]["learned"][i][1]["mean"] for c in every))
    lengths = ", ".join(sorted({f"{score['length']:.3g} s" for score in scores.values()}))
    lines = [
        "# Real cables: a whole window ahead, open loop",
        "",
        f"Mean absolute error of a coordinate over all markers in millimetres, the grasped ones counted as 0, from the "
        f"third sample of each window to its end ({lengths}): the number of Chen et al. (CoRL 2024, arXiv 2406.05931). "
        "In a mean over windows, no window counts for more than ten times the median. The tables state how many "
        "windows exceed this, and how many could not be simulated to their end; if there are any, the plain mean is in "
        "brackets.",
        "",
        "## By recording",
        "",
        "Both halves of the recordings, without upstream's eval split, are fitted separately, with the learned "
        "corrections, and every window is scored with the fit to the other half.",
        "",
        *_by_recording(scores, learned, best),
        "",
        "Bold, in both tables: the best one by recording, over all cables.",
        "",
        f"![Error of every step]({picture})",
        "",
        *_about_stiffness(),
        "",
    ]
    if scored:
        lines += [
            "## Upstream's eval split",
            "",
            *_on_eval({c: scores[c] for c in scored}, published, learned, best),
            "",
        ]
    lines += [*_step_by_step(scores), *_left_out(scores)]
    lines += [
        "One procedure with one set of constants for all cables. Ridge residual and graph network read the clamps' "
        "history of 0.4 s and the simulated markers, in a frame that moves with the clamps; regularisation, number of "
        "products, size and rounds of training are chosen by cross-validation over training recordings. The "
        "ridge on top of the graph network is fitted to markers that were corrected by networks trained on other "
        "recordings.",
        "",
        *_noted(notes),
        "---",
        "",
        f"Made by `python experiments/30_real_cables.py --data DEFORM`. {made}",
        "",
    ]
    return "\n".join(lines)


def _row(name: str, values: Sequence[str]) -> list[str]:
    return [name, *values]


def _error(errors: Mapping[str, Any]) -> str:
    plain = f" ({errors['plain']:.1f})" if errors["off"] else ""
    return f"{errors['mean']:.1f}{plain}"


def _learned_rows(scores: Mapping[str, Any], learned: Sequence[str], best: int, column: int) -> list[list[str]]:
    """Errors of the rod and of what is learned on it, and how many windows are off."""
    rows = []
    for i, name in enumerate(learned):
        mark = "**" if i == best else ""
        values = [f"{mark}{_error(score['learned'][i][column])}{mark}" for score in scores.values()]
        rows.append(_row(f"{mark}{_TITLES.get(name, name)}{mark}", values))
    for i in sorted({0, best}):
        counts = (score["learned"][i][column] for score in scores.values())
        rows.append(
            _row(
                f"windows lost / off by ten times the median, of all: {learned[i]}",
                [f"{c['lost']} / {c['off'] - c['lost']} of {c['windows']}" for c in counts],
            )
        )
    return rows


def _unsimulated_rows(scores: Mapping[str, Any], column: int) -> list[list[str]]:
    names = [name for name, *_ in next(iter(scores.values()))["unsimulated"]]
    return [
        _row(name, [_error(score["unsimulated"][i][column]) for score in scores.values()])
        for i, name in enumerate(names)
    ]


def _by_recording(scores: Mapping[str, Any], learned: Sequence[str], best: int) -> list[str]:
    def pick(key: Callable[[Any], Any], form: str) -> list[str]:
        return [form.format(key(score)) for score in scores.values()]

    halves = ("one half", "the other half")
    rows = [
        ["", *scores],
        _row(
            "nominal simulator: length from the markers, textbook EI/rho, no damping, no drag",
            pick(lambda s: s["stages"][0][1], "{:.1f}"),
        ),
        *_unsimulated_rows(scores, 1),
        *_learned_rows(scores, learned, best, 1),
        *(
            _row(
                f"EI/rho from {half} of the recordings, 90 % interval [m^4/s^2]",
                pick(lambda s, k=k: s["estimated"][k], "{0[0]:.4f} ({0[1]:.4f} to {0[2]:.4f})"),
            )
            for k, half in enumerate(halves)
        ),
        _row("ratio of the two", pick(lambda s: _ratio(*(value for value, _, _ in s["estimated"])), "{:.2f}")),
        _row(
            "their difference, in its standard errors from both intervals",
            pick(lambda s: _standard_errors_apart(s["estimated"]), "{:.2f}"),
        ),
        _row("graph network of one half: size, rounds", pick(lambda s: s["networks"][-2], "{0[0]}, {0[1]}")),
        _row("one rollout, median [s]", pick(lambda s: s["seconds"][0], "{:.3f}")),
        _row("all windows in batches [s]", pick(lambda s: s["seconds"][1], "{:.2f}")),
    ]
    return markdown_table(rows)


def _about_stiffness() -> list[str]:
    return [
        "rho is the mass per length of the cable with its markers. EI/rho is estimated together with every other "
        "effect ([coverage](fresh_cables.md) on synthetic cables). The halves are different recordings of one cable: "
        f"if both intervals are right, the estimates differ by less than {_NINETY:g} standard errors on nine cables "
        "of ten. An error that both halves share does not show here; the intervals of a diagnosis are wider, by an "
        "allowance for cables that the fitted law does not cover."
    ]


def _on_eval(scores: Mapping[str, Any], published: Published, learned: Sequence[str], best: int) -> list[str]:
    counts = ", ".join(
        f"{s['learned'][0][2]['windows']} of {s['learned'][0][1]['windows'] + s['learned'][0][2]['windows']} for {c}"
        for c, s in scores.items()
    )
    compared = [(method, [errors.get(cable) for cable in scores]) for method, errors in published.items()]
    rows = [
        ["", *scores],
        *(
            _row(method, [_NONE if value is None else f"{value:.1f}" for value in values])
            for method, values in compared
            if any(value is not None for value in values)
        ),
        _row("nominal simulator", [f"{score['stages'][0][2]:.1f}" for score in scores.values()]),
        *_unsimulated_rows(scores, 2),
        *_learned_rows(scores, learned, best, 2),
        _row(
            "rod, every recording with the mean of how the grippers hold the cable",
            [_error(score["without_own"]) for score in scores.values()],
        ),
        _row(
            f"spread of {learned[best]} over the drawing of windows, 5 % to 95 %",
            ["{0[0]:.1f} to {0[1]:.1f}".format(score["learned"][best][3]) for score in scores.values()],
        ),
    ]
    return [
        "Every sample of each window is scored, with the fit to all other recordings' windows. Upstream's choice of "
        "files is theirs; nothing was chosen by looking at it.",
        "",
        *markdown_table(rows),
        "",
        "The grip is fitted for each recording: an eval window takes it from the other windows of its own recording, "
        "where there are any; the row with the mean does not use it. Upstream's split is easier than the split by "
        "recording, since it has windows of both splits in the same recording. The row of the spread shows how much "
        f"the choice of files matters: as many windows as eval has ({counts}) are drawn from all with replacement, as "
        "upstream draws its files. Eval windows count with their error in this table, the others with their error in "
        "the split by recording.",
    ]


def _step_by_step(scores: Mapping[str, Any]) -> list[str]:
    lines = [
        "## Step by step",
        "",
        "Unseen: from the half of the recordings that the fit has not seen. Eval: the same step, mean over the fits to "
        "either half.",
        "",
    ]
    for cable, score in scores.items():
        evaluated = score["stages"][0][2] is not None
        rows = [["step", "unseen [mm]", *(["eval [mm]"] if evaluated else [])]]
        for name, unseen, scored in score["stages"]:
            rows.append([name.replace("_", " "), f"{unseen:.1f}", *([f"{scored:.1f}"] if evaluated else [])])
        lines += [f"### {cable}", "", *markdown_table(rows), ""]
    return lines


def _left_out(scores: Mapping[str, Any]) -> list[str]:
    sentences = [
        f"{len(score['left_out'])} of {cable}'s blocks do not begin with two samples of all markers and are left "
        f"out: {', '.join(score['left_out'])}."
        for cable, score in scores.items()
        if score["left_out"]
    ]
    return [" ".join(sentences), ""] if sentences else []


def _noted(notes: Notes) -> list[str]:
    refused = [f"- {cable} is not scored. {reason}" for cable, reason in notes.refused.items()]
    repairs = [
        f"- {cable}: {' '.join(sentences[:_SHOWN])}"
        + (f" And {len(sentences) - _SHOWN} more." if len(sentences) > _SHOWN else "")
        for cable, sentences in notes.repairs.items()
        if sentences
    ]
    if not refused + repairs:
        return []
    return ["## Recordings", "", *refused, *repairs, ""]


def _ratio(one: float, other: float) -> float:
    return max(one, other) / min(one, other)


def _standard_errors_apart(estimated: Sequence[Sequence[float]]) -> float:
    """Difference of the halves' log EI/rho, every effect free, over its standard error.

    Half the width of a 90 % interval counts as 1.645 standard errors. It is in part Student's, with as many degrees of
    freedom as the half has recordings less one, so the standard error comes out a little large.
    """
    errors = [math.log(high / low) / 2 / _NINETY for _, low, high in estimated]
    return math.log(_ratio(*(value for value, _, _ in estimated))) / math.hypot(*errors)
