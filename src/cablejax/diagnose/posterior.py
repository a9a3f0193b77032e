"""Draws from what a log leaves open: coordinates of one explanation, and explanations with their values."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from cablejax.diagnose.belief import Calibration, in_doubt
from cablejax.diagnose.diagnosis import EffectValues
from cablejax.diagnose.evidence import Evidence
from cablejax.diagnose.fit import Fit
from cablejax.diagnose.laws import Law
from cablejax.diagnose.profile import scaled_draws
from cablejax.diagnose.search import Search

_DRAWS = 400
# These are not simulated, and Student's tails need more of them.
_JACKKNIFE_DRAWS = 4000
# Of the posterior that a verdict holds.
_POSTERIOR = 16


def draws(evidence: Evidence, fit: Fit, calibration: Calibration) -> Float[np.ndarray, "D P"]:
    """Coordinates as likely as the log says, in no order.

    Where parts of the recordings were left out, how far that moves them (jackknife) adds to the posterior's width, and
    the distribution is Student's with a degree of freedom fewer than parts; else they follow profiles of the posterior.
    """
    random = np.random.default_rng(0)
    if not len(fit.explanation.z):
        return np.zeros((_DRAWS, 0))
    if fit.refits is None:
        return scaled_draws(evidence, fit, calibration.widening, _DRAWS, random)
    z = np.stack([one.z for one in fit.refits.explanations])
    parts = len(z)
    covariance = np.linalg.inv(fit.precision(evidence)) + (parts - 1) * np.cov(z.T, bias=True).reshape(2 * z.shape[1:])
    normal = random.multivariate_normal(np.zeros(len(covariance)), covariance, _JACKKNIFE_DRAWS, method="cholesky")
    drawn = fit.explanation.z + normal * np.sqrt((parts - 1) / random.chisquare(parts - 1, (_JACKKNIFE_DRAWS, 1)))
    return np.clip(drawn, *fit.explanation.bounds.T)


def drawn_by(law: Law, best: Fit, calibration: Calibration) -> tuple[Fit, Float[np.ndarray, "D P"]] | None:
    """The fit of the same terms by another law, and draws of its coordinates; None where the law counts for nothing."""
    same = law.fit_of(best.explanation)
    if same is None or not same.explanation.terms or law.probability < 1.0 / _DRAWS:
        return None
    return same, draws(law.evidence, same, calibration)


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
    rest = len(own) - sum(map(len, parts))
    return np.random.default_rng(0).permutation(np.concatenate([own[:rest], *parts]))


def posterior(
    found: Search, evidence: Evidence, calibration: Calibration, best: Float[np.ndarray, "D P"]
) -> tuple[tuple[EffectValues, ...], ...]:
    """Explanations that the verdict leaves open with their values, each as often as it is probable.

    Args:
        found: by the search.
        evidence: that was fitted.
        calibration: of the judgement.
        best: draws of the best fit's coordinates, in no order.
    """
    fits, chances = in_doubt(found.fits, found.scores, evidence, calibration)
    taken = np.searchsorted(np.cumsum(chances), (np.arange(_POSTERIOR) + 0.5) / _POSTERIOR)
    result = []
    for k in np.unique(np.minimum(taken, len(fits) - 1)):
        drawn = best if fits[k] is found.fits[0] else draws(evidence, fits[k], calibration)
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
