"""The protocol of simulators that can be diagnosed, and explanations of a gap.

A diagnosis asks a simulator three things: which effects could be at work, with priors; what it predicts for the
recorded motions under some of them; and, where it knows better than forward differences, how predictions change with
the parameters. Planar cables (`cablejax.diagnose.planar`) and simulators of your own implement the same class:

    class Arm(Simulator):
        unit = "rad"
        effects = (
            Effect(name="payload", parameters=(Parameter("mass_kg", "kg", 0.0, 1.0, 0.2, 0.2),), null=(0.0,)),
            ...
        )

        def predict(self, explanations, episodes):
            values = np.stack([explanation.vector(self.effects) for explanation in explanations])
            return in_batches(rollout, values, self.commands[episodes])

    diagnose_simulator(Arm(), observed, interval=0.02)
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from cablejax.effects.effect import Effect

# Forward differences in what a recording has for its own, in prior standard deviations.
_OWN_DIFFERENCE = 0.03


@dataclasses.dataclass(frozen=True)
class Term:
    """One effect of an explanation.

    Attributes:
        effect: of the simulator.
        variant: one of `effect.variants`.
    """

    effect: Effect
    variant: int

    @property
    def size(self) -> int:
        """Number of its parameters."""
        return len(self.effect.parameters)

    def values(self, z: Sequence[float]) -> list[Any]:
        """Parameter values at the term's coordinates."""
        return [p.value(np.float64(x)) for p, x in zip(self.effect.parameters, z, strict=True)]


@dataclasses.dataclass(frozen=True)
class Explanation:
    """An explanation of the gap: effects that act together, with the values of their parameters.

    Attributes:
        terms: applied in this order; none = the nominal simulator.
        z: coordinates of all parameters, in the order of the terms, see `Parameter`.
        own: coordinates of what each recording has for its own, see `Simulator.own`.
    """

    terms: tuple[Term, ...]
    z: Float[np.ndarray, "P"]
    own: Float[np.ndarray, "R M"] = dataclasses.field(default_factory=lambda: np.zeros((0, 0)))

    def by_term(self, z: Any = None) -> list[tuple[Term, Any]]:
        """Every term with its part of the coordinates."""
        z, ends = self.z if z is None else z, np.cumsum([0, *(term.size for term in self.terms)])
        return [(term, z[begin:end]) for term, begin, end in zip(self.terms, ends[:-1], ends[1:], strict=True)]

    def values(self) -> list[np.ndarray]:
        """Parameter values of every term."""
        return [np.array(term.values(z)) for term, z in self.by_term()]

    def vector(self, effects: Sequence[Effect]) -> Float[np.ndarray, "V"]:
        """Parameter values of all effects one after the other, null values where an effect takes no part.

        Variants do not show in it: a simulator that has some looks at `by_term`.
        """
        present = {term.effect.name: term.values(z) for term, z in self.by_term()}
        return np.concatenate([np.asarray(present.get(effect.name, effect.null), float) for effect in effects])

    @property
    def differences(self) -> Float[np.ndarray, "P"]:
        """Steps of forward differences in the coordinates, inwards where the upper bound is near."""
        size = np.array([p.difference for term in self.terms for p in term.effect.parameters])
        return np.where(self.z + size > self.bounds[:, 1], -size, size)

    @property
    def bounds(self) -> Float[np.ndarray, "P 2"]:
        """Bounds of the coordinates."""
        return np.array([p.z_bounds for term in self.terms for p in term.effect.parameters]).reshape(-1, 2)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(term.effect.name for term in self.terms)

    def plus(self, *parts: tuple[Effect, int, Sequence[float]]) -> Explanation:
        """The explanation with more effects, given as to the function `explanation`."""
        more = explanation(*parts)
        return Explanation((*self.terms, *more.terms), np.append(self.z, more.z), self.own)

    def without(self, *names: str) -> Explanation:
        """The explanation without some of its effects."""
        kept = [(term, z) for term, z in self.by_term() if term.effect.name not in names]
        return Explanation(
            tuple(term for term, _ in kept), np.concatenate([np.zeros(0), *(z for _, z in kept)]), self.own
        )

    def moved(self, z: Float[np.ndarray, "P"], own: Float[np.ndarray, "R M"] | None = None) -> Explanation:
        """The same effects with other values; what is a recording's own stays where none is given."""
        return dataclasses.replace(self, z=z, own=self.own if own is None else own)


def explanation(*parts: tuple[Effect, int, Sequence[float]]) -> Explanation:
    """An explanation from (effect, variant, parameter values), each value brought within its bounds.

    Raises:
        ValueError: the effect has no such variant, or another number of parameters; a value is NaN.
    """
    for effect, variant, values in parts:
        if len(values) != len(effect.parameters) or np.isnan(np.asarray(values, float)).any():
            raise ValueError(f"Effect {effect.name!r} has the values {list(values)}, expected one number each.")
        if variant not in effect.variants:
            raise ValueError(f"Effect {effect.name!r} has the variant {variant}, expected one of {effect.variants}.")
    z = [
        np.clip(p.coordinate(float(np.clip(value, p.low, p.high))), *p.z_bounds)
        for effect, _, values in parts
        for p, value in zip(effect.parameters, values, strict=True)
    ]
    return Explanation(terms=tuple(Term(effect, variant) for effect, variant, _ in parts), z=np.array(z, np.float64))


@dataclasses.dataclass(frozen=True)
class Report:
    """A fitted effect in the words of its simulator.

    Attributes:
        parameters: by the names of the verdict, as (value, unit); choices are integers.
        location: where the effect sits: keys "along_cable_m", "time_s", "table_m" of the verdict, where they apply.
    """

    parameters: dict[str, tuple[Any, str]]
    location: dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Plan:
    """Effort of fits and checks, stated by the simulator.

    Attributes:
        first_steps, last_steps, grown_steps: Gauss-Newton steps of every single effect, of the best ones, and of sets
            of effects.
        tolerance: a fit ends once a step is predicted to lower its cost by less than this [nats].
        parts: most parts into which recordings are divided; every explanation is refitted without each part. None = one
            linear step approximates leaving out a motion, which suits many episodes without parameters of their own.
    """

    first_steps: int = 3
    last_steps: int = 8
    grown_steps: int = 5
    tolerance: float = 0.02
    parts: int | None = None


class Simulator(abc.ABC):
    """A simulator of one recording, as a diagnosis sees it.

    The simulator holds everything recorded except the observations: commands, measured poses, first states.

    Attributes:
        effects: possible effects, with distinct names.
        unit: of the observations; all have the same.
        right_scores: scores of right explanations on labelled recordings like this one, see `belief.leftover_p`; empty
            if there are none, and then no p-value is computed.
        beside_unknown: share of the effects named alongside an unknown cause that are causes, on labelled recordings;
            None if there are none, and then such names have no probability.
        plan: of the search and of the fits.
        recording: recording of every episode, counted from 0; only needed if single recordings have parameters.
        fits_unseen: whether a held-out recording's own parameters are fitted to it, as nuisances that say nothing about
            the cause. Otherwise they are 0 there.
    """

    effects: Sequence[Effect]
    unit: str = "m"
    right_scores: Sequence[float] = ()
    beside_unknown: float | None = None
    plan: Plan = Plan()
    recording: Sequence[int] | Int[np.ndarray, "E"] = ()
    fits_unseen: bool = False

    @property
    def other_laws(self) -> Mapping[str, Simulator]:
        """The same system by other laws that cannot be excluded, by what they assume in words; see `laws`."""
        return {}

    def own(self, one: Explanation) -> int:
        """Number of parameters of each recording alone under an explanation, each with a standard normal prior."""
        del one
        return 0

    def with_own(self, one: Explanation) -> Explanation:
        """The explanation with a row of own numbers for each recording: 0 where it has none yet."""
        count = self.own(one)
        kept = one.own if one.own.shape[1] == count else np.zeros((0, count))
        more = 1 + max(self.recording) - len(kept) if count else 0
        return dataclasses.replace(one, own=np.pad(kept, ((0, max(more, 0)), (0, 0))))

    @abc.abstractmethod
    def predict(self, explanations: Sequence[Explanation], episodes: Int[np.ndarray, "e"]) -> np.ndarray:
        """Predicts the observations under each explanation.

        Args:
            explanations: to simulate, each for every episode.
            episodes: which of the recorded ones.

        Returns:
            Shape [X, e, T, ...], the last axes as those of the observations; NaN where the simulation broke down.
        """

    def linearise(
        self, explanations: Sequence[Explanation], episodes: Int[np.ndarray, "e"]
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Predictions, and their derivatives by the coordinates; by forward differences unless overridden.

        These serve smooth effects and those with a threshold (yield, contact, slip) alike, where a derivative in the
        limit sees nothing at all on one side.

        Returns:
            For every explanation a prediction [e, T, ...] and its derivatives [P + M, e, T, ...]: by z, then by the
            M numbers that the episode's recording has for its own.
        """
        asked, steps = [], []
        for one in explanations:
            count = one.own.shape[1]
            asked += [one, *(one.moved(one.z + step) for step in np.diag(one.differences))]
            asked += [one.moved(one.z, one.own + step) for step in _OWN_DIFFERENCE * np.eye(count)]
            steps.append(np.concatenate([one.differences, np.full(count, _OWN_DIFFERENCE)]))
        predicted, result, begin = self.predict(asked, episodes), [], 0
        for differences in steps:
            here, moved = predicted[begin], predicted[begin + 1 : begin + 1 + len(differences)]
            begin += 1 + len(differences)
            with np.errstate(invalid="ignore"):
                slopes = moved - here
                slopes /= differences.reshape(-1, *[1] * here.ndim)
            result.append((here, slopes))
        return result

    def starts(
        self, effect: Effect, predicted: Float[np.ndarray, "E T *O"], residual: Float[np.ndarray, "E T *O"]
    ) -> Sequence[tuple[int, Sequence[float]]]:
        """Pairs (variant, values) from which fits of an effect begin; see `Effect.starts`.

        Args:
            effect: one of `effects`.
            predicted: by the explanation to which the effect would be added.
            residual: observed less predicted, NaN = not observed.
        """
        return effect.starts((predicted, residual))

    def report(self, term: Term, values: Sequence[float]) -> Report:
        """A fitted effect in the words of the verdict."""
        named = {p.name: (float(v), p.unit) for p, v in zip(term.effect.parameters, values, strict=True)}
        variant = term.effect.variant_name
        return Report(named if variant is None else {variant: (term.variant, ""), **named}, {})


def in_batches(
    run: Callable[..., Any], values: Float[np.ndarray, "X *E V"], *inputs: np.ndarray, size: int = 32
) -> np.ndarray:
    """Runs every set of values with every episode, in batches of one size, so that one program is compiled.

    Args:
        run: `run(values [B, V], *inputs [B, ...]) -> [B, ...]`, for example `jax.jit(jax.vmap(one))`.
        values: one row for each explanation, or for each explanation and episode: [X, E, V].
        inputs: one row for each episode.
        size: B, of a batch.

    Returns:
        Shape [X, E, ...].
    """
    n_episodes = len(inputs[0])
    pairs = np.stack(np.divmod(np.arange(len(values) * n_episodes), n_episodes), axis=1)
    parts = []
    for begin in range(0, len(pairs), size):
        rows = pairs[begin : begin + size]
        x, e = np.concatenate([rows, np.repeat(rows[:1], size - len(rows), axis=0)]).T
        here = values[x] if values.ndim == 2 else values[x, e]
        parts.append(np.asarray(run(here, *(each[e] for each in inputs)))[: len(rows)])
    flat = np.concatenate(parts)
    return flat.reshape(len(values), n_episodes, *flat.shape[1:])
