"""Names of effects, parameters, places, motions and quantities in plain words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from cablejax.diagnose.diagnosis import CableDiagnosis, Gap, NamedEffect, NextMotion, Ranked
from cablejax.diagnose.judgement import effect_title, listed, share

_DECIMALS = 6
# Grippers that move by less than this in a sample rest [m, rad].
_AT_REST = 1e-9

EFFECTS: dict[str, str] = {
    "bending_stiffness": "the bending stiffness differs everywhere by one factor",
    "stiffness_profile": "the bending stiffness differs over part of the cable",
    "intrinsic_curvature": "the cable is curved at rest",
    "plasticity": "bends beyond a yield curvature stay",
    "bending_hysteresis": "internal friction in bending, independent of speed",
    "bending_damping": "the internal viscous damping differs",
    "axial_stretch": "the cable stretches",
    "table_friction": "the friction of the table differs everywhere",
    "friction_patch": "the friction differs inside a region of the table",
    "viscous_drag": "a drag that grows with speed",
    "quadratic_drag": "a drag that grows with the square of the speed",
    "gravity_tilt": "the table is tilted",
    "linear_density": "the mass per length differs",
    "lumped_mass": "extra mass sits on the cable, such as a connector or markers",
    "gripper_slip": "the cable slides through a gripper",
    "gripper_rotation_offset": "the cable is gripped at another angle than measured",
    "gripper_compliance": "the grasp yields in rotation",
    "actuation_gain": "the arm moves more or less than commanded",
    "actuation_lag": "the arm moves later than commanded",
    "camera_similarity": "scale, rotation or offset of the camera's frame",
    "keypoint_bias": "keypoints sit off their nominal places",
    "camera_lag": "the keypoints are stamped late",
    "obstacle": "a fixed object touches the cable",
}
"""Description of each effect of the format."""

_PARAMETERS: dict[str, str] = {
    "centre_m": "centre, from gripper 0",
    "length_m": "length between the grippers",
    "width_m": "length of the section",
    "ratio": "ratio to the stated value",
    "stiffness_over_density_m4_per_s2": "EI over the mass per length",
    "bending_stiffness_n_m2": "bending stiffness EI",
    "drag_at_speed_per_s": "linear and quadratic drag together, per mass, at the keypoints' usual speed",
    "speed_m_per_s": "speed of the keypoints, root mean square",
    "constant_offset_m": "constant offset of the keypoints within a recording, root mean square",
    "curvature_per_m": "rest curvature",
    "yield_curvature_per_m": "yield curvature",
    "moment_n_m": "largest moment of internal friction",
    "transition_curvature_per_m": "curvature over which it builds up",
    "stiffness_n": "axial stiffness EA",
    "coefficient": "Coulomb coefficient",
    "static_excess": "excess of static friction, relative",
    "x_m": "x on the table",
    "y_m": "y on the table",
    "hardening": "hardening beyond the yield",
    "radius_m": "radius",
    "coefficient_n_s_per_m2": "drag per length and speed",
    "angle_rad": "angle",
    "direction_rad": "direction on the table",
    "mass_kg": "mass",
    "gripper": "gripper",
    "time_s": "time",
    "delay_s": "pure delay, a part of this time",
    "distance_m": "change of the free length",
    "stiffness_n_m_per_rad": "stiffness of the grasp",
    "gain": "gain",
    "scale": "scale",
    "index": "keypoint",
    "across": "along the cable (0) or across it (1)",
    "offset_m": "offset",
}

MOTIONS: dict[str, str] = {
    "designed": "Its commands are in next_motion.csv for an arm, and in next_motion.npz for a simulated plant.",
    "mirror": "Start with the cable mirrored across the line between the grippers, close in, and go back.",
    "translation": "Move both grippers across the cable by 20 % of its length, hold, and go back.",
    "ramp_hold": "Close in fast, hold, go back, then the same at 30 % of the speed.",
    "overload_return": "Bend the cable tightly, to 30 % of its length between the grippers, and go back.",
    "taut": "Pull the cable nearly straight, to 99.5 % of its length, hold, and go back.",
    "shifted_repeat": "Close in and go back; repeat it shifted across the table by 20 % of the cable's length.",
}
"""Instruction for each motion of `cablejax.diagnose.safe_motions`, and for a designed one."""


def instruction(following: NextMotion) -> str:
    """What to do with the grippers; says so where the motion that was judged is cut off, as that of a long cable is."""
    text, seconds = MOTIONS[following.motion], following.interval * (len(following.poses) - 1)
    if following.motion == "designed" or np.ptp(following.poses[-2:], axis=0).max() < _AT_REST:
        return text
    return f"{text} At the speed that is allowed, the first {seconds:.0f} s of it were judged; it takes longer."


def explanation_title(names: str) -> str:
    """Effects joined by " + " as words: "a, b and c"."""
    return listed([effect_title(name) for name in names.split(" + ")])


def parameter_title(name: str) -> str:
    """A parameter in words; one that is not of the format keeps its name."""
    return _PARAMETERS.get(name, name.replace("_", " "))


def quantity(value: Any, unit: str, ci90: Any = None, *, interval: bool = True) -> str:
    """A value with its interval and unit, to the digits that the interval supports: "9.3 mm (8.7 to 10.0)".

    Lengths below 5 cm come in millimetres; a number that needs more than six decimals has an exponent. Lists are
    joined. With `interval` false the interval is left out.
    """
    if isinstance(value, (list, tuple)):
        intervals: Sequence[Any] = [None] * len(value) if ci90 is None else ci90
        return ", ".join(quantity(v, unit, c, interval=interval) for v, c in zip(value, intervals, strict=True))
    if value is None or not math.isfinite(value):
        return "n/a"
    if isinstance(value, int):
        return f"{value} {unit}".strip()
    ends = list(ci90) if ci90 is not None and all(math.isfinite(x) for x in ci90) else []
    scale, shown = 1.0, unit
    if unit == "m" and max(abs(x) for x in (value, *ends)) < 0.05:
        scale, shown = 1e3, "mm"
    numbers = [scale * x for x in (value, *ends)]
    digits = _digits(numbers)
    value, *ends = (f"{number:.{digits}f}" if digits <= _DECIMALS else f"{number:.3g}" for number in numbers)
    text = f"{value} {shown}".strip()
    return f"{text} ({ends[0]} to {ends[1]})" if ends and interval else text


def millimetres(value: float) -> str:
    """A length in millimetres as `short` writes it: "0.04 mm", "1.3 mm", "27 mm"; "n/a" where it is not known."""
    return f"{short(value)} mm" if math.isfinite(value) else "n/a"


def error_falls(gap: Gap) -> str:
    """The error before and after, as in "77 → 12 mm"."""
    return f"{short(gap.before_rmse_mm)} → {millimetres(gap.after_rmse_mm)}"


def short(value: float) -> str:
    """A number to two digits, at least whole tenths below ten: "0.04", "1.3", "27"."""
    if abs(value) >= 9.95:
        return f"{value:.0f}"
    return f"{value:.1f}" if abs(value) >= 0.095 or value == 0 else f"{value:.2f}"


def effect_place(effect: NamedEffect) -> str:
    """Where an effect acts, in words: keypoints, a gripper, a section, a time; "" where it acts everywhere."""
    index, gripper = (effect.parameters.get(name) for name in ("index", "gripper"))
    along, time, table = (effect.location.get(key) for key in ("along_cable_m", "time_s", "table_m"))
    if index is not None and isinstance(index.value, list):
        return f"at keypoints {listed([str(i) for i in sorted(index.value)])}"
    parts = []
    if gripper is not None:
        grippers = gripper.value if isinstance(gripper.value, list) else [gripper.value]
        parts.append(f"at gripper{'s' * (len(grippers) > 1)} {listed(list(map(str, grippers)))}")
    elif along is not None:
        low, high = along
        parts.append(
            f"at {low:.2f} m from gripper 0" if high - low < 5e-3 else f"{low:.2f} to {high:.2f} m from gripper 0"
        )
    if table is not None:
        parts.append(f"at x = {table[0]:.2f} m, y = {table[1]:.2f} m on the table")
    if time is not None:
        parts.append(f"{time:.1f} s into the episode")
    return ", ".join(parts)


def between(low: float, high: float) -> str:
    """An interval of shares, "88 % to 93 %"; a single one where both ends read the same."""
    ends = share(low), share(high)
    return f"{ends[0]} throughout" if ends[0] == ends[1] else f"{ends[0]} to {ends[1]}"


def _digits(numbers: Sequence[float]) -> int:
    """Decimals that show an interval to a few per cent of its width, or a value to three digits."""
    size = 0.25 * abs(numbers[-1] - numbers[1]) if len(numbers) > 2 else 0.0
    size = size or 0.01 * abs(numbers[0])
    return max(math.ceil(-math.log10(size)), 0) if size > 0 else 1


def share_removed(ranked: Ranked) -> str:
    """The share of the gap that an effect removes; "n/a" where it was not computed."""
    return share(ranked.held_out_shrinkage) if math.isfinite(ranked.held_out_shrinkage) else "n/a"


def explained_label(diagnosis: CableDiagnosis) -> str:
    """Legend of the curve with the explanation."""
    if not diagnosis.effects:
        return "with the best explanation found, not named"
    names = list(dict.fromkeys(effect_title(effect.name) for effect in diagnosis.effects))
    return f"with {names[0]}" if len(names) == 1 else "with the named effects"
