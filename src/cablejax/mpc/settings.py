"""Checks of a solver's settings."""

from __future__ import annotations

import math


def check_budget(settings: object, *names: str) -> None:
    """Raises ValueError unless these settings of a solver are at least one."""
    if any(getattr(settings, name) < 1 for name in names):
        given = ", ".join(f"{name}={getattr(settings, name)}" for name in names)
        raise ValueError(f"{type(settings).__name__}({given}): expected at least one of each.")


def check_positive(settings: object, *names: str) -> None:
    """Raises ValueError unless these settings of a solver are positive and finite."""
    for name in names:
        value = getattr(settings, name)
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{type(settings).__name__}.{name} is {value}, expected a positive finite number.")
