"""Effects of how the grippers hold the cable."""

from __future__ import annotations

from dataclasses import replace

from cablejax.effects.base import CableEffect
from cablejax.effects.effect import Parameter


def _at(gripper: int, value):
    """`value` at one gripper, zero at the other."""
    xp = value.__array_namespace__()
    return xp.stack([value, value * 0.0] if gripper == 0 else [value * 0.0, value])


class _AtGripper(CableEffect):
    """An effect at one gripper, whose number is the variant."""

    variants = (0, 1)
    variant_name = "gripper"

    def location(self, values, variant, config):
        """The gripper's end of the cable [m]."""
        s = 0.0 if variant == 0 else config.cable.length
        return {"along_cable_m": [s, s]}


class GripperSlip(_AtGripper):
    """The cable slides through a gripper, once in every episode."""

    name = "gripper_slip"
    hook = "extension"
    parameters = (
        Parameter("time_s", "s", 0.0, 300.0, 10.0, 8.0, difference=0.01),
        Parameter("distance_m", "m", -0.2, 0.2, 0.0, 0.02),
    )
    null = (10.0, 0.0)
    amplitude, reversible, alone = 1, True, True

    def apply(self, physics, values, variant, config):
        """Adds to the length that slips through one gripper [m], and sets the time at which it does [s]."""
        return replace(
            physics, slip=physics.slip + _at(variant, values[1]), slip_time=physics.slip_time * 0.0 + values[0]
        )

    def starts(self, context):
        """A slip of a hundredth of the cable at six times, through either gripper."""
        times = [context.duration * f for f in (0.1, 0.25, 0.4, 0.55, 0.7, 0.85)]
        return [(g, (t, -0.01 * context.config.cable.length)) for g in (0, 1) for t in times]

    def location(self, values, variant, config):
        """The gripper's end of the cable [m] and the time [s]."""
        return {**super().location(values, variant, config), "time_s": float(values[0])}


class GripperRotationOffset(_AtGripper):
    """The grasp angle is off."""

    name = "gripper_rotation_offset"
    hook = "grasp"
    parameters = (Parameter("angle_rad", "rad", -1.0, 1.0, 0.0, 0.15),)
    null = (0.0,)
    amplitude, reversible = 0, True
    repeatable = True

    def apply(self, physics, values, variant, config):
        """Adds to one gripper's angle between its pose and the cable's tangent [rad]."""
        return replace(physics, rotation_offset=physics.rotation_offset + _at(variant, values[0]))

    def starts(self, context):
        """An offset of 0.05 rad at either gripper."""
        return [(g, (0.05,)) for g in (0, 1)]


class GripperCompliance(_AtGripper):
    """The grasp yields in rotation."""

    name = "gripper_compliance"
    hook = "compliance"
    parameters = (Parameter("stiffness_n_m_per_rad", "N m/rad", 1e-3, 1e4, 0.3, 1.2, log=True),)
    null = (float("inf"),)
    amplitude = 0
    repeatable = True

    def apply(self, physics, values, variant, config):
        """Adds to one grasp's compliance in rotation [rad/(N m)]."""
        return replace(physics, rotation_compliance=physics.rotation_compliance + _at(variant, 1.0 / values[0]))

    def starts(self, context):
        """A soft and a stiff grasp, 0.08 and 0.4 N m/rad, at either gripper."""
        return [(g, (k,)) for g in (0, 1) for k in (0.08, 0.4)]
