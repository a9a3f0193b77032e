"""The simulators that record logs, by letter; each is made when it is first asked for."""

from __future__ import annotations

from collections.abc import Callable

from .record import Simulate, family_a


def _rod() -> Simulate:
    return family_a


def _cosserat() -> Simulate:
    from .elastica_rod import simulate

    return simulate


def _sagging() -> Simulate:
    from .elastica_rod import simulate_in_space

    return simulate_in_space


def _contact() -> Simulate:
    from .composite import simulate

    return simulate


FAMILIES: dict[str, Callable[[], Simulate]] = {"A": _rod, "B": _cosserat, "C": _contact, "D": _sagging}
"""A: rod in node coordinates. B: PyElastica. C: MuJoCo with contact, only a cousin of the simulator that diagnoses.
D: PyElastica in space, sagging, with friction that is not regularised."""
