"""Fits of effects to a recording: damped Gauss-Newton on whole rollouts, many explanations in lockstep.

All explanations share one batch of predictions per iteration: the step of each, evaluated together with its
derivatives.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from cablejax.bounded import BatchedGaussNewton, Linearised
from cablejax.diagnose.evidence import Evidence
from cablejax.diagnose.protocol import Explanation
from cablejax.diagnose.repeats import episodes_by_motion

# Largest change of one coordinate in one step, in prior standard deviations.
_LARGEST_STEP = 1.5
# Beyond this, the linear picture of a fit without one episode is not believed.
_LARGEST_HELD_OUT_STEP = 0.5
_BREAKDOWN = 1e12
# Predictions that are held at once: they are larger than what they are summed up to.
_PORTION = 64


@dataclasses.dataclass(frozen=True)
class Fit:
    """An explanation after fitting. Sums over an episode's whitened residuals r and their derivatives J.

    Attributes:
        explanation: with the fitted coordinates.
        sse: r'r of every episode, shape [E]; huge where the simulation broke down.
        gradient: J'r, shape [E, P].
        curvature: J'J, shape [E, P, P].
    """

    explanation: Explanation
    sse: Float[np.ndarray, "E"]
    gradient: Float[np.ndarray, "E P"]
    curvature: Float[np.ndarray, "E P P"]

    def cost(self, evidence: Evidence) -> float:
        """Negative log posterior density up to a constant."""
        return -evidence.log_likelihood(self.sse) + 0.5 * float(self.explanation.z @ self.explanation.z)

    def precision(self, evidence: Evidence) -> Float[np.ndarray, "P P"]:
        """Inverse posterior covariance of the coordinates, by Laplace's approximation with fixed weights."""
        return self._precision(evidence.weight(self.sse))

    def model(self, weight: Float[np.ndarray, "E"], cost: float) -> Linearised[Fit]:
        """The quadratic model of a cost in which every episode has a fixed weight."""
        z, (lower, upper) = self.explanation.z, self.explanation.bounds.T
        gradient = self.gradient.T @ weight + z
        return Linearised(z, lower, upper, cost, gradient, self._precision(weight), self)

    def _precision(self, weight):
        return np.einsum("epq,e->pq", self.curvature, weight) + np.eye(len(self.explanation.z))

    def held_out_sse(self, evidence: Evidence) -> Float[np.ndarray, "E"]:
        """r'r of every episode if its motion had been left out of the fit.

        By one Gauss-Newton step without the episodes of this motion. Where that leads too far to be believed, because
        this motion alone shows the effect, or because there is no other, its episodes pay twice the number of
        parameters that it decides on instead, as in Akaike's criterion.
        """
        precision, weight = self.precision(evidence), evidence.weight(self.sse)
        result = np.empty_like(self.sse)
        for left_out in episodes_by_motion(evidence.motion):
            informed = np.einsum("e,epq->pq", weight[left_out], self.curvature[left_out])
            step = np.linalg.solve(precision - informed, weight[left_out] @ self.gradient[left_out])
            for e in left_out:
                if np.abs(step).max(initial=0.0) <= _LARGEST_HELD_OUT_STEP:
                    result[e] = self.sse[e] + 2 * self.gradient[e] @ step + step @ self.curvature[e] @ step
                else:
                    decided = np.trace(np.linalg.solve(precision, weight[e] * self.curvature[e]))
                    result[e] = self.sse[e] + 2.0 * decided / weight[e]
        return np.maximum(result, self.sse)


def evaluate(evidence: Evidence, explanations: Sequence[Explanation]) -> list[Fit]:
    """Predictions of explanations together with their derivatives, summed up."""
    return [fit for portion in _portions(explanations) for fit in _evaluated(evidence, portion)]


def _portions(explanations: Sequence[Explanation]) -> Iterator[list[Explanation]]:
    portion, count = [], 0
    for one in explanations:
        portion.append(one)
        count += 1 + len(one.z)
        if count >= _PORTION:
            yield portion
            portion, count = [], 0
    if portion:
        yield portion


def _evaluated(evidence: Evidence, portion: Sequence[Explanation]) -> Iterator[Fit]:
    linearised = evidence.simulator.linearise(portion, evidence.episodes)
    unseen = ~np.isfinite(evidence.observed).reshape(len(evidence.observed), -1)
    for one, (predicted, slopes) in zip(portion, linearised, strict=True):
        r = evidence.whitened(predicted)
        broken = np.asarray(~np.isfinite(r).all(axis=1))
        jacobian = np.asarray(slopes / evidence.noise, np.float64).reshape(len(slopes), *r.shape)
        # in place: these are the largest arrays of a diagnosis
        jacobian[:, unseen] = 0.0
        # a breakdown next door gives no derivative
        jacobian[~np.isfinite(jacobian).all(axis=2)] = 0.0
        jacobian[:, broken], r[broken] = 0.0, 0.0
        yield Fit(
            explanation=one,
            sse=np.where(broken, _BREAKDOWN, np.einsum("em,em->e", r, r)),
            gradient=np.einsum("pem,em->ep", jacobian, r),
            curvature=np.einsum("pem,qem->epq", jacobian, jacobian, optimize=True),
        )


def improve(evidence: Evidence, fits: Sequence[Fit], *, max_iterations: int, tolerance: float = 0.02) -> list[Fit]:
    """Damped Gauss-Newton from evaluated explanations, all in lockstep.

    The weights of the episodes are those of the fit from which a step begins: iteratively reweighted least squares.

    Args:
        evidence: to fit.
        fits: from `evaluate`; each keeps its terms.
        max_iterations: steps, accepted or not.
        tolerance: an explanation is done once a step promises to lower its cost by less than this, in nats.
    """
    solver = BatchedGaussNewton(tolerance=tolerance, max_steps=max_iterations, largest_step=_LARGEST_STEP)

    def linearised(fit: Fit) -> Linearised[Fit]:
        return fit.model(evidence.weight(fit.sse), fit.cost(evidence))

    def linearise(trials):
        moved = [fits[i].explanation.moved(z) for i, z in trials.items()]
        return [linearised(fit) for fit in evaluate(evidence, moved)]

    return [ended.best.kept for ended in solver.minimise([linearised(fit) for fit in fits], linearise)]
