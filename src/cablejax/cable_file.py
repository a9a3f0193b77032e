"""Reads and writes a cable as a TOML file whose keys name their units.

The same keys describe the cable in trained weights and in gap logs, so that a cable has one written form.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cablejax.cable import Cable, Discretisation
from cablejax.limits import LIMITS, require, shown
from cablejax.text_file import read_toml, unknown_key, version_of
from cablejax.whole_file import whole_file

if TYPE_CHECKING:
    from cablejax.types import GapLog

_SLENDER = 0.01

SCHEMA = "cablejax-cable/1"
"""Name and version of the file's keys; a file without `schema` is of version 1."""

NUMBERS: Mapping[str, tuple[str, str]] = {
    "length_m": ("length", "free length between the grippers"),
    "diameter_m": ("diameter", "thickness"),
    "linear_density_kg_per_m": ("linear_density", "mass per length: weigh a metre"),
    "bending_stiffness_n_m2": ("bending_stiffness", "EI"),
    "bending_damping_s": ("damping_time", "time constant of internal damping, 0 for none"),
    "rest_curvature_per_m": ("rest_curvature", "curvature without load, 0 for a straight cable"),
    "friction_coefficient": ("friction_coefficient", "kinetic, between cable and table, 0 for a smooth table"),
}
"""Every number of a cable by its key: field of `Cable`, which is also the name of its limit, and what it is."""

OTHERS = ("keypoints", "keypoint_arclength_m", "grasp")
"""Keys that are no single number."""

KEYS: Mapping[str, str] = {
    **{name: key for key, (name, _) in NUMBERS.items()},
    "n_keypoints": "keypoints",
    "marks": "keypoint_arclength_m",
    "grasp": "grasp",
}
"""Key in the file of every field of `Cable`."""

_UNITS = {**{key: LIMITS[name].unit for key, (name, _) in NUMBERS.items()}, **dict.fromkeys(OTHERS, "m")}
_OPTIONAL = {"rest_curvature_per_m": 0.0}
_EXAMPLE = "Write an example with `cablejax cable --out cable.toml`."


def read_cable(path: str | os.PathLike[str]) -> Cable:
    """The cable in a TOML file.

    Args:
        path: of a file with the keys of `NUMBERS`, and `keypoints` or `keypoint_arclength_m`.

    Raises:
        ValueError: the file cannot be read, is no TOML, is of a newer version, or does not describe a cable; says which
            key is wrong.
    """
    try:
        fields = read_toml(path)
    except (ValueError, OSError) as error:
        raise ValueError(f"The cable could not be read. {error} {_EXAMPLE}") from None
    version_of(fields.pop("schema", SCHEMA), SCHEMA, path)
    return cable_from_fields(fields, str(path))


def write_cable(path: str | os.PathLike[str], cable: Cable) -> None:
    """Writes a cable as commented TOML, whole or not at all."""
    with whole_file(Path(path)) as stream:
        stream.write(cable_text(cable).encode())


def cable_text(cable: Cable) -> str:
    """A cable as commented TOML, which `read_cable` reads back without loss."""
    fields = cable_to_fields(cable)
    lines = [
        (f"{key} = {float(fields[key])!r}", f"{what} [{LIMITS[name].unit}]" if LIMITS[name].unit else what)
        for key, (name, what) in NUMBERS.items()
    ]
    if cable.marks is None:
        what = "observed points, evenly spaced, both ends included; or keypoint_arclength_m = [0.0, ...] instead"
        lines.append((f"keypoints = {cable.n_keypoints}", what))
    else:
        marks = ", ".join(repr(float(s)) for s in cable.marks)
        lines.append((f"keypoint_arclength_m = [{marks}]", "observed points, from gripper 0 [m]"))
    lines.append((f'grasp = ["{cable.grasp[0]}", "{cable.grasp[1]}"]', "how each gripper holds the cable"))
    width = max(len(text) for text, _ in lines if len(text) < 50)
    return "\n".join(
        [
            "# A cable held by two grippers on a table. SI units.",
            f'schema = "{SCHEMA}"',
            *(f"{t:{width}}  # {c}" for t, c in lines),
            "",
        ]
    )


def cable_to_fields(cable: Cable) -> dict[str, Any]:
    """A cable as a JSON or TOML object, the inverse of `cable_from_fields`."""
    fields: dict[str, Any] = {key: getattr(cable, name) for key, (name, _) in NUMBERS.items()}
    if cable.marks is None:
        fields["keypoints"] = cable.n_keypoints
    else:
        fields["keypoint_arclength_m"] = list(cable.marks)
    return {**fields, "grasp": list(cable.grasp)}


def cable_from_fields(fields: Mapping[str, Any], where: str) -> Cable:
    """A cable from the keys of its file.

    Args:
        fields: by key.
        where: what they come from, for messages.

    Raises:
        ValueError: this is no object, a key is unknown or missing, or a value is not possible; names the key.
    """
    if not isinstance(fields, Mapping):
        raise ValueError(
            f"{where} is {shown(fields)}, expected a cable with the keys {', '.join([*NUMBERS, *OTHERS])}."
        )
    for key in fields:
        if key not in NUMBERS and key not in OTHERS:
            raise ValueError(f"{where} has {unknown_key(key, _UNITS)}")
    values: dict[str, Any] = {}
    for key, (name, what) in NUMBERS.items():
        if key not in fields and key not in _OPTIONAL:
            raise ValueError(f"{where} lacks {key}, the {what}. Add `{key} = ...`.")
        value = fields.get(key, _OPTIONAL.get(key))
        require(value, name, f"{where}: {key}", f"Check its unit ({what}).")
        values[name] = float(value)
    values |= _keypoints(fields, where)
    if "grasp" in fields:
        grasp = fields["grasp"]
        if not isinstance(grasp, list) or len(grasp) != 2 or not all(isinstance(hold, str) for hold in grasp):
            raise ValueError(f'{where}: grasp is {shown(grasp)}, expected ["clamped", "clamped"].')
        values["grasp"] = tuple(grasp)
    try:
        cable = Cable(**values)
        cable.check_material()
        return cable
    except ValueError as error:
        text = str(error)
        for name, key in KEYS.items():
            text = text.replace(f"Cable.{name} ", f"{key} ")
        raise ValueError(f"{where}: {text}") from None


def _keypoints(fields: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Number and places of the keypoints, as fields of `Cable`."""
    count, marks = fields.get("keypoints"), fields.get("keypoint_arclength_m")
    if (count is None) == (marks is None):
        came = "neither keypoints nor keypoint_arclength_m" if count is None else "both"
        raise ValueError(
            f"{where} has {came}, expected one of them: keypoints = 13 for evenly spaced ones, or keypoint_arclength_m "
            "= [0.0, ...] with the arc length of each from gripper 0."
        )
    if marks is None:
        require(count, "keypoints", f"{where}: keypoints")
        return {"n_keypoints": count}
    if not isinstance(marks, list) or not all(mark in LIMITS["not_negative"] for mark in marks):
        raise ValueError(f"{where}: keypoint_arclength_m is {shown(marks)}, expected a list of numbers [m].")
    return {"n_keypoints": len(marks), "marks": tuple(map(float, marks))}


def config_of_log(log: GapLog, *, n_links: int | None = None, timestep: float | None = None) -> Discretisation:
    """The simulator of the cable that a log states, by default at the default resolution.

    In the plane the diameter hardly matters to the motion, and a cable thicker than a link is long gets a smaller one.
    """
    dimension, chosen = log.keypoints.shape[-1], {"n_links": n_links, "timestep": timestep}
    stated = {**_OPTIONAL, **log.meta["cable"], "friction_coefficient": 0.0}
    if log.meta["table"] is not None:
        stated["friction_coefficient"] = log.meta["table"]["friction_coefficient"]
    numbers = {name: stated[key] for key, (name, _) in NUMBERS.items()}
    if dimension == 2:
        numbers["diameter"] = min(numbers["diameter"], _SLENDER * numbers["length"])
    return Discretisation(
        Cable(**numbers, n_keypoints=log.keypoints.shape[-2]),
        dimension=dimension,
        **{name: value for name, value in chosen.items() if value is not None},
    )


def cable_of_log(log: GapLog) -> Cable:
    """The cable that a log states, with its own diameter, marks and grasp.

    A log may state the first and last keypoint near the ends, for example rounded; a cable has them at the ends.

    Raises:
        ValueError: it is not one that a simulator can take.
    """
    cable, marks = log.meta["cable"], np.array(log.meta["keypoint_arclength_m"], float)
    marks[[0, -1]] = 0.0, cable["length_m"]
    uniform = np.allclose(marks, np.linspace(0.0, cable["length_m"], len(marks)), rtol=0, atol=1e-6 * cable["length_m"])
    return dataclasses.replace(
        config_of_log(log).cable,
        diameter=cable["diameter_m"],
        marks=None if uniform else tuple(marks.tolist()),
        grasp=tuple(log.meta["grasp"]),
    )
