"""What the fitted values say of each effect: parameters with intervals, and where on the cable they sit."""

from __future__ import annotations

import numpy as np

from cablejax.diagnose.diagnosis import NamedEffect, ParameterEstimate
from cablejax.spatial.effects import CURVATURE_KNOTS, PROFILE_KNOTS
from cablejax.spatial.identify import Identified
from cablejax.spatial.windows import Windows

_NINETY = 1.645


def named_effects(
    found: Identified, interval: tuple[float, float], density: float, windows: Windows
) -> tuple[NamedEffect, ...]:
    """The effects that were found, with their parameters and 90 % intervals.

    Values are those that predictions are made with. The interval of EI / rho is `interval`. Of the others, it is the
    wider one of the jackknife over recordings and of half the difference between the halves, both of the fit with the
    effects that stayed.

    Args:
        found: by `identify`.
        interval: of EI / rho [m^4/s^2], see `stiffness_interval`.
        density: mass per length that is believed true [kg/m], for what is known per mass only.
        windows: that it was found from.
    """
    layout = found.simulator.layout
    halves = np.stack([values.shared for values in found.half_values])
    spread = np.maximum(found.spread, np.abs(halves[0] - halves[1]) / 2)
    part = {f: (found.values.shared[s], spread[s]) for f, s in layout.slices.items()}
    length = layout.arclength[-1]
    profile, wobble = part["log_profile"]
    chance = {step.effect: step.chance for step in found.steps}
    named = []

    def estimate(value, error, unit):
        return ParameterEstimate(float(value), (float(value - _NINETY * error), float(value + _NINETY * error)), unit)

    def ratio(log, error):
        ends = np.exp([log - _NINETY * error, log + _NINETY * error])
        return ParameterEstimate(float(np.exp(log)), (float(ends[0]), float(ends[1])), "")

    def place(knot, knots):
        half = 0.5 * length / (knots - 1)
        centre = knot * length / (knots - 1)
        return centre, [max(centre - half, 0.0), min(centre + half, length)]

    for name in found.effects:
        location: dict = {"along_cable_m": None, "time_s": None, "table_m": None}
        if name == "bending_stiffness":
            value, low, high = np.array([found.stiffness(found.values), *interval]) / layout.nominal_stiffness
            parameters = {"ratio": ParameterEstimate(float(value), (float(low), float(high)), "")}
        elif name == "stiffness_profile":
            knot = int(np.abs(profile - profile.mean()).argmax())
            centre, along = place(knot, PROFILE_KNOTS)
            rest = np.delete(profile, knot).mean()
            parameters = {
                "centre_m": ParameterEstimate(centre, None, "m"),
                "width_m": ParameterEstimate(along[1] - along[0], None, "m"),
                "ratio": ratio(profile[knot] - rest, wobble[knot]),
            }
            location["along_cable_m"] = along
        elif name == "bending_damping":
            parameters = {"time_s": estimate(part["damping_time"][0][0], part["damping_time"][1][0], "s")}
        elif name == "viscous_drag":
            value, error = (density * x[0] for x in part["drag"])
            parameters = {"coefficient_n_s_per_m2": estimate(value, error, "N s/m²")}
        elif name == "quadratic_drag":
            value, error = (x[0] for x in part["quadratic_drag"])
            parameters = {"coefficient_per_m": estimate(value, error, "1/m")}
        elif name == "lumped_mass":
            value, error = (density * x[0] for x in part["marker_mass"])
            parameters = {"mass_kg": estimate(value, error, "kg")}
        elif name == "gripper_rotation_offset":
            angle, error = (x.reshape(2, 2) for x in part["clamp_rotation"])
            size, wide = np.linalg.norm(angle, axis=1), error.max(axis=1)
            parameters = {
                "gripper": ParameterEstimate([0, 1], None, ""),
                "angle_rad": ParameterEstimate(
                    size.tolist(),
                    [(float(max(a - _NINETY * e, 0)), float(a + _NINETY * e)) for a, e in zip(size, wide, strict=True)],
                    "rad",
                ),
            }
        elif name == "keypoint_bias":
            offset, error = part["along"]
            index = np.flatnonzero(np.abs(offset) > np.maximum(_NINETY * error, 1e-3))
            parameters = {
                "index": ParameterEstimate([int(i) + windows.held[0] for i in index], None, ""),
                "offset_m": ParameterEstimate(
                    offset[index].tolist(),
                    [(float(offset[i] - _NINETY * error[i]), float(offset[i] + _NINETY * error[i])) for i in index],
                    "m",
                ),
            }
        else:
            curvature, error = (x.reshape(-1, 2) for x in part["rest_curvature"])
            knot = int(np.linalg.norm(curvature, axis=1).argmax())
            centre, along = place(knot, CURVATURE_KNOTS)
            parameters = {
                "centre_m": ParameterEstimate(centre, None, "m"),
                "width_m": ParameterEstimate(along[1] - along[0], None, "m"),
                "curvature_per_m": estimate(np.linalg.norm(curvature[knot]), error[knot].max(), "1/m"),
            }
            location["along_cable_m"] = along
        named.append(NamedEffect(name, min(chance.get(name, 0.9), 0.99), parameters, location))
    return tuple(named)
