"""`diagnose`: from a gap log of a cable on a table to a verdict."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from cablejax.diagnose.actuation_verdict import negligible, with_arms
from cablejax.diagnose.belief import Calibration, excess
from cablejax.diagnose.case import FINE_LINKS, FIT_LINKS, Case, calibrated
from cablejax.diagnose.caveats import caveats_of, contradictions, rarely_left, silent_motions
from cablejax.diagnose.conclude import Conclusion, sentence
from cablejax.diagnose.diagnosis import CableDiagnosis, Gap, NextMotion
from cablejax.diagnose.evidence import Evidence
from cablejax.diagnose.fit import evaluate
from cablejax.diagnose.gap import held_out_predictions, measure_gap
from cablejax.diagnose.length import Length, other_length
from cablejax.diagnose.motion_bounds import Bounds, BoundsError
from cablejax.diagnose.motion_design import DesignConfig
from cablejax.diagnose.motion_judge import Judge, Objective
from cablejax.diagnose.next_motion import next_motion, require_some_motion
from cablejax.diagnose.noise import SMALLEST
from cablejax.diagnose.protocol import explanation
from cablejax.diagnose.reading import Reading, held, with_readings
from cablejax.diagnose.reference import ahead_of_observations
from cablejax.diagnose.rounds import rounds_of
from cablejax.diagnose.run import Examined, explain, settings_of
from cablejax.diagnose.search import Search
from cablejax.diagnose.where import localise
from cablejax.effects import LIBRARY, CableEffect
from cablejax.gaplog_join import joined
from cablejax.types import GapLog

_ARMS = "The arms do not follow their commands, and no effect of the library explains why."
_ARMS_TOO = {
    "none": f"With the measured poses the simulator explains this log. {_ARMS}",
    **dict.fromkeys(("named", "ambiguous"), f"With the measured poses: {{}} {_ARMS}"),
}
"""Sentences of a log in which arms stray, by the verdict on the cable alone."""
# Growth of small errors that an explanation may have beyond what its evidence was weighed by.
_MORE_GROWTH = 3.0


def diagnose(
    log: GapLog,
    *,
    effects: Sequence[CableEffect] = LIBRARY,
    commissioning: Sequence[GapLog] = (),
    calibration: Calibration | None = None,
    bounds: Bounds | None = None,
    objective: Objective = "explanations",
    progress: Callable[[str], None] = lambda text: None,
) -> CableDiagnosis:
    """Says where the nominal simulator is wrong on this log, which effect causes it, how far the gap shrinks with it.

    Args:
        log: of a cable on a table between two grippers; its `meta` states the cable and table believed in.
        effects: what to look for; `LIBRARY` and effects of your own.
        commissioning: logs known to have no effect: how far the simulator is off without any.
        calibration: constants of the judgement; by default those for a cable of this length, see `case.calibrated`,
            with what errors of its stated stiffness and friction make, and noise of the gripper poses; see
            `Case.stated_error` and `Case.pose_error`.
        bounds: for a next motion that is designed; None = the best of the safe motions within the default bounds.
        objective: what the next motion is to give information about.
        progress: called with a line of text now and then.

    Raises:
        DiagnosisError: the log cannot be diagnosed; the message says why and what to do.
        BoundsError: no motion of the cable keeps all bounds; says how many each bound excludes.
    """
    begin = time.perf_counter()
    case = Case.of(log, effects)
    calibration, stated = _constants(case, calibration, commissioning)
    if bounds is not None:
        require_some_motion(case.simulator.playback, case.noise.std, bounds)
    case, found, conclusion, length, taken = _read(case, calibration, progress)
    alone, conclusion = conclusion, with_arms(conclusion, case.arms, calibration, case.config.cable.length)

    progress("fitting without each episode in turn")
    gap, reference, after = _measured(case, found.evidence, conclusion)
    if not case.arms.deviates:
        conclusion = _worth_naming(conclusion, gap.shrinkage)
    following, none_kept = None, ()
    if conclusion.verdict != "none":
        progress("choosing the next motion" if bounds is None else "designing the next motion")
        judge = Judge.of(case.simulator.playback, found, bounds or Bounds(), objective)
        following, none_kept = _following(judge, None if bounds is None else DesignConfig())
    repaired, rounds = case.recording.as_log(case.log.meta), rounds_of(case.log, found)
    caveats = [*contradictions(rounds), *silent_motions(found.evidence, conclusion, calibration)]
    caveats += [
        *rarely_left(conclusion),
        *caveats_of(case, calibration, length, stated, commissioned=bool(commissioning)),
        *none_kept,
    ]
    fields = Examined(found, conclusion, reference, after, gap).fields()
    if case.arms.strays(negligible(calibration, case.config.cable.length)) and alone.verdict in _ARMS_TOO:
        # what is left of the gap is theirs: not a share that right explanations leave, nor for an unknown cause to take
        fields |= {"sentence": _ARMS_TOO[alone.verdict].format(sentence(alone, None)), "leftover_p": None}
    if rounds is not None and rounds.contradictory:
        fields["sentence"] += (
            f" But the recordings contradict one another: {rounds.odd_one.name} needs other parameters."
        )
    diagnosis = CableDiagnosis(
        **fields,
        where=localise(repaired, case.to_log(reference), case.noise.std),
        next_motion=following,
        caveats=tuple(caveats),
        log=repaired,
        nominal=case.to_log(reference),
        explained=None if conclusion.verdict == "none" else case.to_log(after),
        noise_mm=1e3 * case.noise.std,
        noise_correlation=case.noise.correlation,
        rounds=rounds,
        seconds=time.perf_counter() - begin,
        settings={**settings_of(case.simulator, calibration), "links": {"fit": FIT_LINKS, "nominal": FINE_LINKS}},
    )
    for reading, probability in taken:
        diagnosis = reading.noted_in(diagnosis, probability)
    return diagnosis


def _constants(case: Case, given: Calibration | None, commissioning: Sequence[GapLog]) -> tuple[Calibration, float]:
    """The constants of the judgement, and the error by wrongly stated numbers in them [m]; 0 with constants given."""
    calibration, stated = given or calibrated(case.config.cable.length), 0.0
    if commissioning:
        # of the log's set-up, and none the log itself
        names = ["the log", *(f"commissioning log {i + 1}" for i in range(len(commissioning)))]
        joined([case.log, *commissioning], names)
        calibration = dataclasses.replace(calibration, baseline=baseline_error(commissioning))
    elif given is None:
        stated = case.stated_error()
        assumed = float(np.linalg.norm([calibration.baseline, stated, case.pose_error()]))
        calibration = dataclasses.replace(calibration, baseline=assumed)
    return calibration, stated


def _read(
    case: Case, calibration: Calibration, progress: Callable[[str], None]
) -> tuple[Case, Search, Conclusion, Length | None, list[tuple[Reading, float]]]:
    """Explains a log, and again by another reading as long as one is more probable than all else together.

    Returns:
        The case of the log as it is most probably to be read, what explains it, the length that the keypoints suggest
        besides the stated one, and the readings that are not literal with their probabilities.
    """
    taken: list[tuple[Reading, float]] = []
    while True:
        length = None if any(isinstance(one, Length) for one, _ in taken) else other_length(case)
        readings = [one for one in (length, held(case, calibration)) if one is not None]
        case = with_readings(case, readings)
        found, conclusion = _explained(case, calibration, progress)
        likely = [(one, one.probability(conclusion.under_laws)) for one in readings]
        reading, probability = max(likely, key=lambda one: one[1], default=(None, 0.0))
        if reading is None or reading.case is None or probability <= 0.5:
            return case, found, conclusion, length, taken
        progress(f"diagnosing again, assuming that {reading.assumes}")
        taken.append((reading, probability))
        case = reading.case


def _explained(case: Case, calibration: Calibration, progress: Callable[[str], None]) -> tuple[Search, Conclusion]:
    """Explains a case, and again where small errors grow more under the best explanation than was assumed.

    A soft cable may snap over in a motion in which the stated one does not. Explanations would then be judged by how
    they err there.
    """
    growth = case.growth(explanation())
    while True:
        found, conclusion = explain(case.evidence(calibration, growth), calibration, progress=progress)
        under = np.maximum(growth, case.growth(conclusion.best.explanation))
        if (under <= _MORE_GROWTH * growth).all():
            return found, conclusion
        progress("diagnosing again, since small errors grow under the best explanation")
        growth = under


def _following(judge: Judge, design: DesignConfig | None) -> tuple[NextMotion | None, tuple[str, ...]]:
    """The next motion, or None and why there is none."""
    try:
        return next_motion(judge, design), ()
    except BoundsError as error:
        why = (
            str(error)
            if design is not None
            else "In every motion that was tried, the cable would snap over under one of them."
        )
        return None, (f"No next motion is recommended for the explanations found. {why}",)


def baseline_error(logs: Sequence[GapLog]) -> float:
    """Root mean square error per coordinate above the noise [m] on logs without any effect."""
    every = [Case.of(log).evidence(Calibration()) for log in logs]
    squares = [excess(evaluate(one, [explanation()])[0], one) ** 2 for one in every]
    return max(float(np.sqrt(np.mean(squares))), SMALLEST)


def _measured(case: Case, evidence: Evidence, conclusion: Conclusion) -> tuple[Gap, np.ndarray, np.ndarray]:
    """The gap, and keypoints [m] of the simulator as believed and of the best explanation, each episode held out."""
    recording, best = case.recording, conclusion.best.explanation
    after, held_out = held_out_predictions(evidence, conclusion.best)
    reference = case.nominal
    if case.arms.deviates:
        # the simulator as believed follows the commands; with the arms' effects in it, what these predict
        reference, every = case.commanded_nominal, evidence.episodes
        after = after + (case.predicted.predict([best], every) - case.simulator.predict([best], every))[0]
    ahead_mm, learnable = ahead_of_observations(recording, reference, after, case.noise.std)
    gap = measure_gap(
        evidence,
        reference,
        after,
        interval=recording.interval,
        length=recording.length,
        held_out=held_out,
        resolvable=conclusion.verdict != "none",
        learnable=learnable,
        ahead_mm=ahead_mm,
    )
    return gap, reference, after


def _worth_naming(conclusion: Conclusion, shrinkage: float | None) -> Conclusion:
    """The conclusion, once its effects were tried on episodes left out of the fit.

    An effect that is named alongside an unknown cause and does not shrink the gap on held-out episodes is dropped, also
    under the other laws. `shrinkage` is that on held-out episodes; None where nothing could be held out.
    """
    if conclusion.verdict != "named+unknown" or shrinkage is None or shrinkage > 0:
        return conclusion
    nothing: dict[str, Any] = {"verdict": "unknown", "effects": (), "equivalent": ()}
    under = tuple(
        dataclasses.replace(law, **nothing) if law.verdict == "named+unknown" else law for law in conclusion.under_laws
    )
    return dataclasses.replace(conclusion, **nothing, posterior=(), nothing=0.0, under_laws=under)
