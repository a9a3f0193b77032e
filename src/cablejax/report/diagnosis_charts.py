"""Charts of a diagnosis: which effect causes the gap, and how far it shrinks.

Each takes a `CableDiagnosis` and gives a `matplotlib.figure.Figure` that belongs to nobody else, or None if there is
nothing to draw.
"""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cablejax.diagnose.diagnosis import CableDiagnosis, Diagnosis
from cablejax.diagnose.judgement import effect_title, share
from cablejax.report.effect_words import explained_label, millimetres, share_removed, short
from cablejax.report.style import DIAGNOSIS_STYLE, LIGHT, draw_bars

_MAX_RANKED = 8
# Longest label of an effect [characters].
_LABEL = 80
_LIGHT_BLUE = "#56b4e9"
_SPLIT = (
    ("noise", "noise of the recording", LIGHT.faint),
    ("named", "named effects", LIGHT.residual),
    ("learnable", "learnable, unnamed", _LIGHT_BLUE),
    ("unexplained", "unexplained", LIGHT.direct),
)


def ranking_figure(diagnosis: Diagnosis) -> Figure | None:
    """Chart of the effects that were tried: probability, if computed, and share of the gap that each removes.

    None where none was tried.
    """
    likely = all(r.probability is not None for r in diagnosis.ranking)
    ranked = [r for r in diagnosis.ranking if not likely or max(r.probability or 0.0, r.held_out_shrinkage) >= 5e-3]
    ranked = (ranked if len(ranked) >= 3 else list(diagnosis.ranking))[: _MAX_RANKED if likely else None]
    if not ranked:
        return None
    named = {effect.name for effect in diagnosis.effects}
    alike = {name for group in diagnosis.equivalent for name in group} - named
    colours = [LIGHT.residual if r.name in named else _LIGHT_BLUE if r.name in alike else LIGHT.target for r in ranked]
    # of a file that anything may have written
    labels = [f"{effect_title(r.name)}{f', {r.outcome}' if r.outcome else ''}"[:_LABEL] for r in ranked]
    # were there no other causes than those of the library
    chance = "probability" if diagnosis.effects else "probability, if the cause is in the library"
    panels = [("share of the gap that it removes", [(r.held_out_shrinkage, share_removed(r)) for r in ranked])]
    if likely:
        panels.insert(0, (chance, [(r.probability or 0.0, share(r.probability or 0.0)) for r in ranked]))
    with matplotlib.rc_context(DIAGNOSIS_STYLE):
        figure = Figure(figsize=(10.0, 0.9 + 0.36 * max(len(ranked), 3)), layout="constrained")
        axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for ax, (title, bars) in zip(axes, panels, strict=True):
            draw_bars(ax, labels, [value for value, _ in bars], [word for _, word in bars], colours, 1.0)
            ax.set_title(title)
    return figure


def shrinkage_figure(diagnosis: CableDiagnosis) -> Figure:
    """Error before and after, by horizon, over the noise floor.

    Also five seconds ahead compared with a ridge residual, and the parts of the error before.
    """
    gap = diagnosis.gap
    explained = diagnosis.explained is not None
    believed = LIGHT.target if diagnosis.verdict == "none" else LIGHT.direct
    with matplotlib.rc_context(DIAGNOSIS_STYLE):
        figure = Figure(figsize=(10.0, 4.0), layout="constrained")
        grid = figure.add_gridspec(2, 2, height_ratios=[3.4, 0.5], width_ratios=[2.4, 1.0])
        ax = figure.add_subplot(grid[0, 0] if gap.ahead_mm else grid[0, :])
        horizons = sorted(gap.horizons_mm.items())
        x = np.arange(len(horizons))
        before, after = np.array([values for _, values in horizons]).reshape(-1, 2).T
        wide = 0.38 if explained else 0.5
        _bars(ax, x - (wide / 2 if explained else 0), before, wide, believed, "nominal simulator")
        if explained:
            _bars(ax, x + wide / 2, after, wide, LIGHT.residual, explained_label(diagnosis))
        noise = f"noise of the recording, {millimetres(gap.noise_floor_mm)}"
        ax.axhline(gap.noise_floor_mm, color=LIGHT.ink, lw=1.2, ls=(0, (5, 3)), label=noise)
        longest = max((seconds for seconds, _ in horizons), default=0.0)
        ax.set_xticks(x, [f"first {seconds:g} s" if seconds < longest else "all" for seconds, _ in horizons])
        ax.set_ylim(0, 1.15 * max(before.max(initial=0), after.max(initial=0), gap.noise_floor_mm))
        ax.set_ylabel("RMS error [mm]")
        ax.tick_params(axis="x", length=0)
        ax.set_title("Simulated from the start of each episode")
        if gap.ahead_mm:
            label = "cause\nadded" if diagnosis.effects else "best found\nadded"
            _ahead(figure.add_subplot(grid[0, 1]), gap.ahead_mm, believed, label if explained else None)
        _split_bar(figure.add_subplot(grid[1, :]), gap.split, named=bool(diagnosis.effects))
        figure.legend(*ax.get_legend_handles_labels(), loc="outside upper left", ncols=3)
    return figure


def _bars(ax: Axes, x: np.ndarray, heights: np.ndarray, width: float, colour: Any, label: str | None = None) -> None:
    """Bars with their heights written on top."""
    ax.bar(x, heights, width, color=colour, label=label)
    for at, height in zip(x, heights, strict=True):
        ax.text(at, height, short(height), ha="center", va="bottom", fontsize=9.5)


def _ahead(ax: Axes, errors: dict[str, float], believed: str, label: str | None) -> None:
    """Errors five seconds ahead of an observation; a ridge residual is a correction that knows no cause."""
    kinds = {"nominal": ("nominal\nsimulator", believed), "ridge": ("online\nresidual", LIGHT.target)}
    if label is not None:
        kinds["named"] = (label, LIGHT.residual)
    shown = [kind for kind in kinds if np.isfinite(errors.get(kind, np.nan))]
    heights = np.array([errors[kind] for kind in shown])
    _bars(ax, np.arange(len(shown)), heights, 0.6, [kinds[kind][1] for kind in shown])
    ax.set_xticks(range(len(shown)), [kinds[kind][0] for kind in shown])
    ax.set_ylim(0, 1.15 * heights.max(initial=0.1))
    ax.tick_params(axis="x", length=0)
    ax.set_title("5 s ahead, from an observation")


def _split_bar(ax: Axes, split: dict[str, float | None], *, named: bool) -> None:
    """Parts of the squared error before; without effects that are named, what the best explanation would take away."""
    begin = 0.0
    for key, label, colour in _SPLIT:
        part = split.get(key) or 0.0
        label = "best found, not named" if key == "named" and not named else label
        if part >= 5e-3:
            ax.barh(0, part, left=begin, color=colour, height=0.6, label=f"{label} {100 * part:.0f} %")
            begin += part
    ax.set(xlim=(0, 1), ylim=(-0.4, 0.4), yticks=[], xticks=[])
    ax.spines[:].set_visible(False)
    ax.set_title("The squared error before consists of")
    if begin:
        ax.legend(loc="upper left", bbox_to_anchor=(0.0, 0.05), ncols=4, fontsize=9.5, handlelength=1.0, borderpad=0.0)
