"""The page and the figures of the blind check."""

from __future__ import annotations

import pathlib

import numpy as np

from pages import markdown_table

from .measures import Row, baselines, outcome, reliability, severe_singles, table
from .verdicts import Scored

FAMILIES = {
    "AB": "simulators that share no code with the one that diagnoses",
    "A": "rod in node coordinates",
    "B": "PyElastica",
    "C": "MuJoCo with contact, a cousin of the diagnosing simulator",
    "D": "PyElastica in space: the cable sags from the grippers, and friction is not regularised",
}


def write_page(cases: list[Scored], path: pathlib.Path, command: str) -> None:
    """Markdown at `path`, figures beside it; `command` is what makes it."""
    figure = path.with_name(path.stem + "_confusion.png")
    curve = path.with_name(path.stem + "_reliability.png")
    _confusion_figure(cases, figure)
    _reliability_figure(cases, curve)
    missing = [case.name for case in cases if case.verdict is None]
    kinds = {kind: sum(case.kind == kind for case in cases) for kind in ("none", "single", "pair", "unknown")}
    parts = [
        "# Blind check of the diagnosis",
        f"Made by `{command}`; logs by `20_blind_generate.py`, verdicts by `21_blind_diagnose.py`. What the numbers "
        "mean, and what was seen only afterwards: docs/results/diagnosis.md.",
        f"{len(cases)} cases: {kinds['none']} without effect, {kinds['single']} single effects, {kinds['pair']} pairs, "
        f"{kinds['unknown']} effects outside the library; {len(missing)} without a verdict, which count as failures. "
        "Labels fit the hashes published before. Rates have their exact 90 % interval. A case counts from severity 4 "
        "on (gap over noise, nearest of 1, 2, 4, 8) and where its effect leaves a trace. A twin is another effect that "
        "reproduces the log within 0.7 of the noise in the simulator that made it.",
        "## All families",
        _rows(table(cases)),
        "## Baselines",
        _markdown(["method", "top-1", "one of a pair", "names without an effect"], baselines(cases)),
        "## By family",
    ]
    for letters, said in FAMILIES.items():
        mine = [case for case in cases if case.family in letters]
        if mine and len(mine) < len(cases):
            parts += [f"### {' and '.join(letters)}: {said} ({len(mine)} cases)", _rows(table(mine))]
    parts += [
        "## By effect and severity", _by_effect(cases),
        "## What was said", f"![confusion]({figure.name})", _confusion_table(cases),
        "## Reliability of the first name's probability", f"![reliability]({curve.name})",
        _markdown(
            ["mean probability", "right", "cases"],
            [(f"{p:.2f}", f"{100 * hit:.0f} %", str(count)) for p, hit, count in reliability(cases)],
        ),
        "## Cases", _case_list(cases),
    ]  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n\n".join(parts) + "\n")


def _rows(rows: list[Row]) -> str:
    mark = {True: "yes", False: "**no**", None: ""}
    return _markdown(
        ["measure", "value", "must reach", "goal", "reached"],
        [(row.measure, row.value, row.wanted, row.goal, mark[row.reached]) for row in rows],
    )


def _by_effect(cases: list[Scored]) -> str:
    """First name right / inside the reported set / number, by severity; traceless cases in a column of their own."""
    named = sorted({case.truth[0] for case in cases if case.kind in ("single", "unknown")})
    rows = []
    for name in named:
        cells = [name]
        mine = [case for case in cases if case.kind in ("single", "unknown") and case.truth[0] == name]
        for severity in (1, 2, 4, 8):
            cells.append(_cell([case for case in mine if case.severity == severity and not case.traceless]))
        cells.append(_cell([case for case in mine if case.traceless]))
        rows.append(tuple(cells))
    return (
        "Right first name / true name in the reported set / cases; for effects outside the library: said unknown.\n\n"
        + _markdown(["effect", "1", "2", "4", "8", "traceless"], rows)
    )


def _cell(cases: list[Scored]) -> str:
    if not cases:
        return ""
    if cases[0].kind == "unknown":
        return f"{sum(case.says_unknown for case in cases)}/{len(cases)}"
    first, inside = (
        sum(hits) for hits in zip(*((c.top == c.truth[0], c.truth[0] in c.reported) for c in cases), strict=True)
    )
    return f"{first}/{inside}/{len(cases)}"


def _matrix(cases: list[Scored]) -> tuple[list[str], list[str], np.ndarray]:
    """True effects (severity 4 on) by what was said first."""
    used = severe_singles(cases) + [c for c in cases if c.kind == "none"]
    used += [c for c in cases if c.kind == "unknown" and c.severity >= 4]
    truth = {c.name: c.kind if c.kind in ("none", "unknown") else c.truth[0] for c in used}
    rows = sorted({name for name in truth.values() if name not in ("none", "unknown")})
    rows += [name for name in ("unknown", "none") if name in truth.values()]
    said = {outcome(c) for c in used}
    columns = rows + sorted(said - set(rows))
    counts = np.zeros((len(rows), len(columns)), int)
    for case in used:
        counts[rows.index(truth[case.name]), columns.index(outcome(case))] += 1
    return rows, columns, counts


def _confusion_table(cases: list[Scored]) -> str:
    rows, columns, counts = _matrix(cases)
    lines = [
        (name, ", ".join(f"{columns[j]} {counts[i, j]}" for j in np.argsort(-counts[i], kind="stable") if counts[i, j]))
        for i, name in enumerate(rows)
    ]
    return _markdown(["true, severity 4 on", "said first, with the number of cases"], lines)


def _confusion_figure(cases: list[Scored], path: pathlib.Path) -> None:
    from matplotlib.figure import Figure

    rows, columns, counts = _matrix(cases)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(2.5 + 0.36 * len(columns), 2.5 + 0.3 * len(rows)), layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(counts, cmap="Blues", aspect="auto")
    axes.set_xticks(range(len(columns)), columns, rotation=60, ha="right", fontsize=8)
    axes.set_yticks(range(len(rows)), rows, fontsize=8)
    for i, j in zip(*np.nonzero(counts), strict=True):
        dark = counts[i, j] > 0.6 * counts.max()
        axes.text(j, i, str(counts[i, j]), ha="center", va="center", fontsize=8, color="white" if dark else "black")
    axes.set_xlabel("said first")
    axes.set_ylabel("true")
    figure.savefig(path, dpi=130)


def _reliability_figure(cases: list[Scored], path: pathlib.Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4, 4), layout="constrained")
    axes = figure.add_subplot()
    axes.plot([0, 1], [0, 1], color="0.7", lw=1)
    points = reliability(cases)
    axes.plot([p for p, _, _ in points], [hit for _, hit, _ in points], "o-", color="tab:blue")
    for p, hit, count in points:
        axes.annotate(str(count), (p, hit), textcoords="offset points", xytext=(6, -10), fontsize=8)
    axes.set_xlabel("probability of the first name")
    axes.set_ylabel("share of right names")
    axes.set_xlim(0, 1.02)
    axes.set_ylim(0, 1.05)
    figure.savefig(path, dpi=130)


def _case_list(cases: list[Scored]) -> str:
    rows = []
    for case in sorted(cases, key=lambda c: (c.kind, c.truth, -c.severity)):
        right = {
            "none": case.said == "none",
            "unknown": case.says_unknown,
            "single": case.top in case.truth,
            "pair": set(case.truth) <= set(case.named),
        }[case.kind]
        rows.append(
            (
                case.name,
                case.family,
                " + ".join(case.truth) or "none",
                f"{case.label['gap_over_noise']:.1f}",
                ", ".join(sorted(case.twins)),
                case.said,
                ", ".join(case.named),
                "yes" if right else "no",
            )
        )
    return _markdown(["case", "family", "true", "gap/noise", "twins", "verdict", "named", "right"], rows)


def _markdown(header: list[str], rows) -> str:
    return "\n".join(markdown_table([header, *rows]))


def summary(cases: list[Scored]) -> str:
    """The table as plain lines."""
    return "\n".join(f"{row.measure}: {row.value}   [{row.wanted}]" for row in table(cases))
