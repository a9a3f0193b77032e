"""Effects of the cable itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cablejax.effects.base import CableEffect, hat, section
from cablejax.effects.effect import Parameter

# Where along the cable fits of local effects begin; a section of another sign is reached from the same place.
_CENTRES = (0.08, 0.2, 0.32, 0.44, 0.56, 0.68, 0.8, 0.92)
_CENTRE = Parameter("centre", "", 0.0, 1.0, 0.5, 0.3)
_WIDTH = Parameter("width", "", 0.03, 1.0, 0.25, 0.7, log=True)
# Parameters that are shares of the cable's length, which a verdict has in metres.
_SHARES = (_CENTRE.name, _WIDTH.name)


class _Local(CableEffect):
    """An effect at a place on the cable, or on a section of it."""

    def reported(self, values, variant, config):
        """Centre and width in metres, the other parameters in their own units."""
        length, reported = config.cable.length, {}
        for p, value in zip(self.parameters, values, strict=True):
            name, factor, unit = (f"{p.name}_m", length, "m") if p.name in _SHARES else (p.name, 1.0, p.unit)
            reported[name] = float(value) * factor, unit
        return reported

    def _from_reported(self, parameters, config):
        given = {name: parameters[f"{name}_m"] / config.cable.length for name in _SHARES if f"{name}_m" in parameters}
        return parameters | given

    def location(self, values, variant, config):
        """The section's two ends along the cable [m], which are one for a place."""
        reported = self.reported(values, variant, config)
        centre, half = reported["centre_m"][0], reported.get("width_m", (0.0, "m"))[0] / 2
        return {"along_cable_m": [max(centre - half, 0.0), min(centre + half, config.cable.length)]}


class BendingStiffness(CableEffect):
    """EI differs everywhere by one factor."""

    name = "bending_stiffness"
    hook = "bending"
    symmetric = True
    parameters = (Parameter("ratio", "", 0.02, 50.0, 1.0, 1.0, log=True),)
    null = (1.0,)
    amplitude, reversible = 0, True

    def apply(self, physics, values, variant, config):
        """Multiplies EI of every joint by the ratio."""
        return replace(physics, stiffness=physics.stiffness * values[0])

    def starts(self, context):
        """Cables of a tenth to five times the stiffness: of a long one a fit from 0.4 may not arrive at 0.2."""
        return [(0, (ratio,)) for ratio in (0.1, 0.2, 0.4, 2.5, 5.0)]


class StiffnessProfile(_Local):
    """EI differs over part of the cable."""

    name = "stiffness_profile"
    hook = "bending"
    parameters = (_CENTRE, _WIDTH, Parameter("ratio", "", 0.05, 30.0, 1.0, 1.0, log=True))
    null = (0.5, 0.25, 1.0)
    amplitude, reversible = 2, True

    def apply(self, physics, values, variant, config):
        """Multiplies EI of the joints in the section by the ratio."""
        part = section(values[0] * config.cable.length, values[1] * config.cable.length, config)
        return replace(physics, stiffness=physics.stiffness * values[2] ** part)

    def starts(self, context):
        """A section of half the stiffness at eight places along the cable, and short stiff ends.

        A short stiff end looks like the rest of the cable being soft, and a fit that starts there does not leave it.
        """
        return [(0, (c, 0.2, 0.5)) for c in _CENTRES] + [(0, (c, 0.1, 3.0)) for c in (0.0, 1.0)]


class IntrinsicCurvature(_Local):
    """The rest shape is curved, over part of the cable or all of it."""

    name = "intrinsic_curvature"
    hook = "bending"
    parameters = (_CENTRE, _WIDTH, Parameter("curvature_per_m", "1/m", -30.0, 30.0, 0.0, 3.0))
    null = (0.5, 0.25, 0.0)
    amplitude, reversible = 2, True

    def apply(self, physics, values, variant, config):
        """Adds to the rest curvature of the joints in the section [1/m]."""
        part = section(values[0] * config.cable.length, values[1] * config.cable.length, config)
        return replace(physics, rest_curvature=physics.rest_curvature + values[2] * part)

    def starts(self, context):
        """A section curved by one over the cable's length at eight places along the cable."""
        return [(0, (c, 0.15, 1.0 / context.config.cable.length)) for c in _CENTRES]


class Plasticity(CableEffect):
    """Bends beyond a yield curvature are permanent; the hardening beyond it is fitted as well."""

    name = "plasticity"
    hook = "memory"
    symmetric = True
    parameters = (
        Parameter("yield_curvature_per_m", "1/m", 0.2, 100.0, 5.0, 0.8, log=True),
        Parameter("hardening", "", 1e-3, 30.0, 0.3, 1.5, log=True),
    )
    null = (100.0, 0.3)
    alone = True

    def apply(self, physics, values, variant, config):
        """Sets the yield curvature [1/m] and the hardening of every joint."""
        still = physics.hardening * 0.0
        return replace(physics, yield_curvature=still + values[0], hardening=still + values[1])

    def starts(self, context):
        """Yield curvatures at five fractions of the sharpest nominal bend, each with weak and with full hardening."""
        sharpest = float(context.max_curvature.max())
        low, high = np.array([0.3, 90.0]) / context.config.cable.length
        return [
            (0, (float(np.clip(f * sharpest, low, high)), h)) for f in (0.9, 0.75, 0.6, 0.45, 0.3) for h in (0.05, 1.0)
        ]


class BendingHysteresis(CableEffect):
    """Rate-independent internal friction in bending, by Dahl's law."""

    name = "bending_hysteresis"
    hook = "memory"
    symmetric = True
    parameters = (
        Parameter("moment_n_m", "N m", 1e-5, 1.0, 0.01, 1.2, log=True),
        Parameter("transition_curvature_per_m", "1/m", 0.02, 20.0, 0.5, 0.8, log=True),
    )
    null = (0.0, 0.5)
    amplitude, alone = 0, True

    def apply(self, physics, values, variant, config):
        """Sets the friction moment [N m] and the transition curvature [1/m] of every joint."""
        still = physics.hysteresis_moment * 0.0
        return replace(physics, hysteresis_moment=still + values[0], hysteresis_curvature=still + values[1])

    def starts(self, context):
        """Friction moments of 0.15 and 0.6 times EI over the cable's length, each with two transition curvatures."""
        cable = context.config.cable
        moment = cable.bending_stiffness / cable.length
        return [(0, (m * moment, k / cable.length)) for m in (0.15, 0.6) for k in (0.15, 1.0)]


class BendingDamping(CableEffect):
    """Internal viscous damping differs."""

    name = "bending_damping"
    hook = "bending"
    symmetric = True
    parameters = (Parameter("ratio", "", 0.01, 1000.0, 1.0, 1.5, log=True),)
    null = (1.0,)
    alone = True

    def apply(self, physics, values, variant, config):
        """Multiplies the damping time of every joint by the ratio."""
        # a cable believed to be undamped gets one millisecond to be a multiple of
        nominal = physics.damping_time + (0.001 if config.cable.damping_time == 0 else 0.0)
        return replace(physics, damping_time=nominal * values[0])

    def starts(self, context):
        """A damping time 5 times shorter, and 4 and 20 times longer."""
        return [(0, (0.2,)), (0, (4.0,)), (0, (20.0,))]

    def reported(self, values, variant, config):
        """The damping time [s], instead of its ratio to the nominal one."""
        return {"time_s": (float(values[0]) * (config.cable.damping_time or 0.001), "s")}

    def _from_reported(self, parameters, config):
        return {"ratio": parameters["time_s"] / (config.cable.damping_time or 0.001)}


class AxialStretch(CableEffect):
    """The cable is extensible."""

    name = "axial_stretch"
    hook = "extension"
    symmetric = True
    parameters = (Parameter("stiffness_n", "N", 0.05, 1e6, 20.0, 1.5, log=True),)
    null = (np.inf,)
    amplitude = 0

    def apply(self, physics, values, variant, config):
        """Adds the axial compliance, the inverse of EA [1/N]."""
        return replace(physics, axial_compliance=physics.axial_compliance + 1.0 / values[0])

    def starts(self, context):
        """EA of 2, 15 and 150 N."""
        return [(0, (2.0,)), (0, (15.0,)), (0, (150.0,))]


class LinearDensity(CableEffect):
    """Mass per length differs: weight, and with it friction, and inertia."""

    name = "linear_density"
    hook = "mass"
    symmetric = True
    parameters = (Parameter("ratio", "", 0.05, 20.0, 1.0, 0.7, log=True),)
    null = (1.0,)
    amplitude, reversible = 0, True

    def apply(self, physics, values, variant, config):
        """Multiplies the mass per length by the ratio."""
        return replace(physics, density=physics.density * values[0])

    def starts(self, context):
        """A fifth to ten times the mass per length, for the same reason."""
        return [(0, (ratio,)) for ratio in (0.2, 0.5, 2.0, 5.0, 10.0)]


class LumpedMass(_Local):
    """A connector or clip."""

    name = "lumped_mass"
    hook = "mass"
    parameters = (_CENTRE, Parameter("mass_kg", "kg", 1e-4, 1.0, 0.03, 1.0, log=True))
    null = (0.5, 0.0)
    amplitude = 1

    def apply(self, physics, values, variant, config):
        """Adds the mass [kg] to the two links next to its place."""
        return replace(
            physics, extra_mass=physics.extra_mass + values[1] * hat(values[0] * config.cable.length, config)
        )

    def starts(self, context):
        """A mass of 30 g at eight places along the cable."""
        return [(0, (c, 0.03)) for c in _CENTRES]
