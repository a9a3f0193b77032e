"""The report of closed loops as one HTML page.

Figures are inline SVG whose colours follow the page's, so that they read on a light and on a dark screen. The animation
is drawn by a small script from the recorded runs; without scripts the GIF stands in its place.
"""

from __future__ import annotations

import base64
import os
import pathlib
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from cablejax.diagnose.judgement import listed
from cablejax.report import figures
from cablejax.report.html import json_script, svg, write_html
from cablejax.report.style import (
    METHOD_LABEL,
    METHOD_ORDER,
    bar_of,
    by_shape,
    cable_curve,
    common_window,
    gripper_outline,
    size_of,
)

if TYPE_CHECKING:
    from cablejax.control.run import ClosedLoopRun
    from cablejax.control.shaping import Method, Runs

_UNITS_PER_METRE = 10_000
_CSS_CLASS: dict[Method, str] = {"residual": "with", "direct": "without"}

_SECTIONS: tuple[tuple[str, Callable[[Any], Figure], str], ...] = (
    (
        "Where the cable ended",
        figures.final_shapes,
        "The last sample of each run, drawn over the target (broad grey line). Dots are the observed keypoints.",
    ),
    (
        "How the error fell",
        figures.error_over_time,
        "Root mean square keypoint distance to the target, on a logarithmic axis.",
    ),
    (
        "What the online residual contributes",
        figures.residual_share,
        "Size of the residual's prediction relative to the sum of the learned model's and its own, at each command. "
        "The residual is fitted to the last samples before every command. Blank where the grippers rested.",
    ),
    (
        "How far the planner trusts itself",
        figures.motion_bound,
        "The bound on one gripper's motion in one step. It grows while the cable makes the predicted progress, and "
        "shrinks otherwise.",
    ),
)


def write_page(
    path: str | os.PathLike[str],
    runs: Runs,
    numbers: Mapping[str, Mapping[str, Any]],
    *,
    about: str,
    facts: Mapping[str, str],
    gif: str | os.PathLike[str],
) -> None:
    """Writes the page.

    Args:
        path: the file to write.
        runs: the runs.
        numbers: of each shape for the table of results, by the keys of `_COLUMNS`.
        about: what plant and model these runs had, in a sentence or two.
        facts: versions, seed, machine: whatever is needed to make the page again, in order.
        gif: the animation's file, inlined for readers without scripts.
    """
    pairs = by_shape(runs)
    title, start, ends = headline(pairs)
    write_html(
        path,
        "page.html",
        title=title,
        start=start,
        methods=ends,
        about=about,
        reached=_reached(pairs),
        css=_CSS_CLASS,
        label=METHOD_LABEL,
        shapes=pairs,
        columns=_COLUMNS,
        results={shape: _cells(values) for shape, values in numbers.items()},
        figures=_figures(runs),
        made=facts,
        fallback="data:image/gif;base64," + base64.b64encode(pathlib.Path(gif).read_bytes()).decode(),
        data=json_script(animation_data(runs)),
    )


def headline(pairs: Mapping[str, Mapping[Method, ClosedLoopRun]]) -> tuple[str, str, dict[Method, str]]:
    """The result as a title, a sentence on the errors at the start, and the errors at the end by method [cm]."""
    main = {shape: runs.get("residual") or runs["direct"] for shape, runs in pairs.items()}
    ends = {shape: run.terminal_error_cm for shape, run in main.items()}
    reached = {shape: ends[shape] for shape, run in main.items() if run.reached}
    missed = {shape: end for shape, end in ends.items() if shape not in reached}
    parts = []
    if reached:
        parts.append(f"The cable reaches {listed(list(reached))} to within {max(reached.values()):.2f} cm")
    if missed:
        far = listed([f"{end:.2f}" for end in missed.values()])
        parts.append(f"{'it' if reached else 'The cable'} ends {far} cm away from {listed(list(missed))}")
    start = listed([f"{run.error_cm[0]:.1f}" for run in main.values()])
    errors: dict[Method, list[str]] = {
        method: [f"{runs[method].terminal_error_cm:.2f}" for runs in pairs.values() if method in runs]
        for method in METHOD_ORDER[::-1]
    }
    return ", but ".join(parts), f"It starts {start} cm away.", {m: listed(e) for m, e in errors.items() if e}


def _reached(pairs: Mapping[str, Mapping[Method, ClosedLoopRun]]) -> str:
    """How many targets were reached by each method, in a sentence."""
    counts = []
    for method in METHOD_ORDER[::-1]:
        own = [runs[method] for runs in pairs.values() if method in runs]
        if own:
            counts.append(f"{sum(run.reached for run in own)} of {len(own)} {METHOD_LABEL[method]}")
    goal = max(run.goal_cm for runs in pairs.values() for run in runs.values())
    return f"Targets reached to within {goal:.2g} cm: {listed(counts)}. See the results below."


def animation_data(runs: Runs) -> dict[str, Any]:
    """Data of the player as JSON: curves in whole tenths of a millimetre, poses in metres and radians."""

    def integers(points: np.ndarray) -> list[int | None]:
        flat = np.asarray(points, dtype=float).ravel() * _UNITS_PER_METRE
        return [None if not np.isfinite(v) else round(v) for v in flat.tolist()]

    def course(method: Method, run: ClosedLoopRun) -> dict[str, Any]:
        seen = np.isfinite(run.error_cm)
        # instants at which nothing was observed, filled in from their neighbours
        error = np.interp(run.times, run.times[seen], run.error_cm[seen]) if seen.any() else np.zeros(len(seen))
        return {
            "method": method,
            "times": [round(float(t), 3) for t in run.times],
            "error": np.round(error, 6).tolist(),
            "pose": np.round(run.gripper_pose.reshape(len(run.times), 6), 5).tolist(),
            "points": [integers(x) for x in run.keypoints],
            "curve": [integers(cable_curve(x, g, 49)) for x, g in zip(run.keypoints, run.gripper_pose, strict=True)],
        }

    pairs, length = by_shape(runs), size_of(runs)
    return {
        "end": max(float(r.times[-1]) for r in runs.values()),
        "view": common_window(runs, margin=0.1),
        "gripper": [[polygon.tolist() for polygon in gripper_outline(np.zeros(3), end, length)] for end in range(2)],
        "bar": bar_of(0.2 * length),
        "shapes": [
            {
                "name": shape,
                "target": integers(cable_curve(next(iter(pair.values())).target.keypoints, n_points=97)),
                "runs": [course(method, run) for method, run in pair.items()],
            }
            for shape, pair in pairs.items()
        ],
    }


def _figures(runs: Runs):
    methods = {method for _, method in runs}
    for index, (heading, draw, caption) in enumerate(_SECTIONS):
        if draw is figures.residual_share and "residual" not in methods:
            continue
        yield heading, svg(draw(runs), f"figure{index}"), caption


_COLUMNS = (
    ("initial", "error [cm]", "", "initial_error_cm"),
    ("final error", "with residual [cm]", "with", "terminal_error_cm"),
    ("final error", "without residual [cm]", "without", "terminal_error_without_residual_cm"),
    ("settling", "time [s]", "", "settling_time_s"),
    ("MPC", "median [ms]", "", "mpc_ms_p50"),
    ("MPC", "95 % [ms]", "", "mpc_ms_p95"),
)
"""Of the table of results: both lines of its head, the class of its cells, and the summary's field."""


def _cells(values: Mapping[str, Any]) -> list[tuple[str, str]]:
    """One shape's cells of the table, with their classes: centimetres to two digits, times whole."""
    known = ((values.get(key), key, css) for _, _, css, key in _COLUMNS)
    return [
        ("n/a" if value is None else f"{value:.2f}" if key.endswith("_cm") else f"{value:.0f}", css)
        for value, key, css in known
    ]
