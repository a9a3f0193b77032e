"""Common labels of the figures of a diagnosis."""

from __future__ import annotations

from typing import Any

from cablejax.diagnose.diagnosis import CableDiagnosis
from cablejax.report.effect_words import effect_title
from cablejax.report.style import FIGURE_STYLE

STYLE: dict[Any, Any] = FIGURE_STYLE | {"font.size": 11.0, "axes.titlesize": 11.0}
"""Settings for `matplotlib.rc_context`."""


def explained_label(diagnosis: CableDiagnosis) -> str:
    """Legend of the curve with the explanation."""
    if not diagnosis.effects:
        return "with the best explanation found, not named"
    names = [effect_title(effect.name) for effect in diagnosis.effects]
    return f"with {names[0]}" if len(names) == 1 else "with the named effects"
