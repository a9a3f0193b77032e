"""Draws from the posterior: coordinates of one explanation, and explanations with their values.

The interval of one coordinate ends where the cost, minimised over all others, has risen by `z^2 / 2` (Venzon and
Moolgavkar 1988), with z the quantile of the normal distribution. A threshold, a stretch limit or a place makes profiles
that rise faster on one side than on the other, which a covariance cannot say. The weights of the episodes stay those of
the fit, as in `Fit.precision`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from cablejax.diagnose.belief import Calibration
from cablejax.diagnose.diagnosis import EffectValues
from cablejax.diagnose.evidence import Evidence
from cablejax.diagnose.fit import Fit, evaluate
from cablejax.diagnose.search import Law, Search

QUANTILE = 1.6449
"""Of the normal distribution, at 95 %: the intervals are two-sided 90 %."""
# Of corrections of a profile's ends, and the least and largest factor of each.
_ROUNDS = 2
_MOST, _LEAST = 2.0, 0.5
_DRAWS = 400
# These are not simulated, and Student's tails need more of them.
_JACKKNIFE_DRAWS = 4000
POSTERIOR = 16
"""Draws of the posterior that a verdict holds."""


def draws(evidence: Evidence, fit: Fit, calibration: Calibration) -> Float[np.ndarray, "D P"]:
    """Posterior draws of coordinates, in random order.

    Where parts of the recordings were left out, how far that moves them (jackknife) adds to the posterior's width, and
    the distribution is Student's with a degree of freedom fewer than parts; else they follow profiles of the posterior.
    """
    random, best = np.random.default_rng(0), fit.explanation
    if not len(best.z):
        return np.zeros((_DRAWS, 0))
    covariance, centre = np.linalg.inv(fit.precision(evidence)), np.zeros(len(best.z))
    if fit.refits is None:
        # normal, stretched on each side to the width of the profile
        normal = random.multivariate_normal(centre, covariance, _DRAWS, method="cholesky")
        down, up = (profile_widths(evidence, fit) / (QUANTILE * np.sqrt(np.diagonal(covariance)))[:, None]).T
        drawn = best.z + calibration.widening * normal * np.where(normal < 0, down, up)
    else:
        z = np.stack([one.z for one in fit.refits.explanations])
        freedom = len(z) - 1
        covariance = covariance + freedom * np.cov(z.T, bias=True).reshape(2 * z.shape[1:])
        normal = random.multivariate_normal(centre, covariance, _JACKKNIFE_DRAWS, method="cholesky")
        drawn = best.z + normal * np.sqrt(freedom / random.chisquare(freedom, (_JACKKNIFE_DRAWS, 1)))
    return np.clip(drawn, *best.bounds.T)


def drawn_by(law: Law, best: Fit) -> tuple[Fit, Float[np.ndarray, "D P"]] | None:
    """The fit of the same terms by another law, and draws of its coordinates; None where the law counts for nothing."""
    same = next((fit for fit in law.found.fits if fit.explanation.terms == best.explanation.terms), None)
    if same is None or not same.explanation.terms or law.probability < 1.0 / _DRAWS:
        return None
    return same, draws(law.found.evidence, same, law.found.calibration)


def over_laws(
    own: Float[np.ndarray, "D P"], others: Sequence[tuple[float, Float[np.ndarray, "D P"]]]
) -> Float[np.ndarray, "D P"]:
    """Draws of the same coordinates by every law, each law as often as it is probable.

    Args:
        own: draws by the simulator's own law.
        others: probability of each other law, and draws by it.
    """
    if not others:
        return own
    parts = [drawn[: round(len(own) * probability)] for probability, drawn in others]
    rest = max(len(own) - sum(map(len, parts)), 0)
    # shares that were rounded up may be one more together
    return np.random.default_rng(0).permutation(np.concatenate([own[:rest], *parts]))[: len(own)]


def posterior(found: Search, best: Float[np.ndarray, "D P"]) -> tuple[tuple[EffectValues, ...], ...]:
    """Explanations that the verdict leaves open with their values, each as often as it is probable.

    Args:
        found: by the search.
        best: draws of the best fit's coordinates, in no order.
    """
    fits, chances = found.in_doubt()
    evidence = found.evidence
    taken = np.searchsorted(np.cumsum(chances), (np.arange(POSTERIOR) + 0.5) / POSTERIOR)
    result = []
    for k in np.unique(np.minimum(taken, len(fits) - 1)):
        drawn = best if fits[k] is found.fits[0] else draws(evidence, fits[k], found.calibration)
        for z in drawn[: int(np.sum(taken == k))]:
            terms = fits[k].explanation.by_term(z)
            reports = [(term, evidence.simulator.report(term, term.values(value))) for term, value in terms]
            result.append(
                tuple(
                    EffectValues(term.effect.name, {key: value for key, (value, _) in report.parameters.items()})
                    for term, report in reports
                )
            )
    return tuple(result)


def profile_widths(evidence: Evidence, fit: Fit) -> Float[np.ndarray, "P 2"]:
    """Distances from each fitted coordinate down and up to the ends of its 90 % interval.

    They start from Laplace's approximation and are corrected by the cost that is found there, the other coordinates
    moved to where one Gauss-Newton step has them best; all ends of one round are replayed together.
    """
    z, bounds = fit.explanation.z, fit.explanation.bounds
    covariance = np.linalg.inv(fit.precision(evidence))
    deviation = np.sqrt(np.diagonal(covariance))
    width = np.repeat(QUANTILE * deviation[:, None], 2, axis=1)
    room = np.stack([z - bounds[:, 0], bounds[:, 1] - z], axis=1)
    weight = evidence.weight(fit.sse)
    cost = 0.5 * float(weight @ fit.sse + z @ z)
    for _ in range(_ROUNDS):
        ends = [(i, side) for i in range(len(z)) for side in range(2) if min(width[i, side], room[i, side]) > 1e-9]
        trials = []
        for i, side in ends:
            moved = z + (2 * side - 1) * min(width[i, side], room[i, side]) * covariance[i] / covariance[i, i]
            trials.append(fit.explanation.moved(np.clip(moved, bounds[:, 0], bounds[:, 1])))
        for (i, side), trial in zip(ends, evaluate(evidence, trials), strict=True):
            rise = _profiled_cost(trial, weight, i) - cost
            scale = np.sqrt(0.5 * QUANTILE**2 / rise) if rise > 0 else _MOST
            width[i, side] = min(width[i, side], room[i, side]) * float(np.clip(scale, _LEAST, _MOST))
    return np.minimum(width, room)


def _profiled_cost(trial: Fit, weight: Float[np.ndarray, "E"], fixed: int) -> float:
    """Cost after a Gauss-Newton step of all coordinates but one, as the step's own model has it."""
    model = trial.model(weight, 0.5 * float(weight @ trial.sse + trial.explanation.z @ trial.explanation.z))
    free = model.free & (np.arange(len(model.point)) != fixed)
    gain = 0.5 * float(
        model.gradient[free] @ np.linalg.solve(model.curvature[np.ix_(free, free)], model.gradient[free])
    )
    return model.value - gain
