"""Units of length: converts stated units, and rejects cables of implausible length."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from cablejax.limits import LIMITS

METRES: Mapping[str, float] = MappingProxyType({"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254})
"""Metres in one of each unit of length that a recording may have."""

PLAUSIBLE = (LIMITS["recorded_length"].low, LIMITS["recorded_length"].high)
"""Lengths [m] that a cable between two arms may have."""


def recognised_unit(length: float, plausible: tuple[float, float] = PLAUSIBLE) -> tuple[str, ...]:
    """The units in which this cable length is plausible; several if it is ambiguous."""
    return tuple(name for name, metres in METRES.items() if plausible[0] <= length * metres <= plausible[1])


def require_metres(length: float, unit: str) -> None:
    """Rejects a cable of implausible length.

    Args:
        length: of the cable [m], after conversion from `unit`.
        unit: as stated.

    Raises:
        ValueError: says in which units it would be plausible.
    """
    if PLAUSIBLE[0] <= length <= PLAUSIBLE[1]:
        return
    raw = length / METRES[unit]
    better = [f"{raw * METRES[name]:.3g} m if they are in {name}" for name in recognised_unit(raw)]
    raise ValueError(
        f"Along its keypoints, read in {unit}, the cable measures {length:.4g} m, expected {PLAUSIBLE[0]:g} to "
        f"{PLAUSIBLE[1]:g}. "
        + (
            f"It would be {' or '.join(better)}: name the unit."
            if better
            else "Check the unit, and which columns or topic are read."
        )
    )
