"""`diagnose`: from a gap log to a verdict."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import math
import time
from collections.abc import Callable, Sequence

import numpy as np

from cablejax.diagnose.belief import Calibration, excess, level
from cablejax.diagnose.case import FINE_LINKS, FIT_LINKS, Case
from cablejax.diagnose.conclude import baselines, conclude, with_arms
from cablejax.diagnose.diagnosis import Diagnosis
from cablejax.diagnose.fit import candidate, evaluate
from cablejax.diagnose.gap import held_out_keypoints, measure_gap
from cablejax.diagnose.judgement import sentence
from cablejax.diagnose.next_motion import next_motion
from cablejax.diagnose.noise import SMALLEST
from cablejax.diagnose.search import Search, search
from cablejax.diagnose.where import localise
from cablejax.effects import LIBRARY, Effect
from cablejax.types import GapLog


def _silent(text: str) -> None:
    del text


def diagnose(
    log: GapLog,
    *,
    effects: Sequence[Effect] = LIBRARY,
    commissioning: Sequence[GapLog] = (),
    calibration: Calibration = Calibration(),
    budget: float = math.inf,
    progress: Callable[[str], None] = _silent,
) -> Diagnosis:
    """Says where the nominal simulator is wrong on this log, which effect causes it, how far the gap shrinks with it.

    Args:
        log: of a cable on a table between two grippers; its `meta` states the cable and table believed in.
        effects: what to look for; `LIBRARY` and effects of your own.
        commissioning: logs known to have no effect: how far the simulator is off without any.
        calibration: constants of the judgement.
        budget: seconds after which no larger set of effects is tried; what was fitted until then counts.
        progress: called with a line of text now and then.

    Raises:
        DiagnosisError: the log cannot be diagnosed; the message says why and what to do.
    """
    begin = time.perf_counter()
    if commissioning:
        calibration = dataclasses.replace(calibration, baseline=baseline_error(commissioning))
    case = Case.of(log)
    recording = case.recording
    caveats = list(recording.caveats)
    if not commissioning:
        caveats.append(
            "No commissioning logs were given: the simulator's own error is not separated from the cable's gap; "
            f"{1e3 * calibration.baseline:.2g} mm of it is assumed."
        )
    if case.noise.std.max() <= SMALLEST:
        caveats.append(f"The keypoints carry no noise to speak of; {1e3 * SMALLEST:g} mm is assumed.")
    arms = case.arms
    evidence = case.evidence(calibration)
    null = evaluate(evidence, [candidate()])[0]
    gap = excess(float(null.sse.sum()), evidence)
    if gap > calibration.smallest_gap(level(evidence)):
        found = search(evidence, null, effects, case.context(), calibration, deadline=begin + budget, progress=progress)
    else:
        found = Search((null,), np.zeros(1), {})
    conclusion = conclude(found, evidence, calibration)
    conclusion = with_arms(conclusion, arms)

    progress("fitting without each episode in turn")
    after, held_out = held_out_keypoints(case, evidence, conclusion.best)
    reference = case.nominal
    if arms.deviates:
        # the simulator as believed follows the commands; with the arms' effects in it, what these predict
        reference, best = case.commanded_nominal, conclusion.best.candidate
        after = after + case.simulate(best, predicted=True) - case.simulate(best)
    measured = measure_gap(case, reference, after, held_out=held_out, resolvable=conclusion.verdict != "none")
    progress("looking for the next motion")
    rivals = [fit.candidate for fit in found.fits if fit.candidate.terms][:2]
    following = None
    if conclusion.verdict != "none" and rivals:
        following = next_motion(case.playback, rivals, case.noise.std)
    repaired = recording.as_log(log.meta)
    return Diagnosis(
        verdict=conclusion.verdict,
        sentence=sentence(
            conclusion.verdict,
            conclusion.effects,
            conclusion.equivalent,
            conclusion.explained if measured.shrinkage is None else measured.shrinkage,
        ),
        effects=conclusion.effects,
        equivalent=conclusion.equivalent,
        ranking=conclusion.ranking,
        leftover_p=conclusion.leftover_p,
        gap=measured,
        where=localise(repaired, case.to_log(reference), case.noise.std),
        next_motion=following,
        baselines=baselines(found, evidence),
        caveats=tuple(caveats),
        log=repaired,
        nominal=case.to_log(reference),
        explained=None if conclusion.verdict == "none" else case.to_log(after),
        noise_mm=1e3 * case.noise.std,
        noise_correlation=case.noise.correlation,
        seconds=time.perf_counter() - begin,
        settings={
            "effects": [e.name for e in effects],
            "calibration": dataclasses.asdict(calibration),
            "links": {"fit": FIT_LINKS, "nominal": FINE_LINKS},
            **{p: importlib.metadata.version(p) for p in ("jax", "mujoco", "numpy")},
        },
    )


def baseline_error(logs: Sequence[GapLog]) -> float:
    """Root mean square error per coordinate above the noise [m] on logs without any effect."""
    squares = []
    for log in logs:
        case = Case.of(log)
        evidence = case.evidence(Calibration())
        squares.append(excess(float(evaluate(evidence, [candidate()])[0].sse.sum()), evidence) ** 2)
    return max(float(np.sqrt(np.mean(squares))), 5e-5)
