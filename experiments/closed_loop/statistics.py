"""Statistics of a few trials: means, intervals and failures.

A failure is a value that is not finite: an error that is NaN because the cable was lost, a settling time that is
infinite because the run never settled. Failures stay in every count. A mean and a standard deviation are those of the
finite values, with the number of failures; median and worst rank a failure behind every finite value.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import TypeVar

import numpy as np
from jaxtyping import Float
from scipy import stats

RESAMPLES = 10_000
"""Bootstrap samples of an interval."""
FEW = 15
"""Of fewer values than this the bootstrap's intervals are too narrow."""

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
        mean: of the differences of the other pairs, every cluster with its mean.
        interval: of that mean.
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


def mean_interval(values: Values, *, confidence: float = 0.95, seed: int = 0) -> Interval:
    """Confidence interval of the mean of independent values.

    Of few values Student's, right for a normal distribution; else by the BCa bootstrap (Efron, J. Am. Stat. Assoc.
    1987).

    Args:
        values: finite, shape [n].
        confidence: coverage of the interval, within (0, 1).
        seed: of the resampling.

    Returns:
        The interval; NaN for fewer than two values, which say nothing about their spread, and the value itself where
        all are equal.

    Raises:
        ValueError: a value is not finite, or the confidence is not between 0 and 1.
    """
    x = _row(values)
    if not np.isfinite(x).all():
        raise ValueError(f"{np.sum(~np.isfinite(x))} of {len(x)} values are not finite: count failures separately.")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence is {confidence}, expected within (0, 1).")
    if len(x) < 2:
        return Interval(np.nan, np.nan)
    if np.ptp(x) <= 1e-12 * np.abs(x).max():
        return Interval(float(x[0]), float(x[0]))
    if len(x) < FEW:
        half = float(stats.t.ppf(0.5 + confidence / 2, len(x) - 1) * x.std(ddof=1) / np.sqrt(len(x)))
        return Interval(float(x.mean()) - half, float(x.mean()) + half)
    # Some resamples have the estimate as their mean. Such ties count half: no rounding may break them.
    digits = 12 - int(np.ceil(np.log10(np.abs(x).max())))

    def mean(sample: np.ndarray, axis: int) -> np.ndarray:
        return np.round(np.mean(sample, axis=axis), digits)

    found = stats.bootstrap((x,), mean, n_resamples=RESAMPLES, confidence_level=confidence, method="BCa", rng=seed)
    return Interval(*map(float, found.confidence_interval))


def paired_difference(
    method: Mapping[Key, float],
    reference: Mapping[Key, float],
    *,
    cluster: Callable[[Key], Hashable] = lambda key: key,
) -> PairedDifference:
    """How much lower or higher a method is than a reference in the same trials.

    Args:
        method: its values by trial.
        reference: the other's.
        cluster: what trials share that are not independent, the seed for instance. The interval is of the clusters'
            mean differences; by default every trial is its own.
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
        interval=mean_interval(means) if means else Interval(np.nan, np.nan),
        better=int(np.sum(rank_ours < rank_theirs)),
        worse=int(np.sum(rank_ours > rank_theirs)),
    )


def _row(values: Values) -> np.ndarray:
    x = np.asarray(values, float)
    if x.ndim != 1 or len(x) == 0:
        raise ValueError(f"Got values of shape {x.shape}, expected at least one in one row.")
    return x
