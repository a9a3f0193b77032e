"""The two inputs of a conditioned model: those of the cables that it was trained on, and of a cable with effects.

Both are log ratios to the reference cable, see `types.cable_descriptor`. `cablejax train` records those of its data in
the weights' info as "inputs", a `CableInputs`.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence

import numpy as np

from cablejax.adaptation.belief import AdaptationConfig
from cablejax.cable import Cable, Discretisation
from cablejax.dataset.schema import config_from_json
from cablejax.dataset.split import split
from cablejax.dataset.store import Store
from cablejax.dataset.windows import known_of_cables
from cablejax.dynamics.weights import WeightsError, cable_of_weights, load_info, load_weights
from cablejax.effects.given import GivenEffect, with_effects
from cablejax.effects.physics import mean_resistance, nominal_physics
from cablejax.types import cable_descriptor


@dataclasses.dataclass(frozen=True)
class CableInputs:
    """The inputs of the cables that a conditioned model was trained on.

    Attributes:
        mean: log ratios of stiffness and of friction.
        limits: smallest and largest log ratio of stiffness, and of friction.

    Raises:
        ValueError: these are no numbers, or the mean is not within the limits.
    """

    mean: tuple[float, float] = (0.0, 0.0)
    limits: tuple[tuple[float, float], ...] = AdaptationConfig.limits

    def __post_init__(self):
        mean, limits = np.asarray(self.mean, float), np.asarray(self.limits, float)
        right = mean.shape == (2,) and limits.shape == (2, 2) and np.isfinite(limits).all()
        if not (right and (limits[:, 0] <= mean).all() and (mean <= limits[:, 1]).all()):
            raise ValueError(
                f"The inputs have mean {self.mean} and limits {self.limits}, expected the means of two log ratios, and "
                "below and above them the smallest and the largest of each."
            )

    def with_effects(self, effects: Sequence[GivenEffect], cable: Cable) -> tuple[float, float]:
        """The inputs of a nominal cable with effects, within the limits; the mean where the effects change nothing.

        In slow motion only the ratio of stiffness and friction matters: friction beyond its limits is taken up by the
        stiffness. Stiffness beyond its own is left out, see `left_out`.
        """
        stiffness, friction = self._asked(effects, cable)
        softest_to_stiffest, smoothest_to_roughest = self.limits
        within = np.clip(friction, *smoothest_to_roughest)
        return float(np.clip(stiffness - (friction - within), *softest_to_stiffest)), float(within)

    def also_of(self, start_from: str | os.PathLike[str]) -> CableInputs:
        """These inputs of a model that started from another one, see `load_weights`.

        A conditioned one knows more cables: the limits include its own.
        """
        if not load_weights(start_from)[0].conditioned:
            return self
        known = inputs_of_weights(start_from, cable_of_weights(start_from))
        pairs = zip(self.limits, known.limits, strict=True)
        limits = tuple((min(low, least), max(high, most)) for (low, high), (least, most) in pairs)
        return dataclasses.replace(self, limits=limits)

    def left_out(self, effects: Sequence[GivenEffect], cable: Cable) -> float:
        """Log ratio of stiffness to friction that effects make and the limits leave out of `with_effects`."""
        (stiffness, friction), within = self._asked(effects, cable), self.with_effects(effects, cable)
        return float(stiffness - friction) - (within[0] - within[1])

    def _asked(self, effects: Sequence[GivenEffect], cable: Cable) -> np.ndarray:
        """The inputs of a cable with effects, shape [2], whatever the limits."""
        nominal, changed = inputs_of((), cable), inputs_of(effects, cable)
        return np.where(changed == nominal, self.mean, changed)


def inputs_of(effects: Sequence[GivenEffect], cable: Cable) -> np.ndarray:
    """The inputs of a nominal cable with effects, shape [2]."""
    config = Discretisation(cable)
    physics = with_effects(nominal_physics(config, np.float64), effects, config)
    return np.asarray(cable_descriptor(*map(np.asarray, mean_resistance(physics))))


def inputs_of_data(stores: Sequence[Store], held_out: float) -> CableInputs:
    """Of the trajectories of data sets that `dataset.split` leaves to train on."""
    parts = []
    for store in stores:
        rows, _ = split(store.config.n_trajectories, held_out)
        parts.append(known_of_cables(store.config, store.parameters()[rows], rows))
    known = np.concatenate(parts).astype(float)
    low, high = known.min(axis=0), known.max(axis=0)
    # the mean of equal numbers is rounded
    stiffness, friction = np.clip(known.mean(axis=0), low, high).tolist()
    return CableInputs((stiffness, friction), tuple(zip(low.tolist(), high.tolist(), strict=True)))


def inputs_of_weights(source: str | os.PathLike[str], cable: Cable) -> CableInputs:
    """Of the cables that a model was trained on, where its file records them; `source` as in `load_weights`.

    Files of earlier versions, as the released models, do not: those begin with the nominal cable, and the limits about
    it are `AdaptationConfig.limits`.

    Raises:
        WeightsError: the file records something else.
    """
    recorded = load_info(source).get("inputs")
    if recorded is None:
        stiffness, friction = inputs_of((), cable).tolist()
        about = zip((stiffness, friction), AdaptationConfig.limits, strict=True)
        return CableInputs((stiffness, friction), tuple((own + low, own + high) for own, (low, high) in about))
    try:
        return config_from_json(CableInputs, recorded)
    except ValueError as error:
        raise WeightsError(f"{source} records inputs that cannot be used: {error} Train it again.") from error
