"""Compares the reported parameters of a synthetic cable with the true ones."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from cablejax.diagnose.diagnosis import ParameterEstimate
from cablejax.spatial.estimate import UNMODELLED, Estimate
from cablejax.spatial.named import parameters_of
from real_cables.synthetic import SyntheticCable

REPORTED = {
    "bending_damping": "time_s",
    "lumped_mass": "mass_kg",
    "stiffness_profile": "ratio",
    "gripper_rotation_offset": "angle_rad",
}
"""Parameters whose intervals are judged; the true places of the markers (`keypoint_bias`) are not kept."""


def with_true_values(
    cable: SyntheticCable,
    everything: Estimate,
    effects: Iterable[str] = tuple(REPORTED),
    *,
    unmodelled: Mapping[str, float] = UNMODELLED,
) -> dict[str, list[float]]:
    """True value, estimate, low and high of the parameters of these effects, as if each of them were named.

    All is per mass of the cable with its markers. The ratio of a stiffness profile is that of the place where the
    estimate differs most; the angle in a gripper is the mean over the recordings.
    """
    rows = {}
    for effect in effects:
        parameters = parameters_of(effect, everything, density=1.0, unmodelled=unmodelled)[0]
        reported = parameters[REPORTED[effect]]
        true = np.ravel(_true_value(cable, effect, parameters, everything.layout.arclength[-1]))
        value, ends = np.ravel(reported.value), np.reshape(np.array(reported.ci90), (-1, 2))
        for k in range(len(true)):
            name = f"{effect}, {REPORTED[effect]}" + (f", gripper {k}" if len(true) > 1 else "")
            rows[name] = [float(x) for x in (true[k], value[k], *ends[k])]
    return rows


def _true_value(cable: SyntheticCable, effect: str, parameters: Mapping[str, ParameterEstimate], length: float):
    match effect:
        case "bending_damping":
            return cable.damping_time
        case "lumped_mass":
            return cable.marker_mass / cable.laden
        case "stiffness_profile":
            knot = round(parameters["centre_m"].value / length * (len(cable.profile) - 1))
            return np.exp(cable.profile[knot] - np.delete(cable.profile, knot).mean())
        case "gripper_rotation_offset":
            return np.arctan(np.linalg.norm(cable.grips.mean(axis=0), axis=-1))
    raise ValueError(f"The effect is {effect!r}, expected one of {', '.join(REPORTED)}.")
