"""The diagnosis of any simulator: from observations and a simulator's predictions to a verdict."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import math
import time
from collections.abc import Callable

import numpy as np
from jaxtyping import ArrayLike, Float, Int

from cablejax.diagnose.belief import Calibration, excess, level
from cablejax.diagnose.conclude import Conclusion, baselines, conclude, sentence
from cablejax.diagnose.diagnosis import Diagnosis
from cablejax.diagnose.evidence import Evidence
from cablejax.diagnose.fit import evaluate
from cablejax.diagnose.gap import held_out_predictions, measure_gap
from cablejax.diagnose.noise import noise_floor
from cablejax.diagnose.protocol import Explanation, Simulator, explanation
from cablejax.diagnose.search import Search, search

# Of the noise: the error of its own that a simulator is taken to have if nobody says more.
_BASELINE = 0.1
# Of the noise: by so much predictions may differ that should be the same.
_SAME = 0.01


def _silent(text: str) -> None:
    del text


def diagnose_simulator(
    simulator: Simulator,
    observed: Float[ArrayLike, "E T *O"],
    *,
    interval: Float[ArrayLike, "*E"],
    noise: Float[ArrayLike, "*O"] | None = None,
    motion: Int[ArrayLike, "E"] | None = None,
    calibration: Calibration | None = None,
    budget: float = math.inf,
    progress: Callable[[str], None] = _silent,
) -> Diagnosis:
    """Says which effect makes a simulator of your own wrong on a recording, and how far the gap shrinks with it.

    Args:
        simulator: of what was recorded.
        observed: in the simulator's unit, NaN = not observed or beyond an episode's end, shape [E, T, ...].
        interval: between samples [s], one number or one for each episode.
        noise: standard deviation of the observed coordinates, of a shape that broadcasts against `observed[e, t]`; None
            = estimated from third differences in time, which takes motion that is smooth at this interval.
        motion: episodes with the same number repeat one another and share one vote; None = no two do.
        calibration: constants of the judgement; its `baseline` is the error of the simulator without any effect. By
            default a tenth of the noise is assumed.
        budget: seconds after which no larger set of effects is tried; what was fitted until then counts.
        progress: called with a line of text now and then.

    Returns:
        The diagnosis; what only an adapter with more knowledge computes (`where`, `next_motion`, `leftover_p`,
        `gap.ahead_mm`) is None.

    Raises:
        ValueError: arrays or a simulator that cannot be diagnosed; the message says what was expected.
    """
    begin = time.perf_counter()
    observed, interval = _recorded(observed, interval)
    spread = _noise(observed, noise)
    motion = np.arange(len(observed)) if motion is None else np.asarray(motion, int)
    if motion.shape != (len(observed),):
        raise ValueError(f"motion has shape {motion.shape}, expected one number for each of {len(observed)} episodes.")
    nominal = checked_nominal(simulator, observed, spread)
    caveats = []
    if calibration is None:
        calibration = Calibration(baseline=_BASELINE * float(np.sqrt(np.mean(spread**2))))
        caveats.append(
            f"No calibration was given: the simulator's own error is taken to be {_BASELINE:g} times the noise."
        )
    evidence = weighed(simulator, observed, nominal, spread, motion, calibration)
    found, conclusion = explain(evidence, calibration, deadline=begin + budget, progress=progress)
    progress("fitting without each episode in turn")
    after, held_out = held_out_predictions(evidence, conclusion.best)
    seen = np.asarray(np.isfinite(observed).any(axis=tuple(range(2, observed.ndim))))
    gap = measure_gap(
        evidence,
        nominal,
        after,
        interval=interval,
        length=observed.shape[1] - np.argmax(seen[:, ::-1], axis=1),
        held_out=held_out,
        resolvable=conclusion.verdict != "none",
    )
    return Diagnosis(
        verdict=conclusion.verdict,
        sentence=sentence(conclusion, gap.shrinkage),
        effects=conclusion.effects,
        equivalent=conclusion.equivalent,
        ranking=conclusion.ranking,
        leftover_p=conclusion.leftover_p,
        gap=gap,
        where=None,
        next_motion=None,
        baselines=baselines(found, evidence),
        caveats=tuple(caveats),
        seconds=time.perf_counter() - begin,
        settings=settings_of(simulator, calibration),
    )


def weighed(
    simulator: Simulator,
    observed: Float[np.ndarray, "E T *O"],
    nominal: Float[np.ndarray, "E T *O"],
    noise: Float[np.ndarray, "*O"],
    motion: Int[np.ndarray, "E"],
    calibration: Calibration,
) -> Evidence:
    """What a recording says, weighed by the noise and by what simulators get wrong without any effect."""
    bare = Evidence(
        simulator=simulator,
        episodes=np.arange(len(observed)),
        observed=observed,
        nominal=nominal,
        noise=noise,
        temper=np.ones(len(observed)),
        freedom=calibration.freedom,
        motion=motion,
    )
    squares = (bare.whitened(nominal) ** 2).sum(axis=1)
    gap = level(bare) * np.sqrt(np.maximum(squares / np.maximum(bare.count, 1) - 1, 0.0))
    return dataclasses.replace(bare, temper=calibration.temper(gap, level(bare)))


def explain(
    evidence: Evidence, calibration: Calibration, *, deadline: float, progress: Callable[[str], None]
) -> tuple[Search, Conclusion]:
    """Searches for explanations where there is a gap, and judges them.

    Args:
        evidence: to explain.
        calibration: of the judgement.
        deadline: on `time.perf_counter`; from then on no larger set of effects is begun [s].
        progress: called with a line of text before each stage.
    """
    null = evaluate(evidence, [explanation()])[0]
    if excess(float(null.sse.sum()), evidence) > calibration.smallest_gap(level(evidence)):
        found = search(evidence, null, calibration, deadline=deadline, progress=progress)
    else:
        found = Search((null,), np.zeros(1), {})
    return found, conclude(found, evidence, calibration)


def settings_of(simulator: Simulator, calibration: Calibration) -> dict:
    """What a diagnosis was made with, for the record."""
    return {
        "effects": [effect.name for effect in simulator.effects],
        "calibration": dataclasses.asdict(calibration),
        **{package: importlib.metadata.version(package) for package in ("jax", "mujoco", "numpy")},
    }


def checked_nominal(
    simulator: Simulator, observed: Float[np.ndarray, "E T *O"], noise: Float[np.ndarray, "*O"]
) -> Float[np.ndarray, "E T *O"]:
    """Predictions without any effect, from a simulator that does what the protocol asks for.

    Raises:
        ValueError: it does not; the message says what came and what was expected.
    """
    effects = list(simulator.effects)
    names = [effect.name for effect in effects]
    if not effects or len(set(names)) < len(names):
        raise ValueError(f"The simulator has the effects {names}, expected at least one, and every name once.")
    nulls: list[Explanation] = []
    for effect in effects:
        with np.errstate(divide="ignore"):
            null = explanation((effect, effect.variants[0], effect.null))
        # a null value beyond the bounds is a limit that no fit reaches
        if np.allclose(null.values()[0], effect.null):
            nulls.append(null)
    everything = np.arange(len(observed))
    predicted = np.asarray(simulator.predict([explanation(), *nulls], everything), float)
    expected = (1 + len(nulls), *observed.shape)
    if predicted.shape != expected:
        raise ValueError(f"predict gave an array of shape {predicted.shape}, expected {expected}: [X, E, T, ...].")
    nominal = predicted[0]
    seen = np.isfinite(observed)
    if not np.isfinite(nominal[seen]).all():
        raise ValueError("The simulation without any effect breaks down where something was observed.")

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
            f"predict for episode {len(observed) - 1} alone gave an array of shape {last.shape} that is not the last "
            "part of what it gave for all episodes: it has to simulate the episodes that it is asked for."
        )
    return nominal


def _recorded(observed, interval) -> tuple[np.ndarray, np.ndarray]:
    observed = np.asarray(observed, float)
    if observed.ndim < 3 or not np.isfinite(observed).any():
        raise ValueError(
            f"observed has shape {observed.shape} and {np.isfinite(observed).sum()} finite values, expected episodes, "
            "samples and at least one observed coordinate: [E, T, ...]."
        )
    every = np.broadcast_to(np.asarray(interval, float), len(observed))
    if not (np.isfinite(every) & (every > 0)).all():
        raise ValueError(f"interval is {interval} s, expected positive numbers.")
    return observed, every


def _noise(observed: Float[np.ndarray, "E T *O"], noise) -> np.ndarray:
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
