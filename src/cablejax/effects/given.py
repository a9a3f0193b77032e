"""Effects with their parameters: staged in a plant, added to a simulator, read from a command line."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from cablejax.cable import Discretisation
from cablejax.effects import ARMS, LIBRARY
from cablejax.effects.base import CableEffect, Hook
from cablejax.effects.effect import Parameter
from cablejax.effects.physics import Physics
from cablejax.limits import require, shown

EFFECTS: Mapping[str, CableEffect] = {effect.name: effect for effect in (*LIBRARY, *ARMS)}
"""Every effect by its name in the gap log's format."""

TIMED: frozenset[Hook] = frozenset({"bending", "table", "mass"})
"""Hooks whose effects may begin and end in the middle of a run of the contact plant: they change numbers of its model,
not its parts."""

# A value beyond a bound by this share of it is at it.
_ROUNDED = 1e-5
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
        known = tuple(parameter_units(self.effect))
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
        effect = self.effect.sized(chain.cable.length)
        values, variant = effect.given(dict(self.parameters), chain)
        if variant not in effect.variants:
            known = shown(list(effect.variants))
            raise ValueError(f"{self.name}: {effect.variant_name} is {variant}, expected one of {known}.")
        bounded = []
        for parameter, value in zip(effect.parameters, values, strict=True):
            # verdicts round what they found at a bound
            beyond = max(parameter.low - value, value - parameter.high)
            if not beyond <= _ROUNDED * abs(value):
                raise ValueError(f"{self.name}: {self._out_of_bounds(effect, parameter, value, variant, chain)}")
            bounded.append(np.float32(min(max(value, parameter.low), parameter.high)))
        return effect.apply(physics, bounded, variant, chain)

    def _out_of_bounds(
        self, effect: CableEffect, parameter: Parameter, value: float, variant: int, chain: Discretisation
    ) -> str:
        """What a parameter is and may be, by the name and in the unit in which it was given."""
        low, high = (
            effect.reported([limit if p is parameter else p.centre for p in effect.parameters], variant, chain)
            for limit in (parameter.low, parameter.high)
        )
        # one that the fit knows by another name was given by the name of the verdict that it changes
        changed = [name for name, _ in self.parameters if low.get(name) != high.get(name)]
        name = parameter.name if parameter.name in dict(self.parameters) or not changed else changed[0]
        (first, unit), (last, _) = (
            one.get(name, (limit, parameter.unit)) for one, limit in ((low, parameter.low), (high, parameter.high))
        )
        number = dict(self.parameters).get(name, value)
        return f"{name} is {number:g}, expected {min(first, last):g} to {max(first, last):g} {unit}".rstrip() + "."

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
        ValueError: an effect of which there can be one at a time is given twice for one time, or see
            `GivenEffect.applied`.
    """
    ordered = sorted(effects, key=lambda one: one.effect.stage)
    for one, other in itertools.combinations(ordered, 2):
        if one.name == other.name and one.effect.alone and one.meets(other):
            raise ValueError(
                f"{one.name} is given twice ({one}; {other}), but a simulation has each effect once: leave one out, or "
                "let one end (until_s) before the other begins (from_s)."
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
            # Python reads 1_0 as 10
            value = float(number) if equals and "_" not in number else math.nan
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ValueError(
                f"Effect {shown(text)}: {shown(item)} is not of the form parameter=number with a finite number."
            )
        parameters.append((key.strip(), value))
    times = {key: value for key, value in parameters if key in ("from_s", "until_s")}
    if sum(key in times for key, _ in parameters) > len(times):
        raise ValueError(f"Effect {shown(text)} has a time twice, expected from_s and until_s once.")
    return GivenEffect(name.strip(), tuple(pair for pair in parameters if pair[0] not in times), **times)


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
            if effect.effect.hook in TIMED:
                advice = "The contact plant can."
            else:
                timed = ", ".join(name for name, other in EFFECTS.items() if other.hook in TIMED)
                advice = f"None can: leave the times out. The contact plant can with {timed}."
            raise ValueError(
                f"The simulator {simulator} cannot let {effect.name} begin or end in the middle of a run (from_s, "
                f"until_s). {advice}"
            )
        if effect.effect.hook not in hooks:
            others = ", ".join(name for name, theirs in able.items() if effect.effect.hook in theirs) or "none"
            raise ValueError(
                f"The simulator {simulator} cannot simulate {effect.name}: it has no hook for {effect.effect.hook}. "
                f"Simulators that have: {others}."
            )


def number_text(value: float) -> str:
    """A number as short as it can be without loss."""
    short = f"{value:g}"
    return short if float(short) == value else repr(float(value))


def parameter_units(effect: CableEffect) -> dict[str, str]:
    """Names of the verdict that an effect takes, and their units."""
    chain, units = Discretisation(), {}
    values = [p.centre for p in effect.parameters]
    for variant in effect.variants[:2]:
        units |= {name: unit for name, (_, unit) in effect.reported(values, variant, chain).items()}
    return units


OPTIONAL = frozenset({"hardening", "static_excess", "across", "delay_s"})
"""Parameters beyond the format's, which need not be given; see `CableEffect.given`."""
