"""The diagnosis of a cable in space: where the simulator is wrong on recorded motion, and which effects cause it."""

from __future__ import annotations

import dataclasses
import pathlib
import time
from collections.abc import Callable, Sequence

import jax
import numpy as np
from jaxtyping import Float

from cablejax.diagnose.belief import Calibration
from cablejax.diagnose.diagnosis import CableDiagnosis, Gap, ParameterEstimate, Ranked, Verdict
from cablejax.diagnose.judgement import judged, verdict_sentence
from cablejax.diagnose.log_faults import as_measured
from cablejax.diagnose.protocol import explanation
from cablejax.gaplog_join import COMMANDS_DERIVED
from cablejax.provenance import package_versions
from cablejax.simulate.rod import Rod, RodResult
from cablejax.spatial.accidents import accident_sentences, kept, moderated, off
from cablejax.spatial.cable import SpatialCable, errors
from cablejax.spatial.caveats import caveats
from cablejax.spatial.clock import on_one_clock, with_poses_in_time
from cablejax.spatial.gap import (
    constant_offset,
    gap_of,
    in_log,
    own_error,
    smallest_gap,
    squares,
    where_of,
    with_gap,
)
from cablejax.spatial.geometry import local_changes
from cablejax.spatial.identify import EDGES, Identified, identify, layout_of
from cablejax.spatial.named import named_effects, quantities_of, with_both_drags
from cablejax.spatial.windows import Windows, windows_of
from cablejax.types import GapLog

_CALIBRATION = Calibration()
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

    Episodes whose `split` is "eval" are left untouched. Everything is reported per mass, since the motion of a hanging
    cable does not depend on its weight.

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
    effects, edges = named_effects(found, density), max(found.cable.edges)
    named = [effect.name for effect in effects]
    before, (after, results) = found.cable.motion(explanation()), found.unseen(with_both_drags(named))
    lost, error, use = _simulated(after, windows)
    kept_windows = found.cable.chosen(use)
    compared, smallest, own = with_gap(kept_windows, before[use], noise)
    cut = _seconds(compared.windows) if compared.windows.valid.sum() < kept_windows.windows.valid.sum() else None
    gap = gap_of(before[use], after[use], compared, noise, smallest)
    equivalent = _equivalent(found, named)
    explaining = found.everything.with_only(with_both_drags(named))
    own_after = own_error(compared, explaining, compared.motion(explaining), noise)
    verdict = _verdict(gap, 1e3 * smallest_gap(noise, windows, own_after), named, equivalent)
    share = gap.shrinkage
    if verdict == "unknown":  # each effect may be absent: by all of them together
        share = gap_of(before[use], found.unseen()[0][use], compared, noise, smallest).shrinkage
    if verdict in ("none", "unknown"):
        effects = ()
    offset = ParameterEstimate(constant_offset(after[use], kept_windows.windows), None, "m")
    nominal, explained = (in_log(log, windows, part) for part in (before, after))
    return SpatialDiagnosis(
        verdict=verdict,
        sentence=" ".join([verdict_sentence(verdict, effects, equivalent, share or 0.0), *changes[:1], *shifted]),
        effects=effects,
        equivalent=equivalent,
        quantities=quantities_of(found, None if guessed else density) | {"constant_offset_m": offset},
        ranking=_ranking(found),
        gap=gap,
        where=where_of(log, kept_windows.windows, nominal, before[use], noise, smallest, changes),
        caveats=(
            *repairs,
            *resampled,
            *shifted,
            *accident_sentences(lost, error, windows, results == RodResult.COARSE),
            *caveats(windows, left_out, found, cut, own, own_after),
        ),
        log=log,
        nominal=nominal,
        explained=explained,
        noise_mm=np.full(windows.n_keypoints, 1e3 * noise),
        noise_correlation=np.zeros(0),
        seconds=time.perf_counter() - begun,
        settings={"edges": edges, "window_s": longest, **package_versions(("jax",)), "devices": jax.default_backend()},
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


def _simulated(after: Float[np.ndarray, "W T F 3"], windows: Windows) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which windows the simulation lost, the error of each [m], and the indices of those that count."""
    lost = ~np.array([np.isfinite(part[valid]).all() for part, valid in zip(after, windows.valid, strict=True)])
    error = errors(after, windows)
    return lost, error, np.flatnonzero(kept(lost | off(error) | windows.torn))


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


def _verdict(gap: Gap, smallest_mm: float, named: Sequence[str], equivalent: tuple[tuple[str, ...], ...]) -> Verdict:
    allowed = max(_CALIBRATION.adequate * gap.before_rmse_mm, smallest_mm)
    return judged(
        resolvable=gap.shrinkage is not None,
        telling=bool(named) and gap.shrinkage_ci90 is not None and gap.shrinkage_ci90[0] > 0,
        complete=gap.after_rmse_mm <= allowed,
        alike=bool(equivalent),
    )


def _equivalent(found: Identified, named: Sequence[str]) -> tuple[tuple[str, ...], ...]:
    """Rest curvature and a stiffness profile that take each other's place equally well."""
    swap = next((step for step in found.steps if step.instead_of), None)
    if swap is None or swap.accepted or swap.chance < 0.05 or swap.instead_of not in named:
        return ()
    return ((swap.instead_of, swap.effect),)


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
