"""Intervals of a fit's coordinates by profiles of the posterior.

The interval of one coordinate ends where the cost, minimised over all others, has risen by `z^2 / 2` (Venzon and
Moolgavkar 1988), with z the quantile of the normal distribution. A threshold, a stretch limit or a place makes profiles
that rise faster on one side than on the other, which a covariance cannot say. The weights of the episodes stay those of
the fit, as in `Fit.precision`.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from cablejax.diagnose.evidence import Evidence
from cablejax.diagnose.fit import Fit, evaluate

QUANTILE = 1.6449
"""Of the normal distribution, at 95 %: the intervals are two-sided 90 %."""
_ROUNDS = 2
_MOST, _LEAST = 2.0, 0.5


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


def scaled_draws(
    evidence: Evidence, fit: Fit, widening: float, count: int, rng: np.random.Generator
) -> Float[np.ndarray, "D P"]:
    """Coordinates as likely as the log says: normal, stretched on each side to the width of the profile.

    Args:
        evidence: that was fitted.
        fit: at its optimum.
        widening: all widths are multiplied by this.
        count: of draws.
        rng: for them.
    """
    covariance = np.linalg.inv(fit.precision(evidence))
    draws = rng.multivariate_normal(np.zeros(len(covariance)), covariance, size=count, method="cholesky")
    down, up = (profile_widths(evidence, fit) / (QUANTILE * np.sqrt(np.diagonal(covariance)))[:, None]).T
    moved = fit.explanation.z + widening * draws * np.where(draws < 0, down, up)
    return np.clip(moved, *fit.explanation.bounds.T)


def _profiled_cost(trial: Fit, weight: Float[np.ndarray, "E"], fixed: int) -> float:
    """Cost after a Gauss-Newton step of all coordinates but one, as the step's own model has it."""
    model = trial.model(weight, 0.5 * float(weight @ trial.sse + trial.explanation.z @ trial.explanation.z))
    free = model.free & (np.arange(len(model.point)) != fixed)
    gain = 0.5 * float(
        model.gradient[free] @ np.linalg.solve(model.curvature[np.ix_(free, free)], model.gradient[free])
    )
    return model.value - gain
