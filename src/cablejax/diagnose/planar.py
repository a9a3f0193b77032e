"""The adapter of planar cables: the chain's playback of a log behind the protocol of simulators."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
from jaxtyping import Float

from cablejax.cable import Discretisation
from cablejax.diagnose.belief import BESIDE_UNKNOWN, SCORES
from cablejax.diagnose.playback import Playback
from cablejax.diagnose.protocol import Explanation, Report, Simulator
from cablejax.effects.base import CableEffect, Context
from cablejax.effects.physics import Physics

OTHER_LAWS = {
    "the grippers hold the cable's ends 1 mm above the table and carry their weight": {"grip_height": 1e-3},
    "static friction exceeds the kinetic one by 30 %": {"static_excess": 0.3},
}
"""What a nominal law of contact leaves out, in words and in fields of `Physics`."""


def physics_of(explanation: Explanation, nominal: Physics, config: Discretisation, z: Any = None) -> Physics:
    """The physics of a cable with all effects of an explanation.

    Args:
        explanation: of effects of a cable.
        nominal: physics without them.
        config: the nominal cable.
        z: coordinates in place of the explanation's own; the result is differentiable in them if they are a JAX array.
    """
    terms = explanation.by_term(np.asarray(explanation.z, np.float32) if z is None else z)
    for term, part in sorted(terms, key=lambda one: cast(CableEffect, one[0].effect).stage):
        effect = cast(CableEffect, term.effect)
        values = [p.value(x) for p, x in zip(effect.parameters, part, strict=True)]
        nominal = effect.apply(nominal, values, term.variant, config)
    return nominal


@dataclasses.dataclass(frozen=True)
class PlanarCable(Simulator):
    """A cable on a table between two grippers that move as recorded.

    Attributes:
        effects: of the cable and the camera.
        playback: of the recorded motions, at the resolution of the fits.
        correction: what a finer cable without effects moves otherwise [m]; it is added to all predictions. Its shape
            broadcasts against [E, T, N, 2].
        duration: of the shortest episode [s].
        max_curvature: largest curvature of the nominal cable in each episode [1/m], shape [E].
        readings: the same by what else the log may mean, by what that assumes in words; see `reading`.
    """

    effects: Sequence[CableEffect]
    playback: Playback
    correction: Float[np.ndarray, "E T N 2"]
    duration: float
    max_curvature: Float[np.ndarray, "E"]
    readings: Mapping[str, PlanarCable] = dataclasses.field(default_factory=dict)
    right_scores = SCORES
    beside_unknown = BESIDE_UNKNOWN

    @property
    def other_laws(self) -> dict[str, Simulator]:
        """The same cable under each of `OTHER_LAWS`, and under other readings of the log."""
        believed, laws = self.playback.believed, dict[str, Simulator](self.readings)
        for assumes, fields in OTHER_LAWS.items():
            values = {name: np.asarray(value, believed.friction.dtype) for name, value in fields.items()}
            changed = dataclasses.replace(believed, **values)
            laws[assumes] = dataclasses.replace(
                self,
                playback=dataclasses.replace(self.playback, believed=changed),
                effects=tuple(effect.besides(changed) for effect in self.effects),
            )
        return laws

    def predict(self, explanations, episodes) -> Float[np.ndarray, "X E T N 2"]:
        """Keypoints [m] by the chain, in single precision; NaN where the simulation broke down."""
        playback = self.playback
        physics = [physics_of(one, playback.believed, playback.config) for one in explanations]
        return playback.keypoints(physics, episodes) + self.correction[np.asarray(episodes, int)]

    def starts(self, effect, predicted, residual):
        """The effect's own guesses, from the predicted cable and the residual."""
        context = Context(
            config=self.playback.config,
            keypoints=predicted,
            residual=residual,
            duration=self.duration,
            max_curvature=self.max_curvature,
        )
        return effect.starts(context)

    def report(self, term, values) -> Report:
        """A fitted effect with the names and units of the gap log's format."""
        effect, config = cast(CableEffect, term.effect), self.playback.config
        marks = tuple(self.playback.arclength)
        marked = dataclasses.replace(config, cable=dataclasses.replace(config.cable, marks=marks))
        return Report(
            effect.reported(values, term.variant, config), dict(effect.location(values, term.variant, marked))
        )
