"""The named effects put into the simulator that makes training data: what a diagnosis is good for."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from cablejax.cable import Discretisation
from cablejax.diagnose.diagnosis import NamedEffect
from cablejax.effects.base import section
from cablejax.effects.physics import Physics, nominal_physics


def params_with(effects: Sequence[NamedEffect], config: Discretisation) -> Physics:
    """Parameters of the nominal cable changed by named effects, for `Engine.rollout`.

    Raises:
        ValueError: an effect is none of the cable's or the table's own parameters; the message names it.
    """
    physics = nominal_physics(config)
    for effect in effects:
        value = {name: estimate.value for name, estimate in effect.parameters.items()}
        match effect.name:
            case "bending_stiffness":
                change = {"stiffness": physics.stiffness * value["ratio"]}
            case "stiffness_profile":
                part = section(np.float64(value["centre_m"]), np.float64(value["width_m"]), config)
                change = {"stiffness": physics.stiffness * value["ratio"] ** part}
            case "intrinsic_curvature":
                part = section(np.float64(value["centre_m"]), np.float64(value["width_m"]), config)
                change = {"rest_curvature": physics.rest_curvature + value["curvature_per_m"] * part}
            case "bending_damping":
                change = {"damping_time": physics.damping_time * 0 + value["time_s"]}
            case "table_friction":
                change = {"friction": physics.friction * 0 + value["coefficient"]}
            case "linear_density":
                change = {"density": physics.density * value["ratio"]}
            case _:
                raise ValueError(
                    f"The effect {effect.name!r} is not a parameter of the engines that make training data; expected "
                    "bending_stiffness, stiffness_profile, intrinsic_curvature, bending_damping, table_friction or "
                    "linear_density. Correct it where it arises, or train on recorded transitions."
                )
        physics = dataclasses.replace(physics, **change)
    return physics
