"""Shrinkage of the gap on held-out episodes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from cablejax.diagnose.belief import level
from cablejax.diagnose.diagnosis import Gap
from cablejax.diagnose.evidence import Evidence, episodes_by_motion
from cablejax.diagnose.fit import Fit, evaluate, improve
from cablejax.diagnose.protocol import Plan
from cablejax.diagnose.refits import FOLDS, dealt, independent
from cablejax.diagnose.search import without_one

_HORIZONS = (1.0, 2.0, 5.0, 10.0)
_FOLD_STEPS = 2
# Nats that an effect must be worth on the other episodes to be used on one that no fit has seen.
_WORTH = 2.0
_DRAWS = 1000


def held_out_predictions(evidence: Evidence, best: Fit) -> tuple[Float[np.ndarray, "E T *O"], tuple[int, ...]]:
    """Predictions of every episode from a fit that has not seen it, and which episodes could be held out.

    Episodes that repeat one another are held out together. An effect that the other episodes do not show is left out:
    nothing would be known of it before this episode.
    """
    seen = tuple(np.flatnonzero(evidence.count).tolist())
    if best.refits is not None:
        result = np.empty_like(evidence.nominal)
        for one, rows in zip(best.refits.explanations, best.refits.left_out, strict=True):
            result[rows] = evidence.restricted(rows).predict([one])[0]
        return result, seen
    part_of = dealt(evidence.motion, FOLDS)
    if not best.explanation.terms or not part_of.any():
        return evidence.predict([best.explanation])[0], seen if part_of.any() else ()
    # the sums of a fit are those of its episodes: what is left out needs no simulation of its own
    simpler, chosen = evaluate(evidence, without_one(best.explanation)), []
    for part in range(part_of.max() + 1):
        rows = np.flatnonzero(part_of != part)
        rest, whole = evidence.restricted(rows), best.restricted(rows)
        (fit,) = improve(rest, [whole], _FOLD_STEPS, tolerance=Plan.tolerance)
        least = min((other.restricted(rows) for other in simpler), key=lambda other: other.cost(rest))
        chosen.append(least if least.cost(rest) < whole.cost(rest) + _WORTH else fit)
    every = evidence.predict([fit.explanation for fit in chosen])
    result = np.empty_like(evidence.nominal)
    for part, predicted in enumerate(every):
        result[part_of == part] = predicted[part_of == part]
    return result, seen


def measure_gap(
    evidence: Evidence,
    before: Float[np.ndarray, "E T *O"],
    after: Float[np.ndarray, "E T *O"],
    *,
    interval: Float[np.ndarray, "E"],
    length: Int[np.ndarray, "E"],
    held_out: tuple[int, ...],
    resolvable: bool,
    learnable: float | None = None,
    ahead_mm: dict[str, float] | None = None,
) -> Gap:
    """Errors of two simulations of a recording, above its noise.

    Args:
        evidence: the recording.
        before: the nominal simulator's predictions.
        after: with the named effects, every episode from a fit that has not seen it.
        interval: between samples [s].
        length: samples of each episode.
        held_out: episodes for which that is so.
        resolvable: whether there is a gap at all; without one, or with nothing held out, there is no shrinkage.
        learnable: share of what is left that a correction without a cause takes away, if that was computed.
        ahead_mm: see `Gap`, if that was computed.
    """
    observed, floor = evidence.observed, level(evidence)
    inner = tuple(range(1, observed.ndim))
    # a simulation that breaks down explains nothing from there on
    before = np.where(np.isfinite(before), before, np.nan)
    after = np.where(np.isfinite(before) & np.isfinite(after), after, before)

    def squares(simulated, until=np.inf):
        early = np.arange(observed.shape[1])[None] <= until / interval[:, None] + 0.5
        difference = np.where(early.reshape(*early.shape, *[1] * (observed.ndim - 2)), simulated - observed, np.nan)
        return np.nansum(difference**2, axis=inner), np.isfinite(difference).sum(axis=inner)

    def rmse(simulated, until=np.inf):
        total, count = squares(simulated, until)
        return float(np.sqrt(total.sum() / count.sum())) if count.any() else np.nan

    (b, count), (a, _) = squares(before), squares(after)
    noise = floor**2 * count
    told = np.flatnonzero(count)
    ratio, interval90 = None, None
    if resolvable:
        ratio, interval90 = shrinkage((b - noise)[told], (a - noise)[told], evidence.motion[told])
    if ratio is not None and not np.isfinite(ratio):  # what only the encoders show
        ratio, interval90 = None, None
    whole = float(f"{(interval * (length - 1)).max():.6g}")
    until = (*(h for h in _HORIZONS if h < whole), whole)
    sizes = {h: (1e3 * rmse(before, h), 1e3 * rmse(after, h)) for h in until}
    return Gap(
        horizon_s=whole,
        before_rmse_mm=1e3 * rmse(before),
        after_rmse_mm=1e3 * rmse(after),
        noise_floor_mm=1e3 * floor,
        shrinkage=ratio if held_out else None,
        shrinkage_ci90=interval90 if held_out else None,
        ahead_mm=ahead_mm,
        # a camera may begin later
        horizons_mm={h: both for h, both in sizes.items() if np.isfinite(both).all()},
        held_out_episodes=held_out,
        split=_split(b, a, noise, resolvable, learnable),
        unit=evidence.simulator.unit,
    )


def shrinkage(
    before: Float[np.ndarray, "E"], after: Float[np.ndarray, "E"], motion: Int[np.ndarray, "E"]
) -> tuple[float, tuple[float, float] | None]:
    """Of the squared errors above the noise of each episode, with a 90 % interval by resampling motions.

    Of one motion the episodes are resampled. NaN where the errors are no larger than the noise before.
    """

    def of(chosen) -> float:
        denominator = before[chosen].sum()
        return 1 - max(after[chosen].sum(), 0.0) / denominator if denominator > 0 else np.nan

    motions = episodes_by_motion(independent(motion))
    whole = float(of(np.arange(len(before))))
    if len(motions) == 1 or not np.isfinite(whole):
        return whole, None
    rng = np.random.default_rng(0)
    draws = [
        of(np.concatenate([motions[i] for i in rng.integers(0, len(motions), len(motions))])) for _ in range(_DRAWS)
    ]
    low, high = np.nanquantile(draws, (0.05, 0.95))
    return whole, (float(low), float(high))


def _split(before, after, noise, resolvable: bool, learnable: float | None) -> dict[str, float | None]:
    """Shares of the squared error before, see `Gap.split`."""
    total = before.sum()
    if not total > 0:  # a simulation that is exact to the last digit
        return {"noise": 1.0, "named": 0.0, "learnable": None if learnable is None else 0.0, "unexplained": 0.0}
    share = float(min(noise.sum() / total, 1.0))
    named = float(max((before - np.maximum(after, noise)).sum(), 0.0) / total) if resolvable else 0.0
    left = max(1.0 - share - named, 0.0)
    learned = None if learnable is None else learnable * left
    return {"noise": share, "named": named, "learnable": learned, "unexplained": left - (learned or 0.0)}
