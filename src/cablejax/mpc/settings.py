"""Checks of a solver's settings."""

from __future__ import annotations

import math

from cablejax.whole_number import is_whole


def check_budget(settings: object, *names: str) -> None:
    """Raises ValueError unless these settings of a solver are whole numbers, at least one."""
    values = [getattr(settings, name) for name in names]
    if not all(is_whole(value, least=1) for value in values):
        given = ", ".join(f"{name}={value}" for name, value in zip(names, values, strict=True))
        raise ValueError(f"{type(settings).__name__}({given}): expected whole numbers, at least one of each.")


def check_positive(settings: object, *names: str) -> None:
    """Raises ValueError unless these settings of a solver are positive and finite."""
    for name in names:
        value = getattr(settings, name)
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{type(settings).__name__}.{name} is {value}, expected a positive finite number.")
