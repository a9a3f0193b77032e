"""Effects with their parameters: staged in a plant, added to a simulator, read from a verdict or a command line."""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from cablejax.cable import Discretisation
from cablejax.effects import ARMS, LIBRARY
from cablejax.effects.base import CableEffect, Hook
from cablejax.effects.effect import Parameter
from cablejax.effects.physics import Physics
from cablejax.limits import require, shown
from cablejax.text_file import read_json, version_of

EFFECTS: Mapping[str, CableEffect] = {effect.name: effect for effect in (*LIBRARY, *ARMS)}
"""Every effect by its name in the gap log's format."""

VERDICT_SCHEMA = "cablejax-verdict/1"
"""Format and version of `verdict.json`."""


# Parameters that say which: a gripper, a keypoint, a direction.
_CHOICES = frozenset({"index", "across", *(effect.variant_name for effect in EFFECTS.values())})


@dataclasses.dataclass(frozen=True)
class GivenEffect:
    """One effect and the values of its parameters, by the names of the verdict's format.

    Attributes:
        name: of the effect.
        parameters: pairs of name and value, SI units.
        from_s: when it begins [s]: a disturbance in the middle of a run, which the contact plant stages.
        until_s: when it ends [s]; None = never.

    Raises:
        ValueError: there is no such effect or parameter, a parameter is missing, or a value is out of its bounds.
    """

    name: str
    parameters: tuple[tuple[str, float], ...]
    from_s: float = 0.0
    until_s: float | None = None

    def __post_init__(self):
        if not isinstance(self.name, str) or self.name not in EFFECTS:
            raise ValueError(f"There is no effect {shown(self.name)}. Expected one of: {', '.join(sorted(EFFECTS))}.")
        if not 0 <= self.from_s < (math.inf if self.until_s is None else self.until_s):
            raise ValueError(
                f"{self.name}: from_s is {self.from_s}, until_s {self.until_s}; expected 0 <= from_s < until_s [s]."
            )
        object.__setattr__(self, "parameters", tuple((str(n), v) for n, v in self.parameters))
        known = tuple(_parameter_units(self.effect))
        required = [name for name in known if name not in OPTIONAL]
        named = dict(self.parameters)
        if len(named) < len(self.parameters):
            raise ValueError(f"{self.name} has a parameter twice: {', '.join(name for name, _ in self.parameters)}.")
        example = f"{self.name}:{','.join(f'{name}=...' for name in required)}"
        for name, value in named.items():
            if name not in known:
                raise ValueError(f"{self.name} has no parameter {shown(name)}, expected {', '.join(known)}: {example}.")
            require(value, "finite", f"{self.name}: {name}")
            if name in _CHOICES and value != int(value):
                raise ValueError(f"{self.name}: {name} is {value:g}, expected a whole number.")
        missing = [name for name in required if name not in named]
        if missing:
            raise ValueError(f"{self.name} lacks {', '.join(missing)}. Expected {example}.")

    @property
    def lasting(self) -> bool:
        """Whether it acts all the time."""
        return self.from_s == 0 and self.until_s is None

    def acts_at(self, time: float) -> bool:
        """Whether it acts at this time [s]."""
        return self.from_s <= time and (self.until_s is None or time < self.until_s)

    def meets(self, other: GivenEffect) -> bool:
        """Whether there is a time at which both act."""
        first, second = sorted((self, other), key=lambda one: one.from_s)
        return first.until_s is None or second.from_s < first.until_s

    @property
    def effect(self) -> CableEffect:
        """Its entry of the library."""
        return EFFECTS[self.name]

    def applied(self, physics: Physics, chain: Discretisation) -> Physics:
        """The physics with this effect.

        Raises:
            ValueError: a parameter is out of its bounds.
        """
        values, variant = self.effect.given(dict(self.parameters), chain)
        if variant not in self.effect.variants:
            raise ValueError(f"{self.name}: {self.effect.variant_name} {variant} does not exist.")
        for parameter, value in zip(self.effect.parameters, values, strict=True):
            if not parameter.low * (1 - 1e-9) <= value <= parameter.high:
                raise ValueError(f"{self.name}: {self._out_of_bounds(parameter, value, variant, chain)}")
        return self.effect.apply(physics, [np.float32(v) for v in values], variant, chain)

    def _out_of_bounds(self, parameter: Parameter, value: float, variant: int, chain: Discretisation) -> str:
        """What a parameter is and may be, by the name and in the unit in which it was given."""
        own = [p.name for p in self.effect.parameters]
        # one that the fit knows by another name was given by the name of the verdict
        given = [name for name, _ in self.parameters if name == parameter.name]
        name, *_ = [*given, *(name for name, _ in self.parameters if name not in own), parameter.name]
        limits = []
        for limit in (parameter.low, parameter.high):
            values = [limit if p is parameter else p.centre for p in self.effect.parameters]
            shown, unit = self.effect.reported(values, variant, chain).get(name, (limit, parameter.unit))
            limits.append(shown)
        number = dict(self.parameters).get(name, value)
        return f"{name} is {number:g}, expected {min(limits):g} to {max(limits):g} {unit}".rstrip() + "."

    def __str__(self) -> str:
        """The effect as `parse_effect` reads it back, without loss."""
        given = list(self.parameters)
        if self.from_s > 0:
            given.append(("from_s", self.from_s))
        if self.until_s is not None:
            given.append(("until_s", self.until_s))
        return f"{self.name}:{','.join(f'{name}={number_text(value)}' for name, value in given)}"


def with_effects(physics: Physics, effects: Iterable[GivenEffect], chain: Discretisation) -> Physics:
    """The physics with every effect, applied in order of their stages.

    Raises:
        ValueError: an effect of which there can be one at a time is given twice, or see `GivenEffect.applied`.
    """
    ordered = sorted(effects, key=lambda one: one.effect.stage)
    for one, other in itertools.combinations(ordered, 2):
        if one.name == other.name and one.effect.alone and one.meets(other):
            raise ValueError(
                f"{one.name} is given twice ({one}; {other}), and a simulation has one at a time: leave one out."
            )
    for effect in ordered:
        physics = effect.applied(physics, chain)
    return physics


def parse_effect(text: str) -> GivenEffect:
    """An effect as written on a command line: `name:parameter=value,parameter=value`, SI units.

    Among the parameters may be `from_s` and `until_s`, see `GivenEffect`.

    Raises:
        ValueError: the text is not of this form, or see `GivenEffect`.
    """
    name, _, rest = text.partition(":")
    parameters = []
    for item in filter(None, (part.strip() for part in rest.split(","))):
        key, equals, number = item.partition("=")
        try:
            value = float(number) if equals else math.nan
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ValueError(f"Effect {shown(text)}: {shown(item)} is not of the form parameter=number.")
        parameters.append((key.strip(), value))
    times = {key: value for key, value in parameters if key in ("from_s", "until_s")}
    return GivenEffect(name.strip(), tuple(pair for pair in parameters if pair[0] not in times), **times)


def effects_of_verdict(path: str | os.PathLike[str]) -> tuple[GivenEffect, ...]:
    """The effects that a verdict names, with their estimated parameters. Several pieces become several effects.

    Raises:
        ValueError: the file is no verdict, or it names no effect ("none" and "unknown").
    """
    verdict = read_verdict_json(path)
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
    """Sets of effects, equally probable: which explanation holds, and its parameters, as uncertain as a verdict is.

    Of a verdict of an older version, which holds no such draws, the effects that it names.

    Raises:
        ValueError: as `effects_of_verdict`.
    """
    named = effects_of_verdict(path)
    posterior = read_verdict_json(path).get("posterior") or []
    try:
        drawn = tuple(
            tuple(GivenEffect(one["name"], tuple(one["parameters"].items())) for one in draw) for draw in posterior
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: posterior is not of the verdict's format ({error}).") from error
    return drawn or (named,)


def read_verdict_json(path: str | os.PathLike[str]) -> dict[str, Any]:
    """A verdict's JSON object, of the schema that this version writes; its fields are not looked at.

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


def check_hooks(
    effects: Sequence[GivenEffect],
    hooks: frozenset[Hook],
    simulator: str,
    able: Mapping[str, Any],
    changing: frozenset[Hook] = frozenset(),
) -> None:
    """Raises `ValueError` if an effect acts through a hook that a simulator does not honour.

    Args:
        effects: to be simulated.
        hooks: of the simulator.
        simulator: its name, for the message.
        able: other simulators by name with their hooks, for the message.
        changing: hooks whose effects may begin and end in the middle of a run.
    """
    for effect in effects:
        if not effect.lasting and effect.effect.hook not in changing:
            raise ValueError(
                f"The simulator {simulator} cannot let {effect.name} begin or end in the middle of a run (from_s, "
                "until_s). The contact plant can, with effects on bending, mass and the table."
            )
        if effect.effect.hook not in hooks:
            others = ", ".join(name for name, theirs in able.items() if effect.effect.hook in theirs) or "none"
            raise ValueError(
                f"The simulator {simulator} cannot simulate {effect.name}: it has no hook for {effect.effect.hook}. "
                f"Simulators that have: {others}."
            )


def _pieces(effect: Any, path: Any) -> list[GivenEffect]:
    try:
        values = {name: entry["value"] for name, entry in effect["parameters"].items()}
        _check_units(effect["name"], {name: entry.get("unit") for name, entry in effect["parameters"].items()}, path)
        count = max((len(value) for value in values.values() if isinstance(value, list)), default=1)
        rows = [
            tuple((name, value[i] if isinstance(value, list) else value) for name, value in values.items())
            for i in range(count)
        ]
        return [GivenEffect(effect["name"], row) for row in rows]
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise ValueError(f"{path}: an effect is not of the verdict's format ({error}).") from error


def _check_units(name: str, units: Mapping[str, str | None], path: Any) -> None:
    """Raises ValueError if a parameter is stated in another unit than its effect has; a unit may be left out."""
    expected = _parameter_units(EFFECTS[name]) if name in EFFECTS else {}
    for parameter, unit in units.items():
        if unit is not None and unit != expected.get(parameter, unit):
            raise ValueError(
                f"{path}: {name} has {parameter} in {shown(unit)}, expected {shown(expected[parameter])}. Convert the "
                "values and their intervals."
            )


def number_text(value: float) -> str:
    """A number as short as it can be without loss."""
    short = f"{value:g}"
    return short if float(short) == value else repr(float(value))


def _parameter_units(effect: CableEffect) -> dict[str, str]:
    """Names of the verdict that an effect takes, and their units."""
    chain, units = Discretisation(), {}
    values = [p.centre for p in effect.parameters]
    for variant in effect.variants[:2]:
        units |= {name: unit for name, (_, unit) in effect.reported(values, variant, chain).items()}
    return units


OPTIONAL = frozenset({"hardening", "static_excess", "across", "delay_s"})
"""Parameters beyond the format's, which need not be given; see `CableEffect.given`."""
