"""The plan of the cases: kinds, families of simulators, severities."""

from __future__ import annotations

import dataclasses
import hashlib

import numpy as np

from .effects import SPECIFIED
from .unknown import UNSPECIFIED

B_EFFECTS = (
    "bending_stiffness", "stiffness_profile", "intrinsic_curvature", "bending_damping", "table_friction",
    "friction_patch", "viscous_drag", "gravity_tilt", "linear_density", "lumped_mass", "gripper_rotation_offset",
    "obstacle", "actuation_gain", "actuation_lag", "camera_similarity", "keypoint_bias", "camera_lag",
)  # fmt: skip
C_EFFECTS = (
    "bending_stiffness", "table_friction", "gravity_tilt", "actuation_gain",
    "actuation_lag", "camera_similarity", "keypoint_bias", "camera_lag",
)  # fmt: skip
FRICTION_GROUP = {
    "bending_stiffness", "table_friction", "linear_density", "viscous_drag", "bending_damping", "bending_hysteresis",
}  # fmt: skip
"""Effects of which no two make a pair: in slow motion they are nearly one number."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One log to make.

    Attributes:
        index: in the plan; with the seed it determines everything.
        kind: "none", "single", "pair" or "unknown".
        family: a letter of `families.FAMILIES`.
        effects: names.
        severity: wanted gap over noise; 0 without effect.
    """

    index: int
    kind: str
    family: str
    effects: tuple[str, ...] = ()
    severity: int = 0

    def name(self, seed: int) -> str:
        """Of its files: eight hexadecimal digits that say nothing."""
        return hashlib.sha256(f"{seed}/{self.index}/name".encode()).hexdigest()[:8]


def stored_plan(seed: int) -> list[Case]:
    """At least 150 cases by three families."""
    rng = np.random.default_rng([seed, 1])
    rows: list[tuple[str, str, tuple[str, ...], int]] = []
    rows += [("none", family, (), 0) for family in "A" * 22 + "B" * 8 + "C" * 4]
    for number, name in enumerate(SPECIFIED):
        families = ["A", "B" if name in B_EFFECTS else "A", "A", "A"]
        if name in C_EFFECTS:
            families[2 if number % 2 else 3] = "C"
        severities = (4, 4, 8, 1 if number % 2 else 2)
        rows += [("single", family, (name,), severity) for family, severity in zip(families, severities, strict=True)]
    for number in range(16):
        family = "AAABAAACAAABAAAB"[number]
        rows.append(("pair", family, _pair(rng, family), 8 if number % 3 == 2 else 4))
    for number in range(17):
        name = UNSPECIFIED[number % len(UNSPECIFIED)]
        family = "A" if name not in ("barrel_distortion", "tracking_bursts", "camera_drift") else "ABC"[number % 3]
        rows.append(("unknown", family, (name,), 4 if number < len(UNSPECIFIED) else 8))
    order = rng.permutation(len(rows))
    return [Case(index, *rows[row]) for index, row in enumerate(order)]


def development_plan(seed: int) -> list[Case]:
    """44 cases of family A, for calibration."""
    rng = np.random.default_rng([seed, 2])
    rows: list[tuple[str, str, tuple[str, ...], int]] = [("none", "A", (), 0)] * 10
    rows += [("single", "A", (name,), 4) for name in SPECIFIED]
    rows += [("pair", "A", _pair(rng, "A"), 4) for _ in range(6)]
    rows += [("unknown", "A", (str(name),), 4) for name in rng.choice(UNSPECIFIED, 6, replace=False)]
    return [Case(index, *rows[row]) for index, row in enumerate(rng.permutation(len(rows)))]


def small_plan(seed: int) -> list[Case]:
    """Five cases of family A, to see it work."""
    del seed
    rows = [
        ("none", "A", (), 0), ("single", "A", ("camera_similarity",), 4),
        ("single", "A", ("gripper_rotation_offset",), 4),
        ("pair", "A", ("intrinsic_curvature", "camera_lag"), 4), ("unknown", "A", ("camera_drift",), 4),
    ]  # fmt: skip
    return [Case(index, *row) for index, row in enumerate(rows)]


def hard_plan(seed: int) -> list[Case]:
    """42 cases of families A and B in which more than one thing is wrong, or something that the library does not have.

    24 pairs, 12 effects outside the library, 6 without effect.
    """
    rng = np.random.default_rng([seed, 3])
    rows: list[tuple[str, str, tuple[str, ...], int]] = [("none", family, (), 0) for family in "AAAABB"]
    for number in range(24):
        family = "AAB"[number % 3]
        rows.append(("pair", family, _pair(rng, family), 8 if number % 3 == 2 else 4))
    for name in rng.choice(UNSPECIFIED, 12, replace=False):
        rows.append(("unknown", "A", (str(name),), 4))
    return [Case(index, *rows[row]) for index, row in enumerate(rng.permutation(len(rows)))]


def commissioning_plan(seed: int) -> list[Case]:
    """Two cases without any effect of every family, as a user would record on a set-up before it is trusted."""
    del seed
    return [Case(index, "none", family, (), 0) for index, family in enumerate("AABBCC")]


def space_plan(seed: int) -> list[Case]:
    """24 cases of family D, whose law of contact the diagnosis does not have: mostly friction and stiffness."""
    rng = np.random.default_rng([seed, 4])
    names = ["bending_stiffness", "table_friction"] * 4 + [
        "linear_density", "viscous_drag", "bending_damping", "stiffness_profile", "intrinsic_curvature", "gravity_tilt",
        "lumped_mass", "gripper_rotation_offset", "actuation_lag", "camera_similarity",
    ]  # fmt: skip
    rows: list[tuple[str, str, tuple[str, ...], int]] = [("none", "D", (), 0)] * 6
    rows += [("single", "D", (name,), 8 if number % 3 == 2 else 4) for number, name in enumerate(names)]
    return [Case(index, *rows[row]) for index, row in enumerate(rng.permutation(len(rows)))]


PLANS = {
    "stored": stored_plan,
    "development": development_plan,
    "hard": hard_plan,
    "small": small_plan,
    "commissioning": commissioning_plan,
    "space": space_plan,
}


def _pair(rng: np.random.Generator, family: str) -> tuple[str, ...]:
    names = {"A": SPECIFIED, "B": B_EFFECTS, "C": C_EFFECTS}[family]
    while True:
        one, two = sorted(str(name) for name in rng.choice(names, 2, replace=False))
        if not {one, two} <= FRICTION_GROUP and not {one, two} <= {"camera_lag", "actuation_lag"}:
            return one, two
