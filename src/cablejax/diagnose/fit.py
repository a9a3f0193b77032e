"""Fits of effects to a recording: damped Gauss-Newton on whole rollouts, many explanations in lockstep.

All explanations share one batch of predictions per iteration: the step of each, evaluated together with its
derivatives.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float, Int

from cablejax.bounded import BatchedGaussNewton, QuadraticModel, Result, solve_arrow
from cablejax.diagnose.evidence import Evidence, episodes_by_motion, student_log_likelihoods
from cablejax.diagnose.protocol import Explanation

# Largest change of one coordinate in one step, in prior standard deviations.
_LARGEST_STEP = 1.5
# Beyond this, the linear picture of a fit without one episode is not believed.
_LARGEST_HELD_OUT_STEP = 0.5
_BREAKDOWN = 1e12
# Predictions that are held at once: they are larger than what they are summed up to.
_PORTION = 64


@dataclasses.dataclass(frozen=True)
class Refits:
    """Fits of one explanation without each part of the recordings.

    Attributes:
        explanations: fitted to all but one part; what the left out recordings have for their own is that of the check.
        left_out: rows of the evidence that each has not seen.
        sse: r'r of every episode, from the fit that has not seen it, shape [E].
    """

    explanations: tuple[Explanation, ...]
    left_out: tuple[Int[np.ndarray, "_"], ...]
    sse: Float[np.ndarray, "E"]


@dataclasses.dataclass(frozen=True)
class Fit:
    """An explanation after fitting. Sums over an episode's whitened residuals r and their derivatives J.

    J's columns are the coordinates that all episodes share, then what the episode's recording has for its own.

    Attributes:
        explanation: with the fitted coordinates.
        sse: r'r of every episode, shape [E]; huge where the simulation broke down.
        gradient: J'r, shape [E, C].
        curvature: J'J, shape [E, C, C].
        recording: row of each episode among the recordings' own numbers, shape [E]; empty where there are none.
        refits: the same explanation without parts of the recordings, where that was fitted.
        result: how the fit ended; `STEP_LIMIT` also where no step was made.
    """

    explanation: Explanation
    sse: Float[np.ndarray, "E"]
    gradient: Float[np.ndarray, "E C"]
    curvature: Float[np.ndarray, "E C C"]
    recording: Int[np.ndarray, "E"] = dataclasses.field(default_factory=lambda: np.zeros(0, int))
    refits: Refits | None = None
    result: Result = Result.STEP_LIMIT

    def cost(self, evidence: Evidence) -> float:
        """Negative log posterior density up to a constant."""
        own = self.explanation.own[np.unique(self.recording)]
        prior = 0.5 * float(self.explanation.z @ self.explanation.z) + 0.5 * float((own**2).sum())
        return prior + self.misfit(evidence)

    def misfit(self, evidence: Evidence) -> float:
        """Negative log likelihood up to a constant."""
        freedom = evidence.fit_freedom or evidence.freedom
        return -float(student_log_likelihoods(evidence.surprise(self.sse), freedom, evidence.share).sum())

    def precision(self, evidence: Evidence) -> Float[np.ndarray, "P P"]:
        """Inverse posterior covariance of the shared coordinates, by Laplace's approximation with fixed weights."""
        model = self.model(evidence.weight(self.sse), 0.0)
        if not model.blocks:
            return model.curvature
        shared = np.eye(len(model.point), len(self.explanation.z))
        return np.linalg.inv(solve_arrow(model.curvature, shared, model.blocks)[: shared.shape[1]])

    def model(self, weight: Float[np.ndarray, "E"], cost: float) -> QuadraticModel[Fit]:
        """The quadratic model of a cost in which every episode has a fixed weight.

        Its point holds z, then the own numbers of each recording that has episodes here: blocks, which every solution
        eliminates, so that what is left has the size of z however many recordings there are.
        """
        z, (lower, upper) = self.explanation.z, self.explanation.bounds.T
        n = len(z)
        gradient = self.gradient[:, :n].T @ weight + z
        curvature = np.einsum("epq,e->pq", self.curvature[:, :n, :n], weight) + np.eye(n)
        rows, own = np.unique(self.recording), self.explanation.own
        if not len(rows):
            return QuadraticModel(z, lower, upper, cost, gradient, curvature, self)
        count = own.shape[1]
        blocks = tuple(n + count * k + np.arange(count) for k in range(len(rows)))
        point = np.concatenate([z, own[rows].ravel()])
        whole, pull = np.eye(len(point)), point.copy()
        whole[:n, :n], pull[:n] = curvature, gradient
        for row, block in zip(rows, blocks, strict=True):
            part = self.recording == row
            pull[block] += self.gradient[part, n:].T @ weight[part]
            curved = np.einsum("epq,e->pq", self.curvature[part], weight[part])
            whole[np.ix_(block, block)] += curved[n:, n:]
            whole[:n, block], whole[block, :n] = curved[:n, n:], curved[n:, :n]
        wide = np.full(len(point) - n, np.inf)
        lower, upper = np.append(lower, -wide), np.append(upper, wide)
        return QuadraticModel(point, lower, upper, cost, pull, whole, self, blocks)

    def at(self, point: Float[np.ndarray, "C"]) -> Explanation:
        """The explanation at a point of `model`."""
        n, own = len(self.explanation.z), self.explanation.own.copy()
        if len(self.recording):
            own[np.unique(self.recording)] = point[n:].reshape(-1, own.shape[1])
        return self.explanation.moved(point[:n], own)

    def restricted(self, rows: Int[np.ndarray, "_"]) -> Fit:
        """The sums of some of the episodes."""
        recording = self.recording[rows] if len(self.recording) else self.recording
        return Fit(self.explanation, self.sse[rows], self.gradient[rows], self.curvature[rows], recording)

    def held_out_sse(self, evidence: Evidence) -> Float[np.ndarray, "E"]:
        """R'r of every episode if its motion had been left out of the fit: by `refits` where there are some.

        Else by one Gauss-Newton step without the episodes of this motion. Where that leads too far to be believed,
        because this motion alone shows the effect, or because there is no other, its episodes pay twice the number of
        parameters that it decides on instead, as in Akaike's criterion.
        """
        if self.refits is not None:
            return self.refits.sse
        precision, weight = self.precision(evidence), evidence.weight(self.sse)
        model = self.model(weight, 0.0)
        # a fit ends where a step promises little: where one motion says almost all, what is left of the gradient of all
        # of them is not small beside that of the others
        left = np.where(model.free, model.gradient, 0.0)
        result = np.empty_like(self.sse)
        for left_out in episodes_by_motion(evidence.motion):
            informed = np.einsum("e,epq->pq", weight[left_out], self.curvature[left_out])
            step = np.linalg.solve(precision - informed, weight[left_out] @ self.gradient[left_out] - left)
            for e in left_out:
                if np.abs(step).max(initial=0.0) <= _LARGEST_HELD_OUT_STEP:
                    result[e] = self.sse[e] + 2 * self.gradient[e] @ step + step @ self.curvature[e] @ step
                else:
                    decided = np.trace(np.linalg.solve(precision, weight[e] * self.curvature[e]))
                    result[e] = self.sse[e] + 2.0 * decided / weight[e]
        return np.maximum(result, self.sse)


def evaluate(evidence: Evidence, explanations: Sequence[Explanation]) -> list[Fit]:
    """Evaluates explanations: sums over their residuals and derivatives."""
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
    simulator = evidence.simulator
    portion = [simulator.with_own(one) for one in portion]
    linearised = simulator.linearise(portion, evidence.episodes)
    for one, (predicted, slopes) in zip(portion, linearised, strict=True):
        weighted = _squares if evidence.robust is None else _robust
        sse, r, jacobian = weighted(evidence, predicted, slopes)
        yield Fit(
            explanation=one,
            sse=sse,
            gradient=np.einsum("pem,em->ep", jacobian, r),
            curvature=np.einsum("pem,qem->epq", jacobian, jacobian, optimize=True),
            recording=np.asarray(simulator.recording, int)[evidence.episodes] if one.own.size else np.zeros(0, int),
        )


def _squares(evidence: Evidence, predicted, slopes):
    """Sums of squares, whitened residuals and derivatives; an episode that broke down counts as a whole."""
    unseen = ~np.isfinite(evidence.observed).reshape(len(evidence.observed), -1)
    r = evidence.whitened(predicted)
    broken = np.asarray(~np.isfinite(r).all(axis=1))
    jacobian = np.asarray(slopes / evidence.noise, np.float64).reshape(len(slopes), *r.shape)
    # in place: these are the largest arrays of a diagnosis
    jacobian[:, unseen] = 0.0
    # a breakdown next door gives no derivative
    jacobian[~np.isfinite(jacobian).all(axis=2)] = 0.0
    jacobian[:, broken], r[broken] = 0.0, 0.0
    return np.where(broken, _BREAKDOWN, np.einsum("em,em->e", r, r)), r, jacobian


def _robust(evidence: Evidence, predicted, slopes):
    """The same with the loss of `Evidence.robust`; what broke down counts point by point."""
    loss = evidence.robust
    assert loss is not None
    seen = np.isfinite(evidence.observed).all(axis=-1)
    lost = ~np.isfinite(predicted).all(axis=-1)
    if len(slopes):
        lost |= ~(np.abs(slopes).max(axis=(0, -1)) < loss.steepest)
    use = (seen & ~lost)[..., None]
    miss = np.where(use, predicted - np.where(use, evidence.observed, 0.0), 0.0)
    root = np.sqrt(1 + (miss**2).sum(axis=-1, keepdims=True) / loss.distance**2)
    unit = 2 * (loss.distance / evidence.noise) ** 2 * np.ones_like(root)
    inner = tuple(range(1, root.ndim))
    sse = (unit * np.where(use, root - 1, 0.0)).sum(axis=inner)
    sse += (unit * (seen & lost)[..., None]).sum(axis=inner) * loss.lost / loss.distance
    scale = np.where(use, 1 / (np.sqrt(root) * evidence.noise), 0.0)
    jacobian = np.where(use, slopes, 0.0)
    jacobian *= scale
    r = (miss * scale).reshape(len(miss), -1)
    return sse, r, jacobian.reshape(len(slopes), *r.shape)


def improve(
    evidence: Evidence,
    fits: Sequence[Fit],
    max_iterations: int,
    *,
    tolerance: float | None = None,
    own_only: bool = False,
) -> list[Fit]:
    """Damped Gauss-Newton from evaluated explanations, all in lockstep.

    The weights of the episodes are those of the fit from which a step begins: iteratively reweighted least squares.

    Args:
        evidence: to fit.
        fits: from `evaluate`; each keeps its terms.
        max_iterations: steps, accepted or not.
        tolerance: an explanation is done once a step promises to lower its cost by less than this, in nats; None = as
            the simulator's plan has it.
        own_only: what all recordings share stays as it is.
    """
    tolerance = evidence.simulator.plan.tolerance if tolerance is None else tolerance
    solver = BatchedGaussNewton(tolerance=tolerance, max_steps=max_iterations, largest_step=_LARGEST_STEP)

    def linearised(fit: Fit) -> QuadraticModel[Fit]:
        model = fit.model(evidence.weight(fit.sse), fit.cost(evidence))
        if not own_only:
            return model
        held = np.arange(len(model.point)) < len(fit.explanation.z)
        lower, upper = (np.where(held, model.point, bound) for bound in (model.lower, model.upper))
        return dataclasses.replace(model, lower=lower, upper=upper)

    def linearise(trials):
        return [linearised(fit) for fit in evaluate(evidence, [fits[i].at(point) for i, point in trials.items()])]

    ended = solver.minimise([linearised(fit) for fit in fits], linearise)
    return [dataclasses.replace(one.best.kept, result=one.result) for one in ended]
