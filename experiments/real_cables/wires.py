"""Photographs of wires that hang between two clamps: planar, at rest, with a bending stiffness measured by others.

From the repository qj25/adapteddlo_muj (MIT), arXiv 2310.00911: white silicone wire, and black and red copper wire in
PVC, each hung several times.
"""

from __future__ import annotations

import dataclasses
import os
import pathlib

import numpy as np
from jaxtyping import Float

from cablejax.npz import read_npz
from cablejax.recordings.units import require_metres

_FIELDS = ("wire", "keypoints", "length_m", "mass_per_length_kg_m", "EI_published_Nm2")


@dataclasses.dataclass(frozen=True)
class HangingWire:
    """One wire, hung several times.

    Attributes:
        name: its colour.
        keypoints: points at equal distances along it [m], z up, y = 0, shape [R, N, 3].
        length: [m].
        linear_density: [kg/m].
        published_stiffness: EI that the authors found for each repeat [N m^2], shape [R].
    """

    name: str
    keypoints: Float[np.ndarray, "R N 3"]
    length: float
    linear_density: float
    published_stiffness: Float[np.ndarray, " R"]


def read_wires(path: str | os.PathLike[str]) -> tuple[HangingWire, ...]:
    """Reads W wires from an `.npz`, each photographed R times.

    The fields are `wire` [W], `keypoints` [W, R, N, 3], `length_m`, `mass_per_length_kg_m` [W] and `EI_published_Nm2`
    [W, R].

    Raises:
        ValueError: something in the file is missing, not finite, not positive or does not fit together, or it is no
            such file.
        FileNotFoundError: there is none.
    """
    path = pathlib.Path(path)
    arrays = read_npz(path, _FIELDS, text=["wire"])
    points = arrays["keypoints"]
    count = points.shape[:2]
    shapes = {"wire": count[:1], "length_m": (), "mass_per_length_kg_m": count[:1], "EI_published_Nm2": count}
    if points.ndim != 4 or points.shape[3] != 3 or points.shape[2] < 5:
        raise ValueError(f"{path}: keypoints has shape {points.shape}, expected [W, R, N, 3] with N at least 5.")
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise ValueError(f"{path}: {name} has shape {arrays[name].shape}, expected {shape} for these keypoints.")
    for name in _FIELDS[1:]:
        if not np.isfinite(arrays[name]).all():
            raise ValueError(f"{path}: {name} has values that are not finite.")
    for name in ("mass_per_length_kg_m", "EI_published_Nm2"):
        if not (least := arrays[name].min(initial=np.inf)) > 0:
            raise ValueError(f"{path}: {name} has the value {least:g}, expected positive numbers.")
    length = float(arrays["length_m"])
    require_metres(length, "m")
    return tuple(
        HangingWire(str(name), keypoints, length, float(density), stiffness)
        for name, keypoints, density, stiffness in zip(
            arrays["wire"].tolist(),
            points.astype(float),
            arrays["mass_per_length_kg_m"],
            arrays["EI_published_Nm2"].astype(float),
            strict=True,
        )
    )
