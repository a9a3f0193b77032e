"""The diagnosis of any simulator: from observations and a simulator's predictions to a verdict."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float, Int

from cablejax.diagnose.belief import Calibration, has_gap, level
from cablejax.diagnose.conclude import Conclusion, conclude, sentence
from cablejax.diagnose.diagnosis import Diagnosis, Gap
from cablejax.diagnose.evidence import Evidence
from cablejax.diagnose.fit import Fit, evaluate, improve
from cablejax.diagnose.gap import held_out_predictions, measure_gap
from cablejax.diagnose.given_arrays import checked_nominal, inert_effects, recorded_arrays, spread_of
from cablejax.diagnose.laws import by_other_laws
from cablejax.diagnose.protocol import Simulator, explanation
from cablejax.diagnose.refits import refitted
from cablejax.diagnose.search import Search, baselines, search
from cablejax.provenance import package_versions

# Of the noise: the error of its own that a simulator is taken to have if nobody says more.
_BASELINE = 0.1
# Prior standard deviations at which a fitted value is worth a word.
_FAR = 3.0


def diagnose_simulator(
    simulator: Simulator,
    observed: Float[ArrayLike, "E T *O"],
    *,
    interval: Float[ArrayLike, "*E"],
    noise: Float[ArrayLike, "*O"] | None = None,
    motion: Int[ArrayLike, "E"] | None = None,
    calibration: Calibration | None = None,
    progress: Callable[[str], None] = lambda text: None,
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
        progress: called with a line of text now and then.

    Returns:
        The diagnosis; what only an adapter with more knowledge computes (`where`, `next_motion`, `leftover_p`,
        `gap.ahead_mm`) is None.

    Raises:
        ValueError: arrays or a simulator that cannot be diagnosed; the message says what was expected.
    """
    begin = time.perf_counter()
    if not isinstance(calibration, Calibration | None):
        raise ValueError(f"calibration is {calibration!r}, expected a `Calibration` or None.")
    observed, interval = recorded_arrays(observed, interval)
    spread = spread_of(observed, noise)
    motion = np.arange(len(observed)) if motion is None else np.asarray(motion)
    if motion.shape != (len(observed),) or motion.dtype.kind not in "iu":
        raise ValueError(
            f"motion is {motion.dtype} of shape {motion.shape}, expected one whole number for each of {len(observed)} "
            "episodes."
        )
    nominal = checked_nominal(simulator, observed, spread)
    caveats = inert_effects(simulator, observed, nominal)
    if calibration is None:
        calibration = Calibration(baseline=_BASELINE * float(np.sqrt(np.mean(spread**2))))
        caveats.append(
            f"No calibration was given: the simulator's own error is assumed to be {_BASELINE:g} times the noise."
        )
    evidence = weighed(simulator, observed, nominal, spread, motion, calibration)
    examined = examine(evidence, interval, calibration, progress=progress)
    caveats += _far_out(examined.conclusion)
    return Diagnosis(
        **examined.fields(),
        where=None,
        caveats=tuple(caveats),
        seconds=time.perf_counter() - begin,
        settings=settings_of(simulator, calibration),
    )


def _far_out(conclusion: Conclusion) -> list[str]:
    """Caveats of fitted values that their prior did not expect."""
    best = conclusion.best.explanation
    return [
        f"{term.effect.name}: {parameter.name} lies {abs(z):.1f} prior standard deviations from its prior median. If "
        "this value is plausible, widen the prior."
        for term, part in best.by_term()
        for parameter, z in zip(term.effect.parameters, part, strict=True)
        if abs(z) > _FAR
    ]


@dataclasses.dataclass(frozen=True)
class Examined:
    """Common part of all diagnoses.

    Attributes:
        found: by the search.
        conclusion: from it.
        before, after: predictions without any effect, and by the best explanation; each episode from a fit that has
            not seen it, shape [E, T, ...].
        gap: before and after.
    """

    found: Search
    conclusion: Conclusion
    before: Float[np.ndarray, "E T *O"]
    after: Float[np.ndarray, "E T *O"]
    gap: Gap

    def fields(self) -> dict[str, Any]:
        """The fields of `Diagnosis` that follow from these."""
        shared = {f.name for f in dataclasses.fields(Conclusion)} & {f.name for f in dataclasses.fields(Diagnosis)}
        return {name: getattr(self.conclusion, name) for name in shared} | {
            "sentence": sentence(self.conclusion, self.gap.shrinkage),
            "gap": self.gap,
            "baselines": baselines(self.found),
        }


def examine(
    evidence: Evidence,
    interval: Float[np.ndarray, "E"],
    calibration: Calibration,
    *,
    progress: Callable[[str], None],
) -> Examined:
    """Searches, judges, and measures the gap on held-out episodes.

    Args:
        evidence: to explain.
        interval: between samples of each episode [s].
        calibration: of the judgement.
        progress: called with a line of text before each stage.
    """
    found, conclusion = explain(evidence, calibration, progress=progress)
    progress("fitting without each episode in turn")
    before = evidence.nominal if found.null.refits is None else held_out_predictions(evidence, found.null)[0]
    after, held_out = held_out_predictions(evidence, conclusion.best)
    seen = np.asarray(np.isfinite(evidence.observed).any(axis=tuple(range(2, evidence.observed.ndim))))
    gap = measure_gap(
        evidence,
        before,
        after,
        interval=interval,
        length=evidence.observed.shape[1] - np.argmax(seen[:, ::-1], axis=1),
        held_out=held_out,
        resolvable=conclusion.verdict != "none",
    )
    return Examined(found, conclusion, before, after, gap)


def weighed(
    simulator: Simulator,
    observed: Float[np.ndarray, "E T *O"],
    nominal: Float[np.ndarray, "E T *O"],
    noise: Float[np.ndarray, "*O"],
    motion: Int[np.ndarray, "E"],
    calibration: Calibration,
    own_error: Float[np.ndarray, "E"] | None = None,
) -> Evidence:
    """Evidence of a recording, weighted by the noise and the simulator's own error.

    That is `own_error` in each episode, or the calibration's baseline error in all.

    Where recordings have numbers of their own, the nominal simulator has them fitted: they are no part of the gap.
    """
    seen = np.isfinite(observed).any(axis=tuple(range(1, observed.ndim)))
    bare = Evidence(
        simulator=simulator,
        episodes=np.arange(len(observed)),
        observed=observed,
        nominal=nominal,
        noise=noise,
        temper=np.ones(len(observed)),
        freedom=calibration.freedom,
        # a motion of which nothing was observed is none that can be left out, or drawn
        motion=np.where(seen, motion, motion[seen.argmax()]),
        fit_freedom=calibration.fit_freedom,
        own_error=own_error,
    )
    if simulator.own(explanation()):
        temper = calibration.temper(np.zeros(len(observed)), level(bare), bare.count)
        bare = dataclasses.replace(bare, temper=temper)
        nominal = bare.predict([_null(bare).explanation])[0]
        bare = dataclasses.replace(bare, nominal=nominal)
    squares = (bare.whitened(nominal) ** 2).sum(axis=1)
    gap = level(bare) * np.sqrt(np.maximum(squares / np.maximum(bare.count, 1) - 1, 0.0))
    return dataclasses.replace(bare, temper=calibration.temper(gap, level(bare), bare.count, own_error))


def explain(
    evidence: Evidence, calibration: Calibration, *, progress: Callable[[str], None]
) -> tuple[Search, Conclusion]:
    """Searches for explanations where there is a gap, and judges them."""
    (null,) = refitted(evidence, [_null(evidence)])
    if has_gap(null, evidence, calibration):
        found = search(evidence, null, calibration, progress=progress)
        progress("fitting by other laws")
        found = by_other_laws(found)
    else:
        found = Search.of([null], evidence, calibration)
    return found, conclude(found)


def _null(evidence: Evidence) -> Fit:
    """The nominal simulator, with what each recording has for its own."""
    return improve(evidence, evaluate(evidence, [explanation()]), evidence.simulator.plan.last_steps)[0]


def settings_of(simulator: Simulator, calibration: Calibration) -> dict:
    """Provenance of a diagnosis."""
    return {
        "effects": [effect.name for effect in simulator.effects],
        "calibration": dataclasses.asdict(calibration),
        **package_versions(("jax", "mujoco", "numpy")),
    }
