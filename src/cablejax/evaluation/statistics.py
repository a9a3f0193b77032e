"""Statistics of a few trials: what was measured, how sure it is, and what failed.

A failure is a value that is not finite: an error that is NaN because the cable was lost, a settling time that is
infinite because the run never settled. Failures stay in every count. A mean and a standard deviation are those of the
finite values, with the number of failures beside them; median and worst rank a failure behind every finite value.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Literal, TypeVar

import numpy as np
from jaxtyping import Float
from scipy import stats

Statistic = Callable[..., np.ndarray]
"""As `np.mean`: takes an array and `axis`."""

RESAMPLES = 10_000
"""Bootstrap samples of an interval."""

Values = Sequence[float] | Float[np.ndarray, " n"]
"""One number per trial."""

Key = TypeVar("Key", bound=Hashable)


@dataclasses.dataclass(frozen=True)
class Summary:
    """One cell of a table.

    Attributes:
        count: trials n.
        failures: of these, not finite.
        mean: of the finite ones; NaN if there are none.
        std: their standard deviation with n - 1 in the denominator; 0 for a single one, NaN for none.
        median: of all trials, failures ranked last: infinite if half of them failed.
        worst: the largest of all trials; infinite if one failed.
    """

    count: int
    failures: int
    mean: float
    std: float
    median: float
    worst: float


@dataclasses.dataclass(frozen=True)
class Interval:
    """A confidence interval."""

    low: float
    high: float


@dataclasses.dataclass(frozen=True)
class PairedDifference:
    """What a method changes against another in the same trials; negative = it is lower.

    Attributes:
        pairs: trials that both methods have.
        unpaired: trials that only one of them has; they count for nothing.
        failures: pairs in which one or both failed. They are in no mean, but see `better` and `worse`.
        mean: of the differences of the other pairs.
        interval: bootstrap interval of that mean.
        better: pairs in which the method is lower, or finite where the other failed.
        worse: pairs in which it is the other way round.
    """

    pairs: int
    unpaired: int
    failures: int
    mean: float
    interval: Interval
    better: int
    worse: int


def summarise(values: Values) -> Summary:
    """Mean, spread and failures of one cell; see the module's rule for failures.

    Raises:
        ValueError: there is no value, or they are not in one row.
    """
    x = _row(values)
    finite = x[np.isfinite(x)]
    ranked = np.sort(np.where(np.isfinite(x), x, np.inf))
    low, high = ranked[(len(x) - 1) // 2], ranked[len(x) // 2]
    return Summary(
        count=len(x),
        failures=len(x) - len(finite),
        mean=float(finite.mean()) if len(finite) else np.nan,
        std=float(finite.std(ddof=1)) if len(finite) > 1 else (0.0 if len(finite) else np.nan),
        median=float(0.5 * (low + high)),
        worst=float(ranked[-1]),
    )


def bootstrap_interval(
    values: Values,
    statistic: Statistic = np.mean,
    *,
    confidence: float = 0.95,
    method: Literal["bca", "percentile"] = "bca",
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Interval:
    """Confidence interval of a statistic of independent values, by drawing from them again and again.

    "bca" corrects the percentiles for bias and skewness (Efron, J. Am. Stat. Assoc. 82, 1987): `z0` is the normal
    quantile of the share of resamples below the estimate, `a` the skewness of the jackknife's values over six.

    Args:
        values: finite, shape [n].
        statistic: of the values along an axis.
        confidence: coverage of the interval.
        method: see above.
        resamples: number of bootstrap samples.
        seed: of the resampling.

    Returns:
        The interval; NaN for fewer than two values, which say nothing about their spread.

    Raises:
        ValueError: a value is not finite, the confidence is not between 0 and 1, or no resamples are asked for.
    """
    x = _row(values)
    if not np.isfinite(x).all():
        raise ValueError(f"{np.sum(~np.isfinite(x))} of {len(x)} values are not finite: count failures beside them.")
    if not 0 < confidence < 1 or resamples < 1:
        raise ValueError(f"confidence is {confidence} with {resamples} resamples, expected within (0, 1) and >= 1.")
    if len(x) < 2:
        return Interval(np.nan, np.nan)
    rng = np.random.default_rng(seed)
    drawn = statistic(x[rng.integers(len(x), size=(resamples, len(x)))], axis=1)
    tails = np.array([0.5 - confidence / 2, 0.5 + confidence / 2])
    if method == "bca":
        tails = _corrected_tails(x, statistic, drawn, tails)
    low, high = np.quantile(drawn, tails)
    return Interval(float(low), float(high))


def paired_difference(
    method: Mapping[Key, float],
    reference: Mapping[Key, float],
    *,
    cluster: Callable[[Key], Hashable] = lambda key: key,
    confidence: float = 0.95,
    seed: int = 0,
) -> PairedDifference:
    """How much lower or higher a method is than a reference in the same trials.

    Args:
        method: its values by trial.
        reference: the other's.
        cluster: what trials share that are not independent, the seed for instance. The interval resamples clusters, by
            the mean difference in each; by default every trial is its own.
        confidence: coverage of the interval.
        seed: of the resampling.
    """
    shared = [key for key in method if key in reference]
    ours = np.array([method[key] for key in shared], float)
    theirs = np.array([reference[key] for key in shared], float)
    both = np.isfinite(ours) & np.isfinite(theirs)
    clusters: dict[Hashable, list[float]] = {}
    for key, difference in zip(np.arange(len(shared))[both], (ours - theirs)[both], strict=True):
        clusters.setdefault(cluster(shared[key]), []).append(float(difference))
    means = [float(np.mean(differences)) for differences in clusters.values()]
    rank_ours, rank_theirs = (np.where(np.isfinite(x), x, np.inf) for x in (ours, theirs))
    return PairedDifference(
        pairs=len(shared),
        unpaired=len(method) + len(reference) - 2 * len(shared),
        failures=int(np.sum(~both)),
        mean=float(np.mean(means)) if means else np.nan,
        interval=bootstrap_interval(means, confidence=confidence, seed=seed) if means else Interval(np.nan, np.nan),
        better=int(np.sum(rank_ours < rank_theirs)),
        worse=int(np.sum(rank_ours > rank_theirs)),
    )


def clopper_pearson(successes: int, trials: int, confidence: float = 0.95) -> Interval:
    """Exact interval of a success probability: Clopper and Pearson, Biometrika 26, 1934.

    Raises:
        ValueError: more successes than trials, negative counts, no trial, or a confidence outside (0, 1).
    """
    if not 0 <= successes <= trials or trials < 1 or not 0 < confidence < 1:
        raise ValueError(
            f"{successes} successes in {trials} trials at confidence {confidence}: expected 0 <= successes <= trials, "
            "at least one trial and a confidence within (0, 1)."
        )
    tail = 0.5 - confidence / 2
    low = stats.beta.ppf(tail, successes, trials - successes + 1) if successes else 0.0
    high = stats.beta.isf(tail, successes + 1, trials - successes) if successes < trials else 1.0
    return Interval(float(low), float(high))


def _corrected_tails(x: np.ndarray, statistic: Statistic, drawn: np.ndarray, tails: np.ndarray) -> np.ndarray:
    """The percentiles at which BCa reads the bootstrap's distribution."""
    estimate = statistic(x, axis=0)
    # Ties count half, and rounding breaks none: with few or equal values the bootstrap's distribution is discrete.
    tied = np.abs(drawn - estimate) <= 1e-12 * np.abs(x).max()
    below = np.mean((drawn < estimate) & ~tied) + 0.5 * np.mean(tied)
    z0 = stats.norm.ppf(np.clip(below, 0.5 / len(drawn), 1 - 0.5 / len(drawn)))
    left_out = np.stack([np.delete(x, i) for i in range(len(x))])
    deviation = (jack := statistic(left_out, axis=1)).mean() - jack
    spread = (deviation**2).sum()
    a = (deviation**3).sum() / (6 * spread**1.5) if spread > 0 else 0.0
    z = z0 + stats.norm.ppf(tails)
    return stats.norm.cdf(z0 + z / (1 - a * z))


def _row(values: Values) -> np.ndarray:
    x = np.asarray(values, float)
    if x.ndim != 1 or len(x) == 0:
        raise ValueError(f"Got values of shape {x.shape}, expected at least one in one row.")
    return x
