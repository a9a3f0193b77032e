"""Named effects from an estimate: parameters with intervals, and their place on the cable."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cablejax.diagnose.diagnosis import NamedEffect, ParameterEstimate
from cablejax.spatial.effects import CURVATURE_KNOTS, PROFILE_KNOTS
from cablejax.spatial.estimate import UNMODELLED, Estimate, Interval
from cablejax.spatial.identify import Identified

IDENTIFIABLE = 2.0
"""The markers' mass is reported where its interval reaches to at most this factor to either side. That of either drag
alone never does: `UNMODELLED` is wider."""
# A marker that is this near to its nominal place is not reported as displaced [m].
_PLACED = 1e-3
_ABSENT = {
    "bending_stiffness": ("ratio", 1.0),
    "stiffness_profile": ("ratio", 1.0),
    "gripper_rotation_offset": ("angle_rad", 0.0),
    "keypoint_bias": ("offset_m", 0.0),
    "intrinsic_curvature": ("curvature_per_m", 0.0),
}
"""A parameter that says how far an effect is from its absence, and its value there."""
# A damping time shorter than this part of a time step is not told from the integrator: BDF2 damps a vibration as one of
# up to 0.15 time steps would, most at five steps in a period.
_HIDDEN = 0.25
_DRAGS = {"viscous_drag", "quadratic_drag"}
_WHOLE, _STIFFNESS = "bending_stiffness", "stiffness_over_density_m4_per_s2"


def named_effects(found: Identified, estimate: Estimate, density: float) -> tuple[NamedEffect, ...]:
    """The effects that stayed in the search and that the estimate shows, with parameters and 90 % intervals.

    Args:
        found: by `identify`.
        estimate: from the same windows. Reported values are its own, not those that predictions are made with.
        density: mass per length, with the markers, that is believed true [kg/m], for what is known per mass only.
    """
    named, known, cable = [], quantities_of(found, estimate, None), found.cable
    for name in found.effects:
        parameters, along = parameters_of(name, estimate, density, first_marker=cable.windows.held[0])
        if not _shown(name, parameters, cable.windows.interval / cable.rod.substeps):
            continue
        # what motion shows of the drags is their sum at its speed, of the markers' mass what slows the cable down
        if name in _DRAGS:
            parameters = {key: known[key] for key in ("drag_at_speed_per_s", "speed_m_per_s")}
        elif name == "lumped_mass" and not _narrow(parameters["mass_kg"]):
            del parameters["mass_kg"]
            if _STIFFNESS in known:
                parameters[_STIFFNESS] = known[_STIFFNESS]
        location = {"along_cable_m": along, "time_s": None, "table_m": None}
        named.append(NamedEffect(name, None, parameters, location))
    return tuple(named)


def quantities_of(found: Identified, estimate: Estimate, density: float | None) -> dict[str, ParameterEstimate]:
    """What motion shows of the cable, whether an effect is named for it or not, with 90 % intervals.

    EI / rho, where the stiffness was free; both drags together at the recording's speed, where one was, with an
    interval from 0 where neither is named; and EI, where the mass per length is known.

    Args:
        found: by `identify`.
        estimate: from the same windows.
        density: mass per length, with the markers [kg/m]; None = a guess.
    """
    known = {}
    if _WHOLE in found.tried:
        stiffness = estimate.stiffness.wider_by_factor(UNMODELLED[_WHOLE])
        known[_STIFFNESS] = _told(stiffness, "m^4/s^2")
        if density is not None:
            known["bending_stiffness_n_m2"] = _told(stiffness, "N m^2", times=density)
    if _DRAGS & set(found.tried):
        speed = found.cable.windows.speed
        drag = estimate.drag_at(speed).wider_by_factor(UNMODELLED["drag"])
        if not _DRAGS & set(found.effects):
            # an estimate by its logarithm is never 0, and here there may be no drag
            drag = dataclasses.replace(drag, low=0.0)
        known["drag_at_speed_per_s"] = _told(drag, "1/s")
        known["speed_m_per_s"] = _choice(speed, "m/s")
    return known


def _shown(effect: str, parameters: Mapping[str, ParameterEstimate], time_step: float) -> bool:
    """Whether an interval leaves out that the effect is absent, or shorter than time steps [s] show.

    An effect with many free values, some for each recording, may help to simulate what it is not there for. Of drags
    and the markers' mass, which are estimated by their logarithms and so never absent, the search alone says.
    """
    if effect == "bending_damping":
        return bool(np.min(np.array(parameters["time_s"].ci90, float)) > _HIDDEN * time_step)
    if effect not in _ABSENT:
        return True
    name, absent = _ABSENT[effect]
    low, high = np.reshape(np.array(parameters[name].ci90, float), (-1, 2)).T
    return bool(((absent < low) | (high < absent)).any())


def _narrow(parameter: ParameterEstimate) -> bool:
    low, high = np.ravel(np.array(parameter.ci90))
    return bool(parameter.value / low <= IDENTIFIABLE and high / parameter.value <= IDENTIFIABLE)


def parameters_of(
    effect: str,
    estimate: Estimate,
    density: float,
    *,
    first_marker: int = 0,
    unmodelled: Mapping[str, float] = UNMODELLED,
) -> tuple[dict[str, ParameterEstimate], list[float] | None]:
    """Parameters of an effect by the names of the gap log, and the stretch of cable that they belong to [m].

    Args:
        effect: name.
        estimate: in which it is free.
        density: see `named_effects`.
        first_marker: index of the first free marker among all keypoints.
        unmodelled: error of an effect's parameter besides, see `UNMODELLED`.
    """
    besides = unmodelled.get(effect, 0.0)
    where, length = estimate.layout.slices, estimate.layout.arclength[-1]

    def part(field):
        return estimate.shared[where[field]]

    def size(field, first):
        """Of two values as a vector; its interval is as wide as that of the less certain one."""
        slots = [where[field].start + first, where[field].start + first + 1]
        value = float(np.linalg.norm(estimate.shared[slots]))
        ends = [estimate.of(lambda values, i=i: values[i]) for i in slots]
        error = max(end.high - end.value for end in ends)
        wide = Interval(value, value - error, value + error).wider(besides)
        return dataclasses.replace(wide, low=max(wide.low, 0.0))

    def positive(field):
        return estimate.positive(field).wider_by_factor(besides)

    def place(knot, knots):
        centre, half = knot * length / (knots - 1), 0.5 * length / (knots - 1)
        along = [max(centre - half, 0.0), min(centre + half, length)]
        return {"centre_m": _choice(centre, "m"), "width_m": _choice(along[1] - along[0], "m")}, along

    along = None
    match effect:
        case "bending_stiffness":
            parameters = {
                "ratio": _told(estimate.ratio(estimate.layout.log_stiffness).wider_by_factor(besides), ""),
                "stiffness_over_density_m4_per_s2": _told(estimate.stiffness.wider_by_factor(besides), "m^4/s^2"),
            }
        case "stiffness_profile":
            knot, ratio = _section(estimate)
            parameters, along = place(knot, PROFILE_KNOTS)
            parameters["ratio"] = _told(ratio.wider_by_factor(besides), "")
        case "bending_damping":
            parameters = {"time_s": _told(positive("damping_time"), "s")}
        case "viscous_drag":
            parameters = {"coefficient_n_s_per_m2": _told(positive("drag"), "N s/m^2", times=density)}
        case "quadratic_drag":
            parameters = {"coefficient_per_m": _told(positive("quadratic_drag"), "1/m")}
        case "lumped_mass":
            parameters = {
                "centre_m": _choice([float(s) for s in estimate.layout.arclength[:-1]], "m"),
                "mass_kg": _told(estimate.marker_mass.wider_by_factor(besides), "kg", times=density),
            }
        case "gripper_rotation_offset":
            angles = [size("clamp_rotation", 2 * gripper) for gripper in range(2)]
            parameters = {"gripper": _choice([0, 1], ""), "angle_rad": _all_told(angles, "rad")}
        case "keypoint_bias":
            slots = range(where["along"].start, where["along"].stop)
            each = [estimate.of(lambda values, i=i: values[i]) for i in slots]
            off = [i for i, e in enumerate(each) if abs(e.value) > _PLACED and not e.low <= 0 <= e.high]
            parameters = {
                "index": _choice([i + first_marker for i in off], ""),
                "offset_m": _all_told([each[i] for i in off], "m"),
            }
        case "intrinsic_curvature":
            knot = int(np.linalg.norm(part("rest_curvature").reshape(-1, 2), axis=1).argmax())
            parameters, along = place(knot, CURVATURE_KNOTS)
            parameters["curvature_per_m"] = _told(size("rest_curvature", 2 * knot), "1/m")
        case _:
            raise ValueError(f"The effect is {effect!r}, expected one of {estimate.layout.effects}.")
    return parameters, along


def _section(estimate: Estimate) -> tuple[int, Interval]:
    """The knot where the stiffness differs most from that along the cable, and its ratio to that of the others."""
    where = estimate.layout.slices["log_profile"]
    profile = estimate.shared[where]
    knot = int(np.abs(profile - profile.mean()).argmax())
    rest = np.array([i for i in range(PROFILE_KNOTS) if i != knot])
    return knot, estimate.ratio(lambda values: values[where][knot] - values[where][rest].mean())


def _told(interval: Interval, unit: str, *, times: float = 1.0) -> ParameterEstimate:
    return ParameterEstimate(times * interval.value, (times * interval.low, times * interval.high), unit)


def _all_told(intervals: Sequence[Interval], unit: str) -> ParameterEstimate:
    return ParameterEstimate([i.value for i in intervals], [(i.low, i.high) for i in intervals], unit)


def _choice(value: Any, unit: str) -> ParameterEstimate:
    return ParameterEstimate(value, None, unit)
