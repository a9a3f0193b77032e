"""The report's figures: final shapes, error over time, the residual's share, the bound on a step, and snapshots.

Each function takes the runs and gives a `matplotlib.figure.Figure` that belongs to nobody else: no pyplot, no global
state, no display needed. Notebooks show it, `page.svg` inlines it, `figure.savefig` writes it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cablejax.report.style import (
    FIGURE_STYLE,
    LIGHT,
    METHOD_LABEL,
    METHOD_ORDER,
    by_shape,
    cable_curve,
    common_window,
    draw_grippers,
    draw_scale_bar,
    size_of,
)

if TYPE_CHECKING:
    from cablejax.control.run import ClosedLoopRun
    from cablejax.control.shaping import Method, Runs

_REST = 5e-4
"""Grippers that move by less than this in a step [m, rad] rest."""
_DOTTED: dict[str, Any] = {"color": "white", "lw": 2.6, "ls": (0, (1, 1.2))}
_NOTE: dict[str, Any] = {"ha": "right", "va": "top", "color": LIGHT.muted, "fontsize": 9}

_STYLE: dict[Any, Any] = FIGURE_STYLE | {
    "font.size": 10.0,
    "axes.titleweight": "bold",
    "xtick.labelcolor": LIGHT.muted,
    "ytick.labelcolor": LIGHT.muted,
    "grid.linewidth": 0.6,
}


def final_shapes(runs: Runs) -> Figure:
    """The cable at the end of each run over its target, one panel per shape, with the error in words."""
    pairs = by_shape(runs)
    views = common_window(runs, margin=0.1, final_only=True)
    x0, x1, y0, y1 = next(iter(views.values()))
    panel_width = _panel_width(len(pairs))
    panel_height = panel_width * (y1 - y0) / (x1 - x0)
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(panel_width * len(pairs), panel_height + 1.15), layout="constrained")
        axes = figure.subplots(1, len(pairs), squeeze=False)[0]
        for ax, (shape, pair) in zip(axes, pairs.items(), strict=True):
            _table_axes(ax, views[shape])
            target = next(iter(pair.values())).target.keypoints
            ax.plot(*cable_curve(target).T, color=LIGHT.target, lw=7, alpha=0.45, solid_capstyle="round")
            for method, run in pair.items():
                _draw_cable(ax, run, -1, method, size_of(runs))
            ax.set_title(shape, fontsize=14, parse_math=False)
            for row, (method, run) in enumerate(reversed(pair.items())):
                words = f"{run.terminal_error_cm:.2f} cm {METHOD_LABEL[method]}"
                ax.annotate(
                    words, (0.0, 0.0), xycoords="axes fraction", xytext=(0.0, -4.0 - 15.0 * row),
                    textcoords="offset points", color=LIGHT.method(method), va="top", fontsize=10.5,
                )  # fmt: skip
        draw_scale_bar(axes[-1], 0.2 * size_of(runs))
        _method_legend(figure, runs, Line2D([], [], color=LIGHT.target, lw=7, alpha=0.45, label="target"))
    return figure


def error_over_time(runs: Runs) -> Figure:
    """Shape error against time on a logarithmic axis, one panel per shape; a line marks the goal, 1 % of the length."""
    pairs = by_shape(runs)
    with matplotlib.rc_context(_STYLE):
        figure, axes = _row_of_panels(list(pairs), "shape error [cm]")
        goal = float(np.mean([r.goal_cm for r in runs.values()]))
        low = min(goal, *(float(np.nanmin(r.error_cm)) for r in runs.values()))
        high = max(goal, *(float(np.nanmax(r.error_cm)) for r in runs.values()))
        for ax, pair in zip(axes, pairs.values(), strict=True):
            for method, run in pair.items():
                ax.plot(run.times, run.error_cm, color=LIGHT.method(method), lw=2.2, label=METHOD_LABEL[method])
                if run.straightened.any():
                    ax.plot(run.times, np.where(run.straightened, run.error_cm, np.nan), **_DOTTED)
                ax.plot(run.times[-1], run.terminal_error_cm, "o", ms=5, color=LIGHT.method(method))
            ax.set_yscale("log")
            ax.set_ylim(low / 1.4, high * 1.3)
            ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
            ax.minorticks_off()
            ax.set_yticks([t for t in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50) if low / 1.4 <= t <= high * 1.3])
            ax.axhline(goal, color=LIGHT.target, lw=1.2, ls=(0, (5, 3)))
            if any(run.straightened.any() for run in pair.values()):
                ax.text(0.98, 0.98, "dotted: straightened\nfor another try", transform=ax.transAxes, **_NOTE)
        axes[0].text(0.0, goal / 1.08, f"{goal:.2g} cm", ha="left", va="top", color=LIGHT.muted, fontsize=9)
        _method_legend(figure, runs)
    return figure


def residual_share(runs: Runs) -> Figure:
    """Share of the online residual in the predicted motion [%], one panel per shape.

    Blank where the grippers rested: a share of no motion means nothing.

    Raises:
        ValueError: there is no run with the residual.
    """
    pairs = {shape: pair["residual"] for shape, pair in by_shape(runs).items() if "residual" in pair}
    if not pairs:
        raise ValueError("This figure needs runs with method 'residual', got none.")

    def share(run: ClosedLoopRun) -> np.ndarray:
        moved = np.abs(np.diff(run.gripper_pose, axis=0, append=np.nan)).max(axis=(1, 2))
        return np.where(moved > _REST, 100.0 * run.residual_share, np.nan)

    top, colour = max(float(np.nanmax(share(run), initial=0.0)) for run in pairs.values()), LIGHT.residual
    with matplotlib.rc_context(_STYLE):
        figure, axes = _row_of_panels(list(pairs), "residual's share of\nthe predicted motion [%]")
        for ax, run in zip(axes, pairs.values(), strict=True):
            ax.set_xlim(run.times[0], run.times[-1])
            ax.fill_between(run.times, 0.0, share(run), color=colour, alpha=0.18, lw=0)
            ax.plot(run.times, share(run), color=colour, lw=2.2)
            ax.set_ylim(0.0, 1.08 * top or 1.0)
    return figure


def motion_bound(runs: Runs) -> Figure:
    """Bound on the motion of one gripper in one step [cm], one panel per shape."""
    pairs = by_shape(runs)
    with matplotlib.rc_context(_STYLE):
        figure, axes = _row_of_panels(list(pairs), "motion bound [cm]")
        for ax, pair in zip(axes, pairs.values(), strict=True):
            for method, run in pair.items():
                ax.step(run.times, 100.0 * run.radius, where="post", color=LIGHT.method(method), lw=2.0)
            ax.set_ylim(bottom=0.0)
        _method_legend(figure, runs)
    return figure


def snapshots(runs: Runs) -> Figure:
    """The first shape with the residual as a film strip: cable and grippers at five instants, dense at the start.

    Raises:
        ValueError: there is no such run.
    """
    shape, pair = next(iter(by_shape(runs).items()))
    if "residual" not in pair:
        raise ValueError(f"This figure needs a run of shape {shape!r} with method 'residual', got none.")
    run = pair["residual"]
    last = len(run.times) - 1
    chosen = np.unique(np.round(last * np.linspace(0.0, 1.0, 5) ** 1.6).astype(int))
    only: Runs = {(shape, "residual"): run}
    view, length = common_window(only)[shape], size_of(only)
    width = 2.3
    with matplotlib.rc_context(_STYLE):
        height = width * (view[3] - view[2]) / (view[1] - view[0])
        figure = Figure(figsize=(width * len(chosen), height + 0.45), layout="constrained")
        axes = figure.subplots(1, len(chosen), squeeze=False)[0]
        for ax, index in zip(axes, chosen, strict=True):
            _table_axes(ax, view)
            ax.plot(*cable_curve(run.target.keypoints).T, color=LIGHT.target, lw=1.6, ls=(0, (4, 3)))
            _draw_cable(ax, run, int(index), "residual", length)
            ax.set_title(f"{run.times[index]:.0f} s   {run.error_cm[index]:.2f} cm", fontsize=10)
        draw_scale_bar(axes[-1], 0.2 * length)
    return figure


def _table_axes(ax: Axes, view: tuple[float, float, float, float]) -> None:
    ax.set(xlim=view[:2], ylim=view[2:], aspect="equal")
    ax.axis("off")


def _draw_cable(ax: Axes, run: ClosedLoopRun, index: int, method: Method, length: float) -> None:
    colour = LIGHT.method(method)
    draw_grippers(ax, run.gripper_pose[index], length, alpha=0.85 if method == "residual" else 0.3)
    ax.plot(*cable_curve(run.keypoints[index], run.gripper_pose[index]).T, color=colour, lw=2.2)
    ax.plot(*run.keypoints[index].T, "o", color=colour, ms=3.0)


def _panel_width(n_panels: int) -> float:
    """Inches; few panels are wider, so that the legend above them fits."""
    return max(3.3, 5.4 / n_panels)


def _row_of_panels(shapes: list[str], label: str) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=(_panel_width(len(shapes)) * len(shapes), 2.75), layout="constrained")
    axes = figure.subplots(1, len(shapes), squeeze=False, sharey=True)[0]
    for ax, shape in zip(axes, shapes, strict=True):
        ax.grid(axis="y")
        ax.set_xlabel("time [s]")
        ax.set_title(shape, fontsize=13, parse_math=False)
    axes[0].set_ylabel(label)
    return figure, axes


def _method_legend(figure: Figure, runs: Runs, *others: Line2D) -> None:
    present = {method for _, method in runs}
    handles = [
        Line2D([], [], color=LIGHT.method(m), lw=2.2, label=METHOD_LABEL[m]) for m in METHOD_ORDER[::-1] if m in present
    ]
    handles = [*others, *handles]
    figure.legend(handles=handles, loc="outside upper left", ncols=len(handles), handlelength=1.6)
