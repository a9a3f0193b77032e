"""Animations as GIFs: the runs of every shape, with and without the residual overlaid, and what else moves."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from cablejax.report.style import (
    FIGURE_STYLE,
    LIGHT,
    METHOD_LABEL,
    by_shape,
    common_window,
    draw_held_cable,
    draw_scale_bar,
    draw_target,
    size_of,
)
from cablejax.whole_file import whole_file

if TYPE_CHECKING:
    from cablejax.control.run import ClosedLoopRun
    from cablejax.control.shaping import Method, Runs

DPI = 100
"""Pixels per inch of a figure that is animated."""
_SPEED = 5.0
"""Seconds of the run per second of the animation."""
_HOLD_S = 2.5
"""How long the last frame stands [s]."""
_GHOST = "#c3c9cf"
_HEADER, _FOOTER = 78, 48
_COLOURS = 64


def write_gif(path: str | os.PathLike[str], runs: Runs, *, width: int = 960, frames_per_second: float = 12.0) -> None:
    """Writes the animation.

    Args:
        path: the file to write.
        runs: the runs; those of one shape share a panel.
        width: of the picture [pixels].
        frames_per_second: of the file.

    Raises:
        ValueError: if there is no run.
    """
    pairs, views, length = by_shape(runs), common_window(runs, margin=0.1), size_of(runs)
    end = max(float(r.times[-1]) for r in runs.values())
    # The cable moves most at the start, so time runs slower there: frame times grow with the square.
    instants = end * np.linspace(0.0, 1.0, max(2, round(end / _SPEED * frames_per_second))) ** 2
    x0, x1, y0, y1 = next(iter(views.values()))
    height = round((y1 - y0) / (x1 - x0) * width / len(pairs)) + _HEADER + _FOOTER
    with matplotlib.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
        axes = figure.subplots(1, len(pairs), squeeze=False)[0]
        figure.subplots_adjust(0, _FOOTER / height, 1, 1 - _HEADER / height, wspace=0)
        top = 1 - 24 / height
        figure.text(16 / width, top, "Two grippers shape a cable", size=13, weight="bold", va="center")
        clock = figure.text(1 - 16 / width, top, "", size=13, weight="bold", ha="right", va="center")
        for ax, (shape, panel) in zip(axes, pairs.items(), strict=True):
            _still(ax, shape, panel, views[shape])
        drawn = axes[-1].lines[:1]
        figure.legend(drawn, ["target"], loc="center left", bbox_to_anchor=(300 / width, top), labelcolor=LIGHT.muted)
        draw_scale_bar(axes[-1], 0.2 * length)

        def draw(time: float) -> list[Any]:
            clock.set_text(f"{time:.0f} s")
            panels = zip(axes, pairs.values(), strict=True)
            return [artist for ax, panel in panels for artist in _moving(ax, panel, time, length)]

        animate(path, figure, draw, instants, frames_per_second=frames_per_second, hold_s=_HOLD_S)


def animate(
    path: str | os.PathLike[str],
    figure: Figure,
    draw: Callable[[Any], list[Any]],
    moments: Iterable[Any],
    *,
    frames_per_second: float,
    hold_s: float,
) -> None:
    """Writes a GIF of a figure. All frames share one palette, which keeps it small.

    Args:
        path: the file to write.
        figure: with what stands still.
        draw: adds what moves at a moment, and returns those artists; they are removed after the frame.
        moments: what `draw` is called with, in order.
        frames_per_second: of the file.
        hold_s: how long the last frame stands [s].
    """
    canvas, frames = FigureCanvasAgg(figure), []
    for moment in moments:
        artists = draw(moment)
        canvas.draw()
        frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
        for artist in artists:
            artist.remove()
    # the other methods move the background away from white
    palette = frames[len(frames) // 2].quantize(_COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    indexed = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = [round(1000.0 / frames_per_second)] * (len(frames) - 1) + [round(1000.0 * hold_s)]
    with whole_file(pathlib.Path(path)) as stream:
        indexed[0].save(
            stream, format="GIF", save_all=True, append_images=indexed[1:], duration=durations, loop=0, optimize=False
        )


def _still(ax: Any, shape: str, runs: dict[Method, ClosedLoopRun], view: tuple[float, float, float, float]) -> None:
    """A panel without its cables."""
    ax.set(xlim=view[:2], ylim=view[2:], aspect="equal")
    ax.set_axis_off()
    ax.text(0.05, 1.0, shape, size=15, weight="bold", transform=ax.transAxes, parse_math=False)
    draw_target(ax, next(iter(runs.values())).target.keypoints, n_points=400)


def _moving(ax: Any, runs: dict[Method, ClosedLoopRun], time: float, length: float) -> list[Any]:
    """Draws the runs of a panel at one instant [s]; between samples the cable is interpolated."""
    artists: list[Any] = []
    for method, run in runs.items():
        strong = method == "residual" or len(runs) == 1
        pose, keypoints = _at(run.times, run.gripper_pose, time), _at(run.times, run.keypoints, time)
        gripper = LIGHT.gripper if strong else _GHOST
        artists += draw_held_cable(ax, keypoints, pose, length, LIGHT.method(method), gripper)
    for row, (method, run) in enumerate(reversed(runs.items())):
        error = float(_at(run.times, run.error_cm, time))
        place = {
            "xy": (0.2, 0.0),
            "xycoords": "axes fraction",
            "textcoords": "offset points",
            "color": LIGHT.method(method),
        }
        below = (0, -14 - 14 * row)
        artists.append(ax.annotate(f"{error:.2f}", xytext=below, ha="right", weight="bold", **place))
        artists.append(ax.annotate(f"  cm {METHOD_LABEL[method]}", xytext=below, ha="left", **place))
    return artists


def _at(times: np.ndarray, values: np.ndarray, time: float) -> np.ndarray:
    """`values` at one instant, linear between samples and constant past the last."""
    position = float(np.interp(time, times, np.arange(len(times))))
    low = min(int(position), len(times) - 1)
    high = min(low + 1, len(times) - 1)
    part = position - low
    return (1.0 - part) * np.asarray(values[low]) + part * np.asarray(values[high])
