"""The diagnosis of a cable in space: where the simulator is wrong on recorded motion, and which effects cause it."""

from __future__ import annotations

import dataclasses
import pathlib
import time
from collections.abc import Callable, Sequence

import jax
import numpy as np

from cablejax.diagnose.diagnosis import CableDiagnosis, ParameterEstimate, Ranked
from cablejax.diagnose.judgement import verdict_sentence
from cablejax.diagnose.log_faults import as_measured
from cablejax.diagnose.protocol import explanation
from cablejax.gaplog_join import COMMANDS_DERIVED
from cablejax.provenance import package_versions
from cablejax.simulate.rod import Rod, RodResult
from cablejax.spatial.accidents import accident_sentences, moderated
from cablejax.spatial.cable import SpatialCable
from cablejax.spatial.caveats import caveats, hidden_sentence
from cablejax.spatial.clock import on_one_clock, with_poses_in_time
from cablejax.spatial.gap import constant_offset, in_log, squares, where_of
from cablejax.spatial.geometry import local_changes
from cablejax.spatial.identify import EDGES, Identified, identify, layout_of
from cablejax.spatial.judge import judge
from cablejax.spatial.named import quantities_of
from cablejax.spatial.windows import Windows, windows_of
from cablejax.types import GapLog

# Windows by which it is found out whether the roll of a log was observed, and by how much the error has to be smaller.
_COMPARED, _CLEARLY = 12, 0.9


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpatialDiagnosis(CableDiagnosis):
    """A diagnosis in space. Arrays of keypoints have three coordinates; held keypoints are as observed.

    Attributes:
        identified: the simulator with the effects that were found.
    """

    identified: Identified


def diagnose_space(
    log: GapLog,
    *,
    only: Sequence[str] | None = None,
    state: pathlib.Path | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> SpatialDiagnosis:
    """Diagnoses a log of a cable that hangs between two grippers and moves.

    Episodes whose `split` is "eval" are neither fitted nor scored; how the cable is held, the clock and the noise are
    of all. Everything is reported per mass, since the motion of a hanging cable does not depend on its weight.

    Args:
        log: in space.
        only: names of the effects to look for; by default all.
        state: file that keeps what is done; an interrupted diagnosis goes on from there.
        progress: called with a line of text.

    Raises:
        ValueError: a log that cannot be diagnosed, with the reason.
    """
    begun = time.perf_counter()
    log, repairs = as_measured(log)
    log, resampled = on_one_clock(log)
    log, shifted = with_poses_in_time(log)
    log = with_roll(log)
    windows, left_out = _to_fit(log)
    longest = _seconds(windows)
    cable = log.meta["cable"]
    density, guessed = cable["linear_density_kg_per_m"], "linear_density_kg_per_m" in log.meta.get("guessed", ())
    stiffness = cable["bending_stiffness_n_m2"] / density
    progress(f"{len(windows)} windows of {longest:g} s, {len(np.unique(windows.group))} recordings")
    for change in (changes := local_changes(log, windows.held)):
        progress(change)
    noise = windows.noise
    found = identify(windows, stiffness, cable["bending_damping_s"], only=only, state=state, progress=progress)
    says = judge(found, density)
    counted, after = windows.chosen(says.use), says.after[says.use]
    cut = _seconds(says.compared.windows) if says.compared.windows.valid.sum() < counted.valid.sum() else None
    sentence = verdict_sentence(says.verdict, says.effects, says.equivalent, says.gap.shrinkage or 0.0)
    if says.hidden is not None:
        sentence = hidden_sentence(says.hidden)
    offset = ParameterEstimate(constant_offset(after, counted), None, "m")
    where = where_of(log, counted, says.before[says.use], noise, says.smallest, changes)
    nominal, explained = (in_log(log, windows, part) for part in (says.before, says.after))
    return SpatialDiagnosis(
        verdict=says.verdict,
        undecided=says.hidden is not None,
        sentence=" ".join([sentence, *changes[:1], *shifted]),
        effects=says.effects,
        equivalent=says.equivalent,
        quantities=quantities_of(found, None if guessed else density) | {"constant_offset_m": offset},
        ranking=_ranking(found),
        gap=says.gap,
        where=where,
        caveats=(
            *repairs,
            *resampled,
            *shifted,
            *accident_sentences(says.lost, says.error, windows, says.results == RodResult.COARSE),
            *caveats(windows, left_out, found, cut, says.own, says.own_after),
        ),
        log=log,
        nominal=nominal,
        explained=None if says.verdict == "none" else explained,
        noise_mm=np.full(windows.n_keypoints, 1e3 * noise),
        noise_correlation=np.zeros(0),
        seconds=time.perf_counter() - begun,
        settings={
            "edges": max(found.cable.edges),
            "window_s": longest,
            **package_versions(("jax",)),
            "devices": jax.default_backend(),
        },
        identified=found,
    )


def _seconds(windows: Windows) -> float:
    """Length of the longest window [s]."""
    return round(float(windows.valid.sum(axis=1).max() * windows.interval), 1)


def _to_fit(log: GapLog) -> tuple[Windows, int]:
    """The windows that may be fitted, and how many may not."""
    windows = windows_of(log)
    fitted = windows.fitted
    if not len(fitted):
        raise ValueError(
            "All windows are in the eval split, which is never fitted: record more, or label other windows for fitting."
        )
    if len(fitted) < 2:
        raise ValueError(
            f"The log has one window to fit, of {windows.valid.sum(axis=1).max() * windows.interval:.3g} s, expected "
            "at least two, so that one can be left out of a fit. Record more."
        )
    return fitted, len(windows) - len(fitted)


def with_roll(log: GapLog) -> GapLog:
    """Adds `roll_observed` to a log that does not state whether its quaternions show how the grippers roll.

    They do if the nominal cable moves more like the recorded one with it. Quaternions that were made of markers have a
    roll too, which nobody observed.
    """
    if "roll_observed" in log.meta or log.meta.get(COMMANDS_DERIVED):
        return log
    cable, sizes = log.meta["cable"], []
    stiffness = cable["bending_stiffness_n_m2"] / cable["linear_density_kg_per_m"]
    told = dataclasses.replace(log, meta={**log.meta, "roll_observed": True})
    for one in (log, told):
        windows = windows_of(one).fitted
        if not len(windows):
            return log
        windows = windows.chosen(windows.whole(_COMPARED))
        layout = layout_of(windows, stiffness, cable["bending_damping_s"])
        motion = SpatialCable(Rod(EDGES, 1, twisting=False), layout, windows).motion(explanation())
        sizes.append(float(np.sqrt(np.nanmean(squares(motion, windows)))))
    return told if sizes[1] < _CLEARLY * sizes[0] else log


def _ranking(found: Identified) -> tuple[Ranked, ...]:
    """Every trial in order, by the share of the nominal error that went when it came in, on unseen recordings."""
    nominal, before, ranked = moderated(found.steps[0].error), moderated(found.steps[0].error), []
    for step in found.steps[1:]:
        error = moderated(step.error)
        gain = float((before**2).mean() - (error**2).mean()) / float((nominal**2).mean())
        outcome = "kept" if step.accepted else "did not help" if step.counts else "not judged"
        # the share of resamples in which the error falls is no probability that the effect is there
        ranked.append(Ranked(step.effect, None, gain, 1e3 * float(error.mean()), outcome))
        before = error if step.accepted else before
    return tuple(ranked)
