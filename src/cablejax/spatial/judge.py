"""What is said of a cable in space: by the estimates of all effects, and the gap on recordings that no fit has seen."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from cablejax.diagnose.belief import Calibration
from cablejax.diagnose.diagnosis import Gap, NamedEffect, Verdict
from cablejax.diagnose.judgement import judged
from cablejax.diagnose.protocol import explanation
from cablejax.spatial.accidents import kept, off
from cablejax.spatial.cable import SpatialCable, errors
from cablejax.spatial.gap import gap_of, own_error, smallest_gap, with_gap
from cablejax.spatial.identify import Identified
from cablejax.spatial.named import named_effects, with_both_drags
from cablejax.spatial.windows import Windows

AVERAGED = 0.5
"""Part of the squared error of a cable that amplifies noise by which its mean motion is nearer: two such motions differ
by twice the scatter of one."""

_CALIBRATION = Calibration()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Judgement:
    """The verdict, and what it rests on.

    Attributes:
        verdict: see `judged`.
        effects: that are named: those that the estimates show, where they lessen the gap; else none.
        equivalent: names that take each other's place equally well.
        gap: before and after these, in the windows that count.
        hidden: where the nominal cable amplifies noise too much to show a gap, although effects of the library lessen
            its error by more than that would: error before and with all of them together, as if it had no error by
            itself. The verdict is "unknown" then; else None.
        before, after: motion of the nominal cable, and of that with the named effects, or of an unknown cause with all
            together [m].
        results: how the latter's rollouts ended.
        lost: windows that were not simulated.
        error: of the explained cable in each window [m].
        use: indices of the windows that count.
        compared: the nominal cable in the beginnings of windows in which the gap is measured.
        smallest: error that counts as a gap [m].
        own, own_after: error of the nominal and of the explained cable by itself, see `gap.own_error` [m].
    """

    verdict: Verdict
    effects: tuple[NamedEffect, ...]
    equivalent: tuple[tuple[str, ...], ...]
    gap: Gap
    hidden: Gap | None
    before: Float[np.ndarray, "W T F 3"]
    after: Float[np.ndarray, "W T F 3"]
    results: Int[np.ndarray, " W"]
    lost: Bool[np.ndarray, " W"]
    error: Float[np.ndarray, " W"]
    use: Int[np.ndarray, " U"]
    compared: SpatialCable
    smallest: float
    own: float
    own_after: float


def judge(found: Identified, density: float) -> Judgement:
    """The verdict on a cable.

    Args:
        found: by `identify`.
        density: see `named_effects`.
    """
    windows = found.cable.windows
    noise, effects = windows.noise, named_effects(found, density)
    named = [effect.name for effect in effects]
    before, (after, results) = found.cable.motion(explanation()), found.unseen(with_both_drags(named))
    measured = _measured(found, before, after)
    gap, use, compared = (measured[name] for name in ("gap", "use", "compared"))
    equivalent = _equivalent(found, named)
    explaining = found.everything.with_only(with_both_drags(named))
    own_after = own_error(compared, explaining, compared.motion(explaining), noise)
    verdict = _verdict(gap, 1e3 * smallest_gap(noise, windows, own_after), named, equivalent)

    hidden = None
    if verdict == "unknown":  # each effect may be absent: by all of them together
        after, results = found.unseen()
        measured = _measured(found, before, after)
    elif verdict == "none" and any(step.accepted for step in found.steps[1:]):
        seen = gap_of(before[use], found.unseen()[0][use], compared, noise, smallest_gap(noise, windows))
        if seen.shrinkage_ci90 is not None and seen.shrinkage_ci90[0] > AVERAGED:
            verdict, hidden = "unknown", seen
    return Judgement(
        verdict=verdict,
        effects=() if verdict in ("none", "unknown") else effects,
        equivalent=equivalent,
        hidden=hidden,
        before=before,
        after=after,
        results=results,
        own_after=own_after,
        **measured,
    )


def _measured(
    found: Identified, before: Float[np.ndarray, "W T F 3"], after: Float[np.ndarray, "W T F 3"]
) -> dict[str, Any]:
    """The fields of a `Judgement` that follow from the two motions."""
    windows = found.cable.windows
    lost, error, use = _simulated(after, windows)
    compared, smallest, own = with_gap(found.cable.chosen(use), before[use], windows.noise)
    gap = gap_of(before[use], after[use], compared, windows.noise, smallest)
    return {
        "lost": lost,
        "error": error,
        "use": use,
        "compared": compared,
        "smallest": smallest,
        "own": own,
        "gap": gap,
    }


def _simulated(after: Float[np.ndarray, "W T F 3"], windows: Windows) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which windows the simulation lost, the error of each [m], and the indices of those that count."""
    lost = ~np.array([np.isfinite(part[valid]).all() for part, valid in zip(after, windows.valid, strict=True)])
    error = errors(after, windows)
    return lost, error, np.flatnonzero(kept(lost | off(error) | windows.torn))


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
