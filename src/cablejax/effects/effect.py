"""Effects as a diagnosis sees them, of any system: a name, parameters with priors, null values."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from cablejax.limits import make_hashable


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One parameter of an effect.

    A fit works in coordinates `z`, in which the prior is a normal distribution: `value = centre + scale z`, or
    `value = centre exp(scale z)` where `log` is set.

    Attributes:
        name: as in the verdict.
        unit: "" for a pure number.
        low, high: bounds of the value.
        centre: prior median.
        scale: prior standard deviation, of the logarithm where `log` is set.
        log: the value is positive and known in its order of magnitude.
        difference: step of forward differences, in prior standard deviations.
    """

    name: str
    unit: str
    low: float
    high: float
    centre: float
    scale: float
    log: bool = False
    difference: float = 0.03

    def __post_init__(self):
        ordered = self.low <= self.centre <= self.high and (not self.log or self.low > 0)
        if not (ordered and self.scale > 0 and self.difference > 0):
            raise ValueError(
                f"Parameter {self.name!r}: expected low <= centre <= high, scale and difference > 0, and low > 0 if "
                f"log; got low {self.low}, centre {self.centre}, high {self.high}, scale {self.scale}, difference "
                f"{self.difference}, log {self.log}."
            )

    def value(self, z: Any) -> Any:
        """The value at coordinate `z`, a NumPy or JAX number."""
        if self.log:
            return self.centre * z.__array_namespace__().exp(self.scale * z)
        return self.centre + self.scale * z

    def coordinate(self, value: float) -> float:
        """The coordinate `z` of a value."""
        if self.log:
            return float(np.log(value / self.centre) / self.scale)
        return (value - self.centre) / self.scale

    @property
    def z_bounds(self) -> tuple[float, float]:
        """Bounds of the coordinate."""
        return self.coordinate(self.low), self.coordinate(self.high)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Effect:
    """Something that a real system does and its nominal simulator does not.

    The simulator implements the effect; a diagnosis needs only these fields. Effects of your own simulator are
    instances of this class, see `cablejax.diagnose.Simulator`; effects of a cable are subclasses that change its
    physics, see `CableEffect`.

    Attributes:
        name: as in the verdict.
        parameters: of the effect.
        null: parameter values at which nothing changes. An effect that differs from a nominal value has a ratio to it.
        amplitude: which parameter makes the effect larger, counted from its null value; None = no single one does.
        reversible: whether that parameter may lie on the other side of its null value too.
        variants: discrete choices that are fitted one by one, for example the gripper.
        variant_name: what a variant is called in the verdict; None = there is only one.
        repeatable: whether one explanation may have several of them, of different variants.
    """

    name: str
    parameters: tuple[Parameter, ...]
    null: tuple[float, ...]
    amplitude: int | None = None
    reversible: bool = False
    variants: Sequence[int] = (0,)
    variant_name: str | None = None
    repeatable: bool = False

    def __post_init__(self):
        make_hashable(self, "parameters", "null", "variants")
        names = [parameter.name for parameter in self.parameters]
        if not self.name or len(set(names)) < len(names):
            raise ValueError(f"Effect {self.name!r} has the parameters {names}, expected a name, and every one once.")
        if len(self.parameters) != len(self.null) or not self.parameters:
            raise ValueError(
                f"Effect {self.name!r} has {len(self.parameters)} parameters and {len(self.null)} null values, "
                "expected as many of one as of the other, and at least one."
            )
        if any(math.isnan(value) for value in self.null):
            raise ValueError(f"Effect {self.name!r} has the null values {self.null}, expected numbers.")
        if self.amplitude is not None and not 0 <= self.amplitude < len(self.parameters):
            raise ValueError(
                f"Effect {self.name!r}: amplitude is {self.amplitude}, expected the index of one of its "
                f"{len(self.parameters)} parameters, or None."
            )
        if self.amplitude is not None and self.reversible:
            parameter, null = self.parameters[self.amplitude], self.null[self.amplitude]
            if parameter.log and null in (0.0, math.inf):
                raise ValueError(
                    f"Effect {self.name!r} is reversible, but its parameter {parameter.name!r} is positive and has the "
                    f"null value {null}: its opposite does not exist. Leave reversible out."
                )
        if not self.variants:
            raise ValueError(f"Effect {self.name!r} has no variant, expected one at least: variants=(0,).")

    def starts(self, context: Any) -> Sequence[tuple[int, Sequence[float]]]:
        """Pairs (variant, values) from which fits begin; enough of them that one is within reach of the truth.

        Unless a subclass knows better: each parameter one prior standard deviation from its median, the others there.
        One whose median is its null value may switch the whole effect off there, as `amplitude` does: each of the
        others is moved together with it, too. A place, a time or a threshold has more minima than these starts reach:
        list enough values of it.

        Args:
            context: what the simulator knows of the recording, see `Simulator.starts`.
        """
        del context
        every, medians = range(len(self.parameters)), tuple(p.centre for p in self.parameters)
        switches = [i for i in every if medians[i] == self.null[i] and self.amplitude in (None, i)]
        starts = self._moved([medians], switches or every)
        if switches:
            starts += self._moved([values for values in starts if values != medians], every)
        return [(v, values) for v in self.variants for values in dict.fromkeys(starts) if values != medians]

    def _moved(self, points: Sequence[tuple[float, ...]], which: Iterable[int]) -> list[tuple[float, ...]]:
        """Each point with one of its values a standard deviation below and above the median, within bounds."""
        return [
            (*point[:i], float(np.clip(one.value(np.float64(z)), one.low, one.high)), *point[i + 1 :])
            for point in points
            for i in which
            for one in (self.parameters[i],)
            for z in (-1.0, 1.0)
        ]
