"""Whole numbers in settings, Python's or NumPy's."""

from __future__ import annotations

import numbers


def is_whole(value: object, *, least: int) -> bool:
    """Whether a setting is a whole number and no smaller than the least one allowed."""
    return isinstance(value, numbers.Integral) and int(value) >= least
