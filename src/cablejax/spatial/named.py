"""Named effects from an estimate: parameters with intervals, and their place on the cable."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import t

from cablejax.diagnose.diagnosis import NamedEffect, ParameterEstimate
from cablejax.spatial.effects import CURVATURE_KNOTS, PROFILE_KNOTS
from cablejax.spatial.estimate import REPORTED, UNMODELLED, Estimate, Interval
from cablejax.spatial.identify import Identified

# A marker that is this near to its nominal place is not reported as displaced [m].
_PLACED = 1e-3
# A damping time shorter than this part of a time step cannot be distinguished from the integrator: BDF2 damps a
# vibration as one of up to 0.15 time steps would, most at five steps in a period.
_HIDDEN = 0.25
SURE = 0.95
"""An effect is named where an interval that holds its value in this share of cases leaves its absence out. By the 90 %
that are reported too many were named that the cables to choose on of `34_fresh_cables.py` do not have. The larger of
two grips and the largest of five knots count as if chosen beforehand: there `UNMODELLED` makes up for it, and of wider
intervals more profiles would be missed than absent ones left out."""
_DRAGS = ("viscous_drag", "quadratic_drag")
_WHOLE, _STIFFNESS, _DRAG = "bending_stiffness", "stiffness_over_density_m4_per_s2", "drag_at_speed_per_s"
_TELLING = {
    "bending_stiffness": "ratio",
    "stiffness_profile": "ratio",
    "bending_damping": "time_s",
    **dict.fromkeys(_DRAGS, _DRAG),
    "lumped_mass": "mass_kg",
    "gripper_rotation_offset": "angle_rad",
    "keypoint_bias": "offset_m",
    "intrinsic_curvature": "curvature_per_m",
}
"""The parameter that says how far an effect is from its absence: from 1 where it is a ratio, from 0 otherwise."""


def named_effects(found: Identified, density: float) -> tuple[NamedEffect, ...]:
    """The effects that the estimate shows, with parameters and 90 % intervals: those that stayed in the search first.

    That an effect does not help to simulate other recordings, which the search asks, does not mean that it is absent:
    it is named all the same, but not of a cable whose bends the simulator does not resolve. There, intervals are too
    narrow for their absence to count alone.

    Args:
        found: by `identify`.
        density: mass per length, with the markers, that is believed true [kg/m], for what is known per mass only.
    """
    named, windows, estimate = [], found.cable.windows, found.everything
    layout = estimate.layout
    hidden = _HIDDEN * windows.interval / found.time_steps.substeps
    damping = max(float(layout.null[layout.slices["damping_time"]].item()), hidden)
    wider = float(t.ppf(0.5 + 0.5 * SURE, estimate.freedom) / t.ppf(REPORTED, estimate.freedom))
    # motion shows the drags' sum: it goes by the names that stayed in the search, or by that of the larger one
    drags = [name for name in found.effects if name in _DRAGS] or [_main_drag(estimate)]
    for name in dict.fromkeys((*found.effects, *(found.tried if found.resolved else ()))):
        if name in _DRAGS and name not in drags:
            continue
        parameters, along = parameters_of(
            name, estimate, density, placed=windows.placed, first_clamp=windows.first_clamp
        )
        if name == "bending_damping":
            there = _damped(estimate, parameters["time_s"], wider, damping, longer_only=damping == hidden)
        else:
            there = _shown(name, parameters[_TELLING[name]], wider)
        if there:
            named.append(NamedEffect(name, None, parameters, {"along_cable_m": along, "time_s": None, "table_m": None}))
    return tuple(named)


def with_both_drags(named: Sequence[str]) -> set[str]:
    """Named effects; if one drag is among them, both are, since only their sum is identifiable."""
    return {*named, *(_DRAGS if set(_DRAGS) & set(named) else ())}


def quantities_of(found: Identified, density: float | None) -> dict[str, ParameterEstimate]:
    """Quantities of the cable that motion identifies, whether or not an effect is named, with 90 % intervals.

    EI / rho, where the stiffness was free; both drags together at the recording's speed, where one was; and EI, where
    the mass per length is known.

    Args:
        found: by `identify`.
        density: mass per length, with the markers [kg/m]; None = a guess.
    """
    known, estimate = {}, found.everything
    if _WHOLE in found.tried:
        stiffness = estimate.stiffness.wider_by_factor(UNMODELLED[_WHOLE])
        known[_STIFFNESS] = _reported(stiffness, "m^4/s^2")
        if density is not None:
            known["bending_stiffness_n_m2"] = _reported(stiffness, "N m^2", times=density)
    if set(_DRAGS) & set(found.tried):
        known |= parameters_of(_DRAGS[0], estimate, 1.0)[0]
    return known


def _main_drag(estimate: Estimate) -> str:
    linear, quadratic = (estimate.shared[estimate.layout.slots(name)].item() for name in _DRAGS)
    return _DRAGS[int(estimate.speed * quadratic > linear)]


def _shown(effect: str, parameter: ParameterEstimate, wider: float) -> bool:
    """Whether it is as good as excluded that the effect is absent.

    Args:
        effect: name.
        parameter: that says how far it is from its absence.
        wider: an interval that is sure over the one that is reported.
    """
    ends = np.reshape(np.array(parameter.ci90, float), (-1, 2)).T
    ends = np.stack([np.ravel(parameter.value), *ends])
    value, low, high = np.log(ends) if _TELLING[effect] == "ratio" else ends
    return bool((value - wider * (value - low) > 0).any() or (value + wider * (high - value) < 0).any())


def _damped(estimate: Estimate, time: ParameterEstimate, wider: float, compared: float, *, longer_only: bool) -> bool:
    """Whether it is as good as excluded that the cable is damped as little as another one.

    Were it so, the prior, which expects some damping, would draw the estimate towards longer times.

    Args:
        estimate: in which the damping is free.
        time: its time [s].
        wider: an interval that is sure over the one that is reported.
        compared: time that it is compared with [s]: the one believed, or the shortest that time steps show.
        longer_only: whether a shorter one is indistinguishable from that.
    """
    value, low, high = np.log(np.append(time.value, np.array(time.ci90)) / compared)
    (prior,) = estimate.layout.named("bending_damping").parameters
    value_if_so = estimate.drawn("bending_damping") * math.log(prior.centre / compared) / prior.scale
    longer = value - wider * (value - low) > max(value_if_so, 0.0)
    return bool(longer or (value + wider * (high - value) < min(value_if_so, 0.0) and not longer_only))


def parameters_of(
    effect: str,
    estimate: Estimate,
    density: float,
    *,
    placed: Sequence[int] = (),
    first_clamp: float = 0.0,
    unmodelled: Mapping[str, float] = UNMODELLED,
) -> tuple[dict[str, ParameterEstimate], list[float] | None]:
    """Parameters of an effect by the names of the gap log, and the stretch of cable that they belong to [m].

    Args:
        effect: name.
        estimate: in which it is free.
        density: see `named_effects`.
        placed: see `Windows.placed`.
        first_clamp: arc length of the first clamp, from the first keypoint [m].
        unmodelled: error of an effect's parameter besides, see `UNMODELLED`.
    """
    besides, where, length = unmodelled.get(effect, 0.0), estimate.layout.slices, estimate.layout.arclength[-1]

    def size(field, first):
        """Of two values as a vector; its interval is as wide as that of the less certain one."""
        slots = [where[field].start + first, where[field].start + first + 1]
        value = float(np.linalg.norm(estimate.shared[slots]))
        ends = [estimate.of(lambda values, i=i: values[i]) for i in slots]
        error = max(end.high - end.value for end in ends)
        return Interval(value, value - error, value + error)

    def from_zero(interval):
        wide = interval.wider(besides)
        return dataclasses.replace(wide, low=max(wide.low, 0.0))

    def place(knot, knots):
        centre, half = knot * length / (knots - 1), 0.5 * length / (knots - 1)
        along = [first_clamp + max(centre - half, 0.0), first_clamp + min(centre + half, length)]
        return {"centre_m": _choice(first_clamp + centre, "m"), "width_m": _choice(along[1] - along[0], "m")}, along

    along = None
    match effect:
        case "bending_stiffness":
            parameters = {
                "ratio": _reported(estimate.ratio(estimate.layout.log_stiffness).wider_by_factor(besides), ""),
                "stiffness_over_density_m4_per_s2": _reported(estimate.stiffness.wider_by_factor(besides), "m^4/s^2"),
            }
        case "stiffness_profile":
            knot, ratio = _section(estimate)
            parameters, along = place(knot, PROFILE_KNOTS)
            parameters["ratio"] = _reported(ratio.wider_by_factor(besides), "")
        case "bending_damping":
            parameters = {"time_s": _reported(estimate.positive("damping_time").wider_by_factor(besides), "s")}
        case "viscous_drag" | "quadratic_drag":
            parameters = {
                _DRAG: _reported(from_zero(estimate.drag), "1/s"),
                "speed_m_per_s": _choice(estimate.speed, "m/s"),
            }
        case "lumped_mass":
            parameters = {
                "centre_m": _choice([first_clamp + float(s) for s in estimate.layout.arclength[:-1]], "m"),
                "mass_kg": _reported(from_zero(estimate.marker_mass), "kg", times=density),
            }
        case "gripper_rotation_offset":
            angles = [_angle(from_zero(size("clamp_rotation", 2 * gripper))) for gripper in range(2)]
            parameters = {"gripper": _choice([0, 1], ""), "angle_rad": _reported_all(angles, "rad")}
        case "keypoint_bias":
            slots = range(where["along"].start, where["along"].stop)
            each = [estimate.of(lambda values, i=i: values[i]).among(len(slots), estimate.freedom) for i in slots]
            pairs = zip(placed, each, strict=False)  # a second clamp without a keypoint of its own is none
            off = {i: e for i, e in pairs if abs(e.value) > _PLACED and not e.low <= 0 <= e.high}
            parameters = {"index": _choice(list(off), ""), "offset_m": _reported_all(list(off.values()), "m")}
        case "intrinsic_curvature":
            curvature = estimate.shared[where["rest_curvature"]].reshape(-1, 2)
            knot = int(np.linalg.norm(curvature, axis=1).argmax())
            parameters, along = place(knot, CURVATURE_KNOTS)
            parameters["curvature_per_m"] = _reported(from_zero(size("rest_curvature", 2 * knot)), "1/m")
        case _:
            raise ValueError(f"The effect is {effect!r}, expected one of {estimate.layout.effects}.")
    return parameters, along


def _angle(slope: Interval) -> Interval:
    return Interval(*map(math.atan, (slope.value, slope.low, slope.high)))


def _section(estimate: Estimate) -> tuple[int, Interval]:
    """The knot where the stiffness differs most from that along the cable, and its ratio to that of the others."""
    where = estimate.layout.slices["log_profile"]
    profile = estimate.shared[where]
    knot = int(np.abs(profile - profile.mean()).argmax())
    rest = np.array([i for i in range(PROFILE_KNOTS) if i != knot])
    return knot, estimate.ratio(lambda values: values[where][knot] - values[where][rest].mean())


def _reported(interval: Interval, unit: str, *, times: float = 1.0) -> ParameterEstimate:
    return ParameterEstimate(times * interval.value, (times * interval.low, times * interval.high), unit)


def _reported_all(intervals: Sequence[Interval], unit: str) -> ParameterEstimate:
    return ParameterEstimate([i.value for i in intervals], [(i.low, i.high) for i in intervals], unit)


def _choice(value: Any, unit: str) -> ParameterEstimate:
    return ParameterEstimate(value, None, unit)
