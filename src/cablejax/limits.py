"""One table of sensible limits, for all numbers and files that users give."""

from __future__ import annotations

import dataclasses
import math
import numbers
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any


@dataclasses.dataclass(frozen=True)
class Limit:
    """The smallest and the largest sensible value of a quantity.

    Attributes:
        low: smallest value that is accepted.
        high: largest value that is accepted.
        unit: of both.
        whole: only whole numbers are accepted.
    """

    low: float
    high: float
    unit: str = ""
    whole: bool = False

    def __contains__(self, value: object) -> bool:
        kind = numbers.Integral if self.whole else numbers.Real
        # an integer may be larger than any float, and still compares with one
        return isinstance(value, kind) and not isinstance(value, bool) and bool(self.low <= value <= self.high)  # pyright: ignore[reportOperatorIssue]

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        if self.whole:
            return f"a whole number from {self.low} to {self.high}{unit}"
        return f"a number from {self.low:.9g} to {self.high:.9g}{unit}"


LIMITS: Mapping[str, Limit] = MappingProxyType(
    {
        # a cable and its table
        "length": Limit(1e-2, 1e2, "m"),
        "diameter": Limit(1e-6, 1.0, "m"),
        "linear_density": Limit(1e-6, 1e3, "kg/m"),
        "bending_stiffness": Limit(1e-9, 1e6, "N m^2"),
        "damping_time": Limit(0.0, 1e3, "s"),
        "rest_curvature": Limit(-1e3, 1e3, "1/m"),
        "friction_coefficient": Limit(0.0, 1e2),
        "keypoints": Limit(2, 1000, whole=True),
        # osmium and diamond are the next
        "density": Limit(0.0, 25_000.0, "kg/m^3"),
        "elastic_modulus": Limit(0.0, 1.5e12, "Pa"),
        # from the Moon's to three times the Earth's
        "gravity": Limit(1.0, 30.0, "m/s^2"),
        # a simulation
        "links": Limit(3, 1000, whole=True),
        "timestep": Limit(1e-6, 1.0, "s"),
        "friction_speed": Limit(1e-9, 1.0, "m/s"),
        "interval": Limit(1e-3, 3600.0, "s"),
        "commands": Limit(1, 100_000, whole=True),
        "factor": Limit(1e-3, 1e3),
        # rigid motions move no point farther than half of what both grippers move
        "amplification": Limit(0.5, 1e6),
        "trajectories": Limit(1, 1_000_000, whole=True),
        "shard_size": Limit(1, 10_000, "trajectories", whole=True),
        "noise": Limit(0.0, 0.1, "m"),
        "noise_share": Limit(0.0, 0.1, "of the cable's length"),
        "noise_mm": Limit(0.0, 100.0, "mm"),
        "probability": Limit(0.0, 1.0),
        "share": Limit(1e-6, 1.0),
        "length_scale": Limit(1e-6, 1e2, "m"),
        "angle": Limit(1e-6, math.pi, "rad"),
        "finite": Limit(-1e30, 1e30),
        "positive": Limit(1e-30, 1e30),
        "not_negative": Limit(0.0, 1e30),
        # a network and its training
        "at_least_three": Limit(3, 1000, whole=True),
        "history": Limit(1, 1000, whole=True),
        "width": Limit(1, 65_536, whole=True),
        "layers": Limit(1, 50, whole=True),
        "optimiser_steps": Limit(1, 1_000_000_000, whole=True),
        "batch": Limit(1, 1_000_000, whole=True),
        "learning_rate": Limit(1e-12, 1.0),
        # a recording
        "recorded_length": Limit(0.05, 20.0, "m"),
        "sample_interval": Limit(1e-4, 1.1, "s"),
        "reading": Limit(0.0, 1e7, "in the unit of the recording"),
        "coordinate": Limit(0.0, 1e4, "m or rad"),
        "speed": Limit(0.0, 1e3, "m/s or rad/s"),
        "duration": Limit(0.0, 1e4, "s"),
        # of a set-up in its recording's frame, whatever that is
        "origin": Limit(-1e4, 1e4, "m"),
        # since 1970 or since a start
        "stamp": Limit(0.0, 1e10, "s"),
        # bounds of a motion: places in millimetres are beyond
        "place": Limit(-100.0, 100.0, "m"),
        "gripper_speed": Limit(1e-4, 10.0, "m/s"),
        "turn_rate": Limit(1e-3, 100.0, "rad/s"),
        "bend_radius": Limit(1e-4, 10.0, "m"),
        "motion_duration": Limit(5.0, 300.0, "s"),
        # a target
        "target_angle": Limit(-4 * math.pi, 4 * math.pi, "rad"),
        "target_distance": Limit(0.0, 10.0, "lengths of the cable"),
        # a controller and a command
        "horizon": Limit(0, 1000, whole=True),
        "seed": Limit(0, 2**32 - 1, whole=True),
        "count": Limit(1, 1_000_000, whole=True),
        "count_from_zero": Limit(0, 1_000_000, whole=True),
        # files: text is read into memory as it is, arrays as they are when decompressed
        "text_bytes": Limit(0, 2**28, "bytes", whole=True),
        "array_bytes": Limit(0, 2**32, "bytes", whole=True),
        # of a bag, whose images are not read
        "bag_bytes": Limit(0, 2**40, "bytes", whole=True),
    }
)
"""Every limit by the name of its quantity. A value outside is a mistake, mostly in its unit."""


def require(value: object, limit: str, name: str, advice: str = "") -> None:
    """Rejects a value outside of its limit.

    Args:
        value: of any type.
        limit: key of `LIMITS`.
        name: of the value, for the message.
        advice: what to do, a sentence.

    Raises:
        ValueError: the value is no number, or outside of the limit.
    """
    if value not in LIMITS[limit]:
        raise ValueError(f"{name} is {shown(value)}, expected {LIMITS[limit]}.{advice and f' {advice}'}")


def check(settings: object, *names: str, **others: str) -> None:
    """Rejects settings of which a field is outside of its limit.

    Args:
        settings: a configuration.
        names: fields that have the name of their limit.
        others: limits of further fields.

    Raises:
        ValueError: names the field.
    """
    for field, limit in {**{name: name for name in names}, **others}.items():
        require(getattr(settings, field), limit, f"{type(settings).__name__}.{field}")


def make_hashable(settings: object, *fields: str) -> None:
    """Replaces lists and arrays in fields of a frozen dataclass by tuples: compiled code is kept by its settings."""

    def frozen(value: Any) -> Any:
        value = value.tolist() if hasattr(value, "__array__") else value
        return tuple(map(frozen, value)) if isinstance(value, list | tuple) else value

    for field in fields:
        object.__setattr__(settings, field, frozen(getattr(settings, field)))


def check_workspace(settings: Any) -> None:
    """Rejects settings whose field `workspace` is neither None nor two corners of a rectangle, the lowest first.

    Lists become tuples.

    Raises:
        ValueError: names the field.
    """
    make_hashable(settings, "workspace")
    if settings.workspace is None:
        return
    try:
        (left, bottom), (right, top) = settings.workspace
        # beyond all places is infinity, of which a planner can take no difference
        placed = all(value in LIMITS["place"] for value in (left, bottom, right, top))
        ordered = placed and left < right and bottom < top
    except (TypeError, ValueError):
        ordered = False
    if not ordered:
        raise ValueError(
            f"{type(settings).__name__}.workspace is {settings.workspace}, expected ((x, y) of the lowest, "
            f"(x, y) of the highest corner), each {LIMITS['place']}."
        )


def counted(count: int, noun: str) -> str:
    """A number of things in words: "1 sample", "2 samples"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def shown(value: object) -> str:
    """A value for a message, shortened where it is long."""
    if isinstance(value, int) and abs(value) >= 10**20:
        return f"an integer of {value.bit_length()} bits"
    text = repr(value) if not isinstance(value, numbers.Real) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
