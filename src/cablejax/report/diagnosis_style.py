"""What the figures of a diagnosis share."""

from __future__ import annotations

from typing import Any

from cablejax.diagnose.diagnosis import Diagnosis
from cablejax.report.effect_words import effect_title
from cablejax.report.style import LIGHT

STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 11.0,
    "axes.edgecolor": LIGHT.muted,
    "axes.labelcolor": LIGHT.ink,
    "axes.titlelocation": "left",
    "axes.titlesize": 11.0,
    "axes.titlecolor": LIGHT.ink,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "text.color": LIGHT.ink,
    "xtick.color": LIGHT.muted,
    "ytick.color": LIGHT.muted,
    "grid.color": LIGHT.faint,
    "legend.frameon": False,
    "svg.fonttype": "none",
}
"""Settings for `matplotlib.rc_context`."""


def explained_label(diagnosis: Diagnosis) -> str:
    if not diagnosis.effects:
        return "with the best explanation found, not named"
    names = [effect_title(effect.name) for effect in diagnosis.effects]
    return f"with {names[0]}" if len(names) == 1 else "with the named effects"
