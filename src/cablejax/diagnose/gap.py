"""How far the gap shrinks, on episodes that no fit has seen."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from cablejax.diagnose.case import Case
from cablejax.diagnose.diagnosis import Gap
from cablejax.diagnose.fit import Evidence, Fit, evaluate, improve
from cablejax.diagnose.reference import predicted_ahead
from cablejax.diagnose.repeats import episodes_by_motion
from cablejax.diagnose.search import without_one

_HORIZONS = (1.0, 2.0, 5.0, 10.0)
_FOLD_STEPS = 2
_FOLDS = 6
# Nats that an effect must be worth on the other episodes to be used on one that no fit has seen.
_WORTH = 2.0


def held_out_keypoints(
    case: Case, evidence: Evidence, best: Fit
) -> tuple[Float[np.ndarray, "E T N 2"], tuple[int, ...]]:
    """Keypoints of every episode from a fit that has not seen it, and which episodes could be held out.

    Episodes that repeat one another are held out together. An effect that the other episodes do not show is left out:
    nothing would be known of it before this episode.
    """
    n_episodes, motions = len(evidence.motion), episodes_by_motion(evidence.motion)
    if not best.candidate.terms or len(motions) == 1:
        return case.simulate(best.candidate), tuple(range(n_episodes)) if len(motions) > 1 else ()
    folds = np.array_split(np.arange(len(motions)), min(len(motions), _FOLDS))
    groups = [sorted(int(e) for i in fold for e in motions[i]) for fold in folds]
    result = np.empty_like(case.nominal)
    for group in groups:
        rest = evidence.restricted([e for e in range(n_episodes) if e not in group])
        fits = evaluate(rest, [best.candidate, *without_one(best.candidate)])
        fit = improve(rest, fits[:1], max_iterations=_FOLD_STEPS)[0]
        simpler = min(fits[1:], key=lambda other: other.cost(rest))
        if simpler.cost(rest) < fits[0].cost(rest) + _WORTH:
            fit = simpler
        result[group] = case.simulate(fit.candidate, group)
    return result, tuple(range(n_episodes))


def measure_gap(
    case: Case,
    before: Float[np.ndarray, "E T N 2"],
    after: Float[np.ndarray, "E T N 2"],
    *,
    held_out: tuple[int, ...],
    resolvable: bool,
) -> Gap:
    """Errors of two simulations of a log, above its noise.

    Args:
        case: the log.
        before: the nominal simulator's keypoints [m].
        after: with the named effects, every episode from a fit that has not seen it.
        held_out: episodes for which that is so.
        resolvable: whether there is a gap at all; without one, or with nothing held out, no shrinkage is told.
    """
    observed, interval = case.recording.keypoints, case.recording.interval
    floor = float(np.sqrt(np.mean(case.noise.std**2)))

    def squares(simulated, until=np.inf):
        early = (np.arange(observed.shape[1])[None] * interval[:, None]) <= until
        difference = np.where(early[..., None, None], simulated - observed, np.nan)
        return np.nansum(difference**2, axis=(1, 2, 3)), np.isfinite(difference).sum(axis=(1, 2, 3))

    def rmse(simulated, until=np.inf):
        total, count = squares(simulated, until)
        return float(np.sqrt(total.sum() / count.sum()))

    (b, count), (a, _) = squares(before), squares(after)
    noise = floor**2 * count

    def shrinkage(chosen):
        denominator = (b - noise)[chosen].sum()
        return 1 - max((a - noise)[chosen].sum(), 0.0) / denominator if denominator > 0 else np.nan

    interval90, motions = None, episodes_by_motion(case.motion)
    if resolvable and len(motions) > 1:
        rng = np.random.default_rng(0)
        draws = [
            shrinkage(np.concatenate([motions[i] for i in rng.integers(0, len(motions), len(motions))]))
            for _ in range(1000)
        ]
        low, high = np.nanquantile(draws, (0.05, 0.95))
        interval90 = float(low), float(high)
    total = b.sum()
    share = {
        "noise": float(min(noise.sum() / total, 1.0)),
        "named": float(max((b - np.maximum(a, noise)).sum(), 0.0) / total) if resolvable else 0.0,
    }
    left = max(1.0 - share["noise"] - share["named"], 0.0)
    ahead, learnable = _ahead(case, before, after)
    share["learnable"] = learnable * left
    share["unexplained"] = left - share["learnable"]
    whole = float(np.round((interval * (case.recording.length - 1)).max(), 3))
    return Gap(
        horizon_s=whole,
        before_rmse_mm=1e3 * rmse(before),
        after_rmse_mm=1e3 * rmse(after),
        noise_floor_mm=1e3 * floor,
        shrinkage=float(shrinkage(np.arange(len(b)))) if resolvable and held_out else None,
        shrinkage_ci90=interval90,
        ahead_mm=ahead,
        horizons_mm={h: (1e3 * rmse(before, h), 1e3 * rmse(after, h)) for h in (*_HORIZONS, whole)},
        held_out_episodes=held_out,
        split=share,
    )


def _ahead(case: Case, before, after) -> tuple[dict[str, float] | None, float]:
    """Errors five seconds ahead [mm], and the share of the squared leftover that the online residual takes away."""
    recording = case.recording
    arguments = recording.gripper_pose, recording.interval, recording.length
    nominal = predicted_ahead(recording.keypoints, before, *arguments)
    named = predicted_ahead(recording.keypoints, after, *arguments)
    if nominal is None or named is None:
        return None, 0.0
    # both ends of the prediction are observed with noise
    noise = 2 * float(np.mean(case.noise.std**2))
    left = max(named.alone**2 - noise, 0.0)
    learnable = (named.alone**2 - max(named.corrected**2, noise)) / left if left > 0.1 * noise else 0.0
    errors = {"nominal": 1e3 * nominal.alone, "ridge": 1e3 * nominal.corrected, "named": 1e3 * named.alone}
    return errors, float(np.clip(learnable, 0.0, 1.0))
