"""Configuration of the contact plant: the cable, the effects that act on it, and the table's contacts."""

from __future__ import annotations

import dataclasses
from typing import get_args

from cablejax.cable import Discretisation
from cablejax.effects import Hook
from cablejax.effects.given import TIMED, GivenEffect
from cablejax.effects.physics import Physics
from cablejax.limits import check
from cablejax.simulate.plant_config import ObservedConfig, check_camera, check_effects, plant_physics

HOOKS: frozenset[Hook] = frozenset(get_args(Hook))
"""Hooks of the effects that the contact plant can stage."""


@dataclasses.dataclass(frozen=True)
class PlantConfig(ObservedConfig):
    """Configuration of the plant; the defaults are the reference cable, finer than the trained one.

    Attributes:
        discretisation: the nominal cable, its links and time step. `friction_speed` is ignored and `dimension` must be
            3: another cable is `dataclasses.replace(PlantConfig().discretisation, cable=...)`.
        settle_time: simulated time [s] given to a new cable to settle: without friction, with it, and once more after
            the grippers have come down to the height at which it lies.

    Raises:
        ValueError: a number or a parameter of an effect is out of range; the message names it.
    """

    discretisation: Discretisation = Discretisation(n_links=40, dimension=3, timestep=0.005)
    settle_time: float = 0.5

    @property
    def physics(self) -> Physics:
        """The cable with the effects that act from the beginning, float64, each joint bending in the plane."""
        return plant_physics(self.discretisation, self.acting(0.0))

    def acting(self, time: float) -> tuple[GivenEffect, ...]:
        """The effects that act at this time [s], as lasting ones."""
        return tuple(
            effect if effect.lasting else dataclasses.replace(effect, from_s=0.0, until_s=None)
            for effect in self.effects
            if effect.acts_at(time)
        )

    def __post_init__(self):
        if self.discretisation.dimension != 3:
            raise ValueError(
                f"PlantConfig.discretisation.dimension is {self.discretisation.dimension}, expected 3, the plant's: "
                "another cable is `dataclasses.replace(PlantConfig().discretisation, cable=...)`."
            )
        check(self, "seed", settle_time="positive")
        check_camera(self)
        object.__setattr__(self, "effects", tuple(self.effects))
        check_effects(self, HOOKS, {}, TIMED)
        remembered = [effect.name for effect in self.effects if effect.effect.hook == "memory"]
        if remembered and not all(effect.lasting for effect in self.effects):
            raise ValueError(
                f"{remembered[0]} acts during the whole run, but another effect does not: the plant would lose its "
                "memory of bends when that effect begins or ends. Leave out from_s and until_s, or this effect."
            )
        radius, own = float(self.physics.obstacle_radius), self.cable.diameter / 2
        if 0 < radius <= own:
            raise ValueError(
                f"obstacle: radius_m is {radius:g} m, expected more than the cable's own radius, {own:g} m: it reaches "
                "to the cable's centreline."
            )
