"""Pictures of the motion to record next: where the explanations differ, and the information of each motion."""

from __future__ import annotations

import os
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from cablejax.arrays import evenly
from cablejax.control.targets import length_through
from cablejax.diagnose.diagnosis import NextMotion
from cablejax.diagnose.judgement import effect_title
from cablejax.report.animation import DPI, animate
from cablejax.report.effect_words import explanation_title
from cablejax.report.style import (
    DIAGNOSIS_STYLE,
    LIGHT,
    cable_curve,
    draw_bars,
    draw_grippers,
    draw_scale_bar,
    drawn_size,
)

_COLOURS = (LIGHT.residual, LIGHT.direct, "#009e73", "#cc79a7", "#e69f00")
_MOMENTS = 5
# [lengths of the cable]
_MARGIN = 0.1
_SPEED, _FRAMES_PER_SECOND, _HOLD_S = 5.0, 10.0, 1.5
_WIDTH, _HEADER, _LINE = 640, 40, 20


def motion_figure(following: NextMotion | None) -> Figure | None:
    """The motion at a few moments, with the cable under each explanation, and the information of every motion.

    The moments are those at which the explanations differ most. None without a motion.
    """
    if following is None:
        return None
    with matplotlib.rc_context(DIAGNOSIS_STYLE):
        figure = Figure(figsize=(10.0, 4.6), layout="constrained")
        halves: Any = figure.subfigures(2, 1, height_ratios=[1.25, 1.0])
        _film(halves[0], following)
        _worth(halves[1].subplots(), following)
    return figure


def write_motion_gif(path: str | os.PathLike[str], following: NextMotion) -> None:
    """Writes a preview of the motion, five times as fast."""
    (x0, x1, y0, y1), length = _window(following), _size(following)
    names, width = list(following.shapes), _WIDTH / DPI
    header = (_HEADER + _LINE * len(names)) / DPI
    height = header + max(width * (y1 - y0) / (x1 - x0), 0.01)
    last, step = len(following.poses) - 1, _SPEED / _FRAMES_PER_SECOND / following.interval
    with matplotlib.rc_context(DIAGNOSIS_STYLE):
        figure = Figure(figsize=(width, height), dpi=DPI)
        ax = figure.add_axes((0.0, 0.0, 1.0, 1.0 - header / height), xlim=(x0, x1), ylim=(y0, y1))
        ax.set_axis_off()
        draw_scale_bar(ax, 0.2 * length)
        figure.text(0.02, 1.0 - 0.1 / height, "Record next", size=12, weight="bold", va="top")
        clock = figure.text(0.98, 1.0 - 0.1 / height, "", size=12, weight="bold", ha="right", va="top")
        for row, (name, colour) in enumerate(zip(names, _COLOURS, strict=False)):
            top = 1.0 - (_HEADER + _LINE * row) / DPI / height
            figure.text(0.02, top, explanation_title(name), size=10, color=colour, va="top")

        def draw(sample: int) -> list[Any]:
            clock.set_text(f"{following.interval * sample:.0f} s")
            artists = draw_grippers(ax, following.poses[sample], length)
            for name, colour in zip(names, _COLOURS, strict=False):
                artists += ax.plot(*cable_curve(following.shapes[name][sample]).T, color=colour, lw=1.8)
            return artists

        samples = [*np.arange(0.0, last, step).round().astype(int), last]
        animate(path, figure, draw, samples, frames_per_second=_FRAMES_PER_SECOND, hold_s=_HOLD_S)


def _film(figure: Any, following: NextMotion) -> None:
    moments, (x0, x1, y0, y1), length = telling_moments(following), _window(following), _size(following)
    for ax, sample in zip(figure.subplots(1, len(moments), squeeze=False)[0], moments, strict=True):
        for gripper in range(2):
            ax.plot(*following.poses[:, gripper, :2].T, color=LIGHT.faint, lw=1.5)
        draw_grippers(ax, following.poses[sample], length, alpha=0.85)
        for (name, points), colour in zip(following.shapes.items(), _COLOURS, strict=False):
            ax.plot(*cable_curve(points[sample]).T, color=colour, lw=1.8, label=explanation_title(name))
        ax.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal", xticks=[], yticks=[])
        ax.spines[:].set_visible(False)
        ax.set_title(f"{following.interval * sample:.0f} s", fontsize=10)
    draw_scale_bar(figure.axes[-1], 0.2 * length)
    if len(following.shapes) > 1:
        figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper left", ncols=5, fontsize=10)


def telling_moments(following: NextMotion) -> list[int]:
    """Samples at which the explanations differ most, an eighth of the motion apart; evenly spread without rivals."""
    points = np.stack(list(following.shapes.values()))
    samples = points.shape[1]
    if len(points) < 2:
        return evenly(samples, _MOMENTS)
    differences = np.linalg.norm(points[:, None] - points[None], axis=-1).max(axis=(0, 1, 3))
    chosen: list[int] = []
    for sample in np.argsort(-differences, kind="stable"):
        if len(chosen) < _MOMENTS and all(abs(sample - other) >= samples // 8 for other in chosen):
            chosen.append(int(sample))
    return sorted(chosen)


def _worth(ax: Any, following: NextMotion) -> None:
    """Bars of the information of every motion, and the doubt that there is."""
    names = sorted(following.alternatives, key=lambda name: -following.alternatives[name])
    values = [following.alternatives[name] for name in names]
    colours = [LIGHT.residual if name == following.motion else LIGHT.target for name in names]
    longest = max(*values, following.doubt, 1e-9)
    draw_bars(ax, list(map(effect_title, names)), values, [f"{value:.2g}" for value in values], colours, longest)
    if following.separates:
        ax.axvline(following.doubt, color=LIGHT.ink, lw=1.2, ls=(0, (5, 3)))
        ax.set_title(f"Information about which explanation holds [nats]; dashed: the doubt, {following.doubt:.2g}")
    else:
        ax.set_title("Information about the parameters [nats]")


def _window(following: NextMotion) -> tuple[float, float, float, float]:
    """The view (x0, x1, y0, y1) [m] of all that is drawn."""
    drawn = (following.poses[..., :2], *following.shapes.values())
    every, margin = np.concatenate([points.reshape(-1, 2) for points in drawn]), _MARGIN * _size(following)
    (x0, y0), (x1, y1) = np.nanmin(every, axis=0) - margin, np.nanmax(every, axis=0) + margin
    return float(x0), float(x1), float(y0), float(y1)


def _size(following: NextMotion) -> float:
    return drawn_size(length_through(next(iter(following.shapes.values()))[0]))
