"""Reads the effects that a verdict names, to be added to a simulator."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

from cablejax.effects.given import EFFECTS, GivenEffect, parameter_units
from cablejax.limits import LIMITS, shown
from cablejax.text_file import read_json, version_of

VERDICT_SCHEMA = "cablejax-verdict/1"
"""Format and version of `verdict.json`."""


def effects_of_verdict(path: str | os.PathLike[str]) -> tuple[GivenEffect, ...]:
    """The effects that a verdict names, with their estimated parameters. Several pieces become several effects.

    Raises:
        ValueError: the file is no verdict, or not on a cable on a table, or it names no effect ("none" and "unknown").
    """
    return _named(read_verdict_json(path), path)


def _named(verdict: Mapping[str, Any], path: str | os.PathLike[str]) -> tuple[GivenEffect, ...]:
    if (dimension := verdict.get("dimension", 2)) != 2:
        what = "a cable in space" if dimension == 3 else "something other than a cable on a table"
        raise ValueError(
            f"{path} is the verdict on {what}: its effects and their parameters are not those of a cable on a table, "
            "which is what is simulated here."
        )
    named = verdict.get("effects")
    if not isinstance(named, list):
        raise ValueError(f"{path}: effects is {shown(named)}, expected a list.")
    if not named:
        raise ValueError(
            f"{path} names no effect (its verdict is {shown(verdict.get('verdict'))}), so there is nothing to add. "
            "Leave --with out, or give an effect with --effect."
        )
    return tuple(piece for effect in named for piece in _pieces(effect, path))


def posterior_of_verdict(path: str | os.PathLike[str]) -> tuple[tuple[GivenEffect, ...], ...]:
    """Equally probable sets of effects, drawn from a verdict's posterior over explanations and their parameters.

    For motions about the origin, as those of a data set are: places on the table are relative to where the grippers
    of the log were. Of a verdict of an older version, which holds no such draws or place, the effects that it names.

    Raises:
        ValueError: as `effects_of_verdict`.
    """
    named, *drawn = explanations_of_verdict(path)
    return tuple(drawn) or (named,)


def explanations_of_verdict(path: str | os.PathLike[str]) -> tuple[tuple[GivenEffect, ...], ...]:
    """The effects that a verdict names, then the draws of its posterior if it has any; see `posterior_of_verdict`."""
    verdict = read_verdict_json(path)
    named, posterior = _named(verdict, path), verdict.get("posterior") or []
    try:
        drawn = tuple(
            tuple(GivenEffect(one["name"], tuple(one["parameters"].items())) for one in draw) for draw in posterior
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: posterior is not of the verdict's format ({error}).") from error
    place = verdict.get("place_m")
    if place is None:
        return (named, *drawn)
    if not (isinstance(place, list) and len(place) == 2 and all(value in LIMITS["origin"] for value in place)):
        raise ValueError(f"{path}: place_m is {shown(place)}, expected x and y in metres, {LIMITS['origin']}.")
    return tuple(tuple(_about(effect, place) for effect in one) for one in (named, *drawn))


def read_verdict_json(path: str | os.PathLike[str]) -> dict[str, Any]:
    """A verdict's JSON object, of the schema that this version writes; its fields are not checked.

    Raises:
        ValueError: the file is no verdict.
    """
    try:
        verdict = read_json(path)
    except FileNotFoundError as error:
        raise ValueError(f"{error} Expected a verdict.json of `diagnose`.") from error
    except (OSError, ValueError) as error:
        raise ValueError(f"This is not a verdict: {error} Expected a verdict.json of `diagnose`.") from error
    if not isinstance(verdict, dict):
        raise ValueError(f"{path} is {shown(verdict)}, expected {VERDICT_SCHEMA!r}: a verdict.json of `diagnose`.")
    version_of(verdict.get("schema"), VERDICT_SCHEMA, path)
    return verdict


def _about(effect: GivenEffect, place: Sequence[float]) -> GivenEffect:
    """The effect in a world whose origin is this place [m]."""
    moved = effect.effect.seen_from(dict(effect.parameters), place)
    return GivenEffect(effect.name, tuple(moved.items()), effect.from_s, effect.until_s)


def _pieces(effect: Any, path: Any) -> list[GivenEffect]:
    try:
        values = {name: entry["value"] for name, entry in effect["parameters"].items()}
        _check_units(effect["name"], {name: entry.get("unit") for name, entry in effect["parameters"].items()}, path)
        counts = {len(value) for value in values.values() if isinstance(value, list)}
        if len(counts) > 1 or 0 in counts:
            raise ValueError(
                f"{path}: {shown(effect['name'])} has lists of {' and '.join(map(str, sorted(counts)))} values, "
                "expected lists of one length, at least 1: a value of each parameter for each piece."
            )
        count = max(counts, default=1)
        rows = [
            tuple((name, value[i] if isinstance(value, list) else value) for name, value in values.items())
            for i in range(count)
        ]
        return [GivenEffect(effect["name"], row) for row in rows]
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise ValueError(f"{path}: an effect is not of the verdict's format ({error}).") from error


def _check_units(name: str, units: Mapping[str, str | None], path: Any) -> None:
    """Raises ValueError if a parameter is stated in another unit than its effect has; a unit may be left out."""
    expected = parameter_units(EFFECTS[name]) if name in EFFECTS else {}
    for parameter, unit in units.items():
        if unit is not None and unit != expected.get(parameter, unit):
            raise ValueError(
                f"{path}: {name} has {parameter} in {shown(unit)}, expected {shown(expected[parameter])}. Convert the "
                "values and their intervals."
            )
