"""The report as one self-contained HTML page.

Figures are inline SVG whose colours follow the page's, so that they read on a light and on a dark screen. The animation
is drawn by a small script from the recorded runs; without scripts the GIF stands in its place.
"""

from __future__ import annotations

import base64
import html
import importlib.resources
import io
import json
import os
import pathlib
import re
import string
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from cablejax.report import figures
from cablejax.report.style import (
    LIGHT,
    METHOD_LABEL,
    METHOD_ORDER,
    by_shape,
    cable_curve,
    common_window,
    gripper_outline,
)

if TYPE_CHECKING:
    from cablejax.control.run import ClosedLoopRun
    from cablejax.control.shaping import Method, Runs

REACHED_CM = 1.0
"""Largest final error with which a target counts as reached [cm]."""

_UNITS_PER_METRE = 10_000
_CSS_CLASS: dict[Method, str] = {"residual": "with", "direct": "without"}

_SECTIONS: tuple[tuple[str, Callable[[Any], Figure], str], ...] = (
    (
        "Where the cable ended",
        figures.final_shapes,
        "The last sample of each run over its target (broad grey line). Dots are the observed keypoints.",
    ),
    (
        "How the error fell",
        figures.error_over_time,
        "Root mean square keypoint distance to the target, on a logarithmic axis.",
    ),
    (
        "What the online residual contributes",
        figures.residual_share,
        "Size of the residual's prediction relative to the learned model's and its own together, at each command. "
        "It is fitted to the last samples before every command. Blank where the grippers rested.",
    ),
    (
        "How far the planner trusts itself",
        figures.motion_bound,
        "The bound on one gripper's motion in one step. It grows while the predicted progress is made and shrinks "
        "while it is not.",
    ),
)


def write_page(
    path: str | os.PathLike[str],
    runs: Runs,
    summary: Mapping[str, Any],
    *,
    about: str,
    facts: Mapping[str, str],
    gif: str | os.PathLike[str],
) -> None:
    """Writes the page.

    Args:
        path: the file to write.
        runs: the runs.
        summary: the demo's summary: `{"shapes": {name: {...}}, "total_s": ...}`.
        about: what plant and model these runs had, in a sentence or two.
        facts: versions, seed, machine: whatever is needed to make the page again, in order.
        gif: the animation's file, inlined for readers without scripts.
    """
    pairs = by_shape(runs)
    title, lead = headline(pairs)
    here = importlib.resources.files("cablejax.report")
    page = string.Template((here / "page.html").read_text(encoding="utf-8")).substitute(
        title=html.escape(title),
        lead=lead,
        about=html.escape(about),
        css=(here / "page.css").read_text(encoding="utf-8"),
        player=(here / "player.js").read_text(encoding="utf-8"),
        panels="\n".join(_panel(shape, pair) for shape, pair in pairs.items()),
        toggles="\n".join(_toggle(method) for method in METHOD_ORDER[::-1] if any(method in r for r in pairs.values())),
        table=_table(summary["shapes"]),
        figures="\n".join(_figures(runs)),
        facts="\n".join(f"<dt>{html.escape(k)}</dt><dd>{html.escape(v)}</dd>" for k, v in facts.items()),
        fallback="data:image/gif;base64," + base64.b64encode(pathlib.Path(gif).read_bytes()).decode(),
        # "</" would end the script element; "<\/" is the same JSON.
        data=json.dumps(animation_data(runs), separators=(",", ":"), allow_nan=False).replace("</", "<\\/"),
    )
    pathlib.Path(path).write_text(page, encoding="utf-8")


def headline(pairs: Mapping[str, Mapping[Method, ClosedLoopRun]]) -> tuple[str, str]:
    """The result as a title and, in HTML, a sentence that says the numbers with and without the residual."""
    main = {shape: runs.get("residual") or runs["direct"] for shape, runs in pairs.items()}
    ends = {shape: run.terminal_error_cm for shape, run in main.items()}
    reached = {shape: end for shape, end in ends.items() if end <= REACHED_CM}
    missed = {shape: end for shape, end in ends.items() if shape not in reached}
    parts = []
    if reached:
        parts.append(f"The cable reaches {_list(list(reached))} to within {max(reached.values()):.2f} cm")
    if missed:
        far = _list([f"{end:.2f}" for end in missed.values()])
        parts.append(f"{'it' if reached else 'The cable'} stays {far} cm away from {_list(list(missed))}")
    title = ", but ".join(parts)
    start = _list([f"{run.error_cm[0]:.1f}" for run in main.values()])
    parts = [f"It starts {start} cm away."]
    for method in METHOD_ORDER[::-1]:
        errors = [f"{runs[method].terminal_error_cm:.2f}" for runs in pairs.values() if method in runs]
        if errors:
            words = METHOD_LABEL[method].capitalize()
            parts.append(f'<span class="{_CSS_CLASS[method]}">{words}</span> it ends {_list(errors)} cm away.')
    return title, " ".join(parts)


def animation_data(runs: Runs) -> dict[str, Any]:
    """Data of the player as JSON: curves in whole tenths of a millimetre, poses in metres and radians."""

    def integers(points: np.ndarray) -> list[int | None]:
        flat = np.asarray(points, dtype=float).ravel() * _UNITS_PER_METRE
        return [None if not np.isfinite(v) else round(v) for v in flat.tolist()]

    def course(method: Method, run: ClosedLoopRun) -> dict[str, Any]:
        return {
            "method": method,
            "times": [round(float(t), 3) for t in run.times],
            "error": np.round(_bridged(run.error_cm), 6).tolist(),
            "pose": np.round(run.gripper_pose.reshape(len(run.times), 6), 5).tolist(),
            "points": [integers(x) for x in run.keypoints],
            "curve": [integers(cable_curve(x, g, 49)) for x, g in zip(run.keypoints, run.gripper_pose, strict=True)],
        }

    pairs = by_shape(runs)
    return {
        "end": max(float(r.times[-1]) for r in runs.values()),
        "view": common_window(runs, margin=0.1),
        "gripper": [[polygon.tolist() for polygon in gripper_outline(np.zeros(3), end)] for end in range(2)],
        "shapes": [
            {
                "name": shape,
                "target": integers(cable_curve(next(iter(pair.values())).target.keypoints, n_points=97)),
                "runs": [course(method, pair[method]) for method in METHOD_ORDER if method in pair],
            }
            for shape, pair in pairs.items()
        ],
    }


def _bridged(values: np.ndarray) -> np.ndarray:
    """Instants at which nothing was observed, filled in from their neighbours."""
    index, seen = np.arange(len(values)), np.isfinite(values)
    return np.interp(index, index[seen], values[seen]) if seen.any() else np.zeros(len(values))


def svg(figure: Figure, name: str) -> str:
    """A figure as an inline SVG element in the page's own colours; `name` keeps its ids apart from those of others."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    # As wide as the page, but a figure of one panel not blown up.
    width = figure.get_size_inches()[0]
    text = re.sub(r'width="[\d.]+pt" height="[\d.]+pt"', f'style="max-width: {1.4 * width:.1f}in"', text, count=1)
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r"url\(#", f"url(#{name}-", text)
    text = re.sub(r'xlink:href="#', f'xlink:href="#{name}-', text)
    for role in ("ink", "muted", "faint", "gripper", "target", "residual", "direct"):
        text = re.sub(getattr(LIGHT, role), f"var(--{role})", text, flags=re.IGNORECASE)
    return text


def _figures(runs: Runs):
    methods = {method for _, method in runs}
    for index, (heading, draw, caption) in enumerate(_SECTIONS):
        if draw is figures.residual_share and "residual" not in methods:
            continue
        picture = svg(draw(runs), f"figure{index}")
        yield f"<h2>{heading}</h2>\n<figure>{picture}<figcaption>{html.escape(caption)}</figcaption></figure>"


def _panel(shape: str, runs: Mapping[Method, ClosedLoopRun]) -> str:
    name = html.escape(shape, quote=True)
    readings = "".join(
        f'<p class="reading {_CSS_CLASS[m]}"><b data-method="{m}"></b> cm {METHOD_LABEL[m]}</p>'
        for m in METHOD_ORDER[::-1]
        if m in runs
    )
    return (
        f'    <div data-shape="{name}"><h3>{name}</h3>'
        f'<canvas role="img" aria-label="The cable and its target {name}"></canvas>{readings}</div>'
    )


def _toggle(method: Method) -> str:
    label = METHOD_LABEL[method]
    return (
        f'    <label class="{_CSS_CLASS[method]}"><input type="checkbox" data-show="{method}" checked>{label}</label>'
    )


def _table(shapes: Mapping[str, Mapping[str, Any]]) -> str:
    columns = (
        ("initial_error_cm", "initial<br>error [cm]", "{:.2f}", ""),
        ("terminal_error_cm", "final error<br>with residual [cm]", "{:.2f}", "with"),
        ("terminal_error_without_residual_cm", "final error<br>without residual [cm]", "{:.2f}", "without"),
        ("settling_time_s", "settling<br>time [s]", "{:.0f}", ""),
        ("mpc_ms_p50", "MPC<br>median [ms]", "{:.0f}", ""),
        ("mpc_ms_p95", "MPC<br>95 % [ms]", "{:.0f}", ""),
    )
    head = "".join(f"<th>{label}</th>" for _, label, _, _ in columns)
    rows = []
    for shape, values in shapes.items():
        cells = "".join(
            f'<td class="{css}">{"n/a" if values.get(key) is None else form.format(values[key])}</td>'
            for key, _, form, css in columns
        )
        rows.append(f"<tr><th>{html.escape(shape)}</th>{cells}</tr>")
    return f"<table><thead><tr><th>shape</th>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"


def _list(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
