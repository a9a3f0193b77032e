"""Validates the input of a diagnosis: arrays, the noise, and a simulator that follows the protocol."""

from __future__ import annotations

import numpy as np
from jaxtyping import ArrayLike, Float

from cablejax.diagnose.noise import noise_floor
from cablejax.diagnose.protocol import Explanation, Simulator, explanation
from cablejax.effects.effect import Effect

# Of the noise: by so much predictions may differ that should be the same.
_SAME = 0.01


def checked_nominal(
    simulator: Simulator, observed: Float[np.ndarray, "E T *O"], noise: Float[np.ndarray, "*O"]
) -> Float[np.ndarray, "E T *O"]:
    """Predictions without any effect, from a simulator that does what the protocol asks for.

    Raises:
        ValueError: it does not; the message says what was found and what was expected.
    """
    if not isinstance(simulator, Simulator):
        raise ValueError(f"The simulator is {_kind(simulator)}, expected an instance of a subclass of `Simulator`.")
    effects = list(getattr(simulator, "effects", ()))
    if strange := [effect for effect in effects if not isinstance(effect, Effect)]:
        raise ValueError(f"The simulator's effects hold {_kind(strange[0])}, expected instances of `Effect`.")
    names = [effect.name for effect in effects]
    if not effects or len(set(names)) < len(names):
        raise ValueError(f"The simulator has the effects {names}, expected at least one, and every name once.")
    own = any(simulator.own(explanation((e, e.variants[0], e.null))) for e in effects)
    if own and (len(simulator.recording) != len(observed) or simulator.plan.parts is None):
        raise ValueError(
            "Recordings have parameters of their own (`own`), which needs `recording`, one number for each of "
            f"{len(observed)} episodes (it has {len(simulator.recording)}), and a plan that leaves out parts of them: "
            f"Plan(parts=...) of 2 or more (it is {simulator.plan.parts})."
        )
    if own and len(observed) < 2:
        raise ValueError(
            "There is one episode, and recordings have parameters of their own (`own`), so nothing can be left out of "
            "a fit. Record more."
        )
    nulls: list[Explanation] = []
    for effect in effects:
        with np.errstate(divide="ignore"):
            null = explanation((effect, effect.variants[0], effect.null))
        # a null value beyond the bounds is a limit that no fit reaches
        if np.allclose(null.values()[0], effect.null):
            nulls.append(null)
    everything = np.arange(len(observed))
    predicted = simulator.predict([explanation(), *nulls], everything)
    if not isinstance(predicted, np.ndarray) or predicted.dtype.kind != "f":
        kind = f"an array of {predicted.dtype}" if isinstance(predicted, np.ndarray) else _kind(predicted)
        raise ValueError(f"predict gave {kind}, expected a NumPy array of floating point numbers.")
    expected = (1 + len(nulls), *observed.shape)
    if predicted.shape != expected:
        raise ValueError(f"predict gave an array of shape {predicted.shape}, expected {expected}: [X, E, T, ...].")
    nominal = predicted[0]
    seen = np.isfinite(observed)
    if not np.isfinite(nominal[seen]).all():
        raise ValueError("The simulation without any effect is not finite in samples that were observed.")

    def off(one, other, where) -> float:
        return float(np.where(where, np.abs(one - other) / noise, 0.0).max(initial=0.0))

    for null, moved in zip(nulls, predicted[1:], strict=True):
        if not off(moved, nominal, seen) <= _SAME:
            raise ValueError(
                f"Effect {null.names[0]!r} at its null value {null.terms[0].effect.null} changes the prediction by up "
                f"to {off(moved, nominal, seen):.2g} times the noise, expected no change."
            )
    last = np.asarray(simulator.predict([explanation()], everything[-1:]), float)
    if last.shape != (1, 1, *observed.shape[1:]) or not off(last[0], nominal[-1:], seen[-1:]) <= _SAME:
        raise ValueError(
            f"predict for episode {len(observed) - 1} alone gave an array of shape {last.shape} that differs from the "
            "last episode of its array for all episodes: it has to simulate the episodes that it is asked for."
        )
    return nominal


def _kind(value: object) -> str:
    """What was given, in words."""
    return f"the class {value.__name__}" if isinstance(value, type) else f"a {type(value).__name__}"


def inert_effects(simulator: Simulator, observed: Float[np.ndarray, "E T *O"], nominal: np.ndarray) -> list[str]:
    """Caveats of effects with which `predict` gives no numbers on this recording, or the same as without them.

    Raises:
        ValueError: that is so of every effect.
    """
    begun = [
        explanation((effect, *start))
        for effect in simulator.effects
        for start in simulator.starts(effect, nominal, observed - nominal)
    ]
    predicted = np.asarray(simulator.predict(begun, np.arange(len(observed))), float) if begun else np.zeros(0)
    seen, caveats = np.isfinite(observed), []
    for effect in simulator.effects:
        own = [k for k, one in enumerate(begun) if one.names == (effect.name,)]
        finite = [k for k in own if np.isfinite(predicted[k][seen]).all()]
        if not own or any((predicted[k] != nominal)[seen].any() for k in finite):
            continue
        values = ", ".join(
            f"{p.name} = {v:g}" for p, v in zip(effect.parameters, begun[own[-1]].values()[0], strict=True)
        )
        gives = "exactly what it gives without" if finite == own else "values that are not finite"
        caveats.append(f"With {effect.name} ({values}) predict gives {gives}: the effect was not tried.")
    if simulator.effects and len(caveats) == len(simulator.effects):
        raise ValueError(f"{' '.join(caveats)} Does predict use its explanations?")
    return caveats


def recorded_arrays(observed: ArrayLike, interval: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """The observations, shape [E, T, ...], and the sample interval of each episode [s].

    Raises:
        ValueError: arrays that are no recording.
    """
    if np.ma.is_masked(observed):
        raise ValueError("observed is a masked array, expected NaN where nothing was observed: array.filled(np.nan).")
    given = np.asarray(observed)
    if given.dtype.kind not in "fiu":
        raise ValueError(f"observed is an array of {given.dtype}, expected real numbers.")
    observed = given.astype(float)
    if np.isinf(observed).any():
        raise ValueError("observed has infinite values, expected numbers, and NaN where nothing was observed.")
    if observed.ndim < 3 or not np.isfinite(observed).any():
        raise ValueError(
            f"observed has shape {observed.shape} and {np.isfinite(observed).sum()} finite values, expected episodes, "
            "samples and at least one observed coordinate: [E, T, ...]."
        )
    every = np.asarray(interval, float)
    if every.shape not in ((), (len(observed),)):
        raise ValueError(f"interval has shape {every.shape}, expected one number, or one for each of {len(observed)}.")
    every = np.broadcast_to(every, len(observed))
    if not (np.isfinite(every) & (every > 0)).all():
        raise ValueError(f"interval is {interval} s, expected positive numbers.")
    return observed, every


def spread_of(observed: Float[np.ndarray, "E T *O"], noise: ArrayLike | None) -> np.ndarray:
    """Standard deviation of the observed coordinates: as given, else from differences in time.

    Raises:
        ValueError: it does not broadcast to one sample, or is not positive.
    """
    shape = observed.shape[2:]
    if noise is None:
        flat = observed.reshape(*observed.shape[:2], -1, 1)
        return noise_floor(flat, None, smallest=0.0).std.reshape(shape)
    spread = np.asarray(noise, float)
    try:
        np.broadcast_to(spread, shape)
    except ValueError as error:
        raise ValueError(f"noise has shape {spread.shape}, which does not broadcast to {shape}.") from error
    if not (np.isfinite(spread) & (spread > 0)).all():
        raise ValueError(f"noise is {spread}, expected positive standard deviations: no measurement is exact.")
    return spread
