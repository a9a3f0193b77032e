"""Common configuration of all plants, and its checks."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping

import numpy as np

from cablejax.cable import Cable, Discretisation
from cablejax.effects import Hook
from cablejax.effects.given import GivenEffect, check_hooks, with_effects
from cablejax.effects.physics import Physics, nominal_physics
from cablejax.limits import check


@dataclasses.dataclass(frozen=True)
class ObservedConfig:
    """Base of the plants' configurations: the cable, its effects, and how it is observed.

    Attributes:
        discretisation: the nominal cable, its links and time step.
        effects: effects of the plant beyond the nominal cable, in this order.
        keypoint_noise: standard deviation of the observed keypoints [m] per coordinate, the held ends included.
        keypoint_dropout: probability with which a keypoint is not observed (NaN), except the first and last, which the
            grippers hold.
        seed: of noise and gaps.
    """

    discretisation: Discretisation
    effects: tuple[GivenEffect, ...] = ()
    keypoint_noise: float = 0.0
    keypoint_dropout: float = 0.0
    seed: int = 0

    @property
    def cable(self) -> Cable:
        """The cable without the effects."""
        return self.discretisation.cable

    @property
    def physics(self) -> Physics:
        """The cable with the effects, float64, each joint bending in the plane."""
        return plant_physics(self.discretisation, self.effects)


@functools.lru_cache(maxsize=64)
def plant_physics(discretisation: Discretisation, effects: tuple[GivenEffect, ...]) -> Physics:
    """A plant's cable with its effects, float64, every joint bending in the plane.

    Raises:
        ValueError: a parameter of an effect is out of its bounds.
    """
    planar = dataclasses.replace(discretisation, dimension=2)
    return with_effects(nominal_physics(planar, np.float64), effects, planar)


def check_effects(
    config, hooks: frozenset[Hook], able: Mapping[str, frozenset[Hook]], changing: frozenset[Hook] = frozenset()
) -> None:
    """Raises ValueError unless a plant can stage the `effects` of its configuration.

    Args:
        config: with `effects`, a tuple, and `discretisation`.
        hooks: that the plant honours.
        able: other plants by name with their hooks, for the message.
        changing: hooks whose effects may begin and end in the middle of a run.
    """
    for effect in config.effects:
        if not isinstance(effect, GivenEffect):
            raise ValueError(
                f"{type(config).__name__}.effects has {effect!r}, expected GivenEffect objects: use parse_effect(...)."
            )
    check_hooks(config.effects, hooks, type(config).__name__.removesuffix("Config"), able, changing)
    plant_physics(config.discretisation, config.effects)


def check_camera(config) -> None:
    """Raises ValueError unless `keypoint_noise` and `keypoint_dropout` of a configuration make sense."""
    check(config, keypoint_noise="noise")
    if not 0 <= config.keypoint_dropout < 1:
        raise ValueError(
            f"{type(config).__name__}.keypoint_dropout is {config.keypoint_dropout}, expected a number in [0, 1)."
        )
