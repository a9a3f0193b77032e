"""Fits of effects to a log: damped Gauss-Newton on whole rollouts, many candidates in lockstep.

All candidates share one batch of replays per iteration: the step of each, evaluated together with its derivatives.
Derivatives are forward differences in the prior's own units. They serve smooth effects and those with a threshold
(yield, contact, slip) alike, where a derivative in the limit sees nothing at all on one side.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from cablejax.cable import Discretisation
from cablejax.diagnose.playback import Playback
from cablejax.diagnose.repeats import episodes_by_motion, share_of_motion
from cablejax.effects.base import Effect
from cablejax.effects.physics import Physics

_FIRST_DAMPING = 1e-2
# Largest change of one coordinate in one step, in prior standard deviations.
_LARGEST_STEP = 1.5
# Beyond this, the linear picture of a fit without one episode is not believed.
_LARGEST_HELD_OUT_STEP = 0.5
_BREAKDOWN = 1e12


@dataclasses.dataclass(frozen=True)
class Term:
    """One effect as it takes part in a candidate explanation.

    Attributes:
        effect: from the library.
        variant: one of `effect.variants`.
    """

    effect: Effect
    variant: int

    @property
    def size(self) -> int:
        return len(self.effect.parameters)

    def values(self, z: Sequence[float]) -> list[Any]:
        """Parameter values at the term's coordinates."""
        return [p.value(np.float64(x)) for p, x in zip(self.effect.parameters, z, strict=True)]


@dataclasses.dataclass(frozen=True)
class Candidate:
    """An explanation of the gap: effects that act together, and coordinates to start from.

    Attributes:
        terms: applied in this order; none = the nominal cable.
        z: coordinates of all parameters, in the order of the terms, see `Parameter.value`.
    """

    terms: tuple[Term, ...]
    z: Float[np.ndarray, "P"]

    def by_term(self, z: Any = None) -> list[tuple[Term, Any]]:
        """Every term with its part of the coordinates."""
        z, ends = self.z if z is None else z, np.cumsum([0, *(term.size for term in self.terms)])
        return [(term, z[begin:end]) for term, begin, end in zip(self.terms, ends[:-1], ends[1:], strict=True)]

    def values(self) -> list[np.ndarray]:
        """Parameter values of every term."""
        return [np.array(term.values(z)) for term, z in self.by_term()]

    def physics(self, nominal: Physics, config: Discretisation, z: Any = None) -> Physics:
        """The nominal physics with all terms applied. Differentiable in `z`, if that is a JAX array."""
        for term, part in self.by_term(np.asarray(self.z, np.float32) if z is None else z):
            values = [p.value(x) for p, x in zip(term.effect.parameters, part, strict=True)]
            nominal = term.effect.apply(nominal, values, term.variant, config)
        return nominal

    @property
    def differences(self) -> Float[np.ndarray, "P"]:
        """Steps of forward differences in the coordinates, inwards where the upper bound is near."""
        size = np.array([p.difference for term in self.terms for p in term.effect.parameters])
        return np.where(self.z + size > self.bounds[:, 1], -size, size)

    @property
    def bounds(self) -> Float[np.ndarray, "P 2"]:
        """Bounds of the coordinates."""
        return np.array([p.z_bounds for term in self.terms for p in term.effect.parameters]).reshape(-1, 2)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(term.effect.name for term in self.terms)


def candidate(*parts: tuple[Effect, int, Sequence[float]]) -> Candidate:
    """A candidate from (effect, variant, parameter values)."""
    z = [
        np.clip(p.coordinate(float(value)), *p.z_bounds)
        for effect, _, values in parts
        for p, value in zip(effect.parameters, values, strict=True)
    ]
    return Candidate(terms=tuple(Term(effect, variant) for effect, variant, _ in parts), z=np.array(z, np.float64))


@dataclasses.dataclass(frozen=True)
class Evidence:
    """What a log says, ready for fitting.

    Attributes:
        playback: the log's motions at the resolution of the fits.
        target: observed keypoints less the discretisation error of that resolution [m], NaN = not observed.
        noise: standard deviation of each observed coordinate [m], shape [N].
        temper: how many correlated samples of each episode count as one independent, see `belief`, shape [E].
        freedom: of Student's distribution over episodes, see `belief`.
        motion: episodes with the same number repeat one another, see `repeats`, shape [E].
    """

    playback: Playback
    target: Float[np.ndarray, "E T N 2"]
    noise: Float[np.ndarray, "N"]
    temper: Float[np.ndarray, "E"]
    freedom: float
    motion: Int[np.ndarray, "E"]

    def restricted(self, episodes: Sequence[int]) -> Evidence:
        """The evidence of some episodes only."""
        chosen = np.asarray(episodes, int)
        playback = dataclasses.replace(
            self.playback,
            gripper_pose=self.playback.gripper_pose[chosen],
            angles=self.playback.angles[chosen],
            interval=self.playback.interval[chosen],
        )
        return dataclasses.replace(
            self,
            playback=playback,
            target=self.target[chosen],
            temper=self.temper[chosen],
            motion=self.motion[chosen],
        )

    def residuals(self, keypoints: Float[np.ndarray, "*P E T N 2"]) -> Float[np.ndarray, "*P E M"]:
        """Whitened differences of simulations from the target, 0 where nothing was observed."""
        difference = (keypoints - self.target) / self.noise[:, None]
        difference = np.where(np.isfinite(self.target), difference, 0.0)
        return difference.reshape(*difference.shape[:-3], -1)

    def surprise(self, sse: Float[np.ndarray, "E"]) -> Float[np.ndarray, "E"]:
        """Q of every episode: squared error above the noise, in units of what is to be expected."""
        return (sse - self.count) / self.temper

    def log_likelihood(self, sse: Float[np.ndarray, "E"]) -> float:
        """Student's log likelihood up to a constant, see `belief`; below the noise floor, its tangent there.

        The floor is an estimate: a fit may come out below it, and still has a best value.
        """
        surprise = self.surprise(sse) / self.freedom
        each = np.where(surprise > 0, np.log1p(np.maximum(surprise, 0.0)), surprise)
        return float(-0.5 * (self.freedom + 1) * (share_of_motion(self.motion) * each).sum())

    def weight(self, sse: Float[np.ndarray, "E"]) -> Float[np.ndarray, "E"]:
        """Weight of each episode's squared residuals in an equivalent least squares problem."""
        share = share_of_motion(self.motion)
        return share * (self.freedom + 1) / (self.freedom + np.maximum(self.surprise(sse), 0.0)) / self.temper

    @property
    def count(self) -> Float[np.ndarray, "E"]:
        """Observed coordinates of each episode."""
        return np.isfinite(self.target).sum(axis=(1, 2, 3))


@dataclasses.dataclass(frozen=True)
class Fit:
    """A candidate after fitting. Sums over an episode's whitened residuals r and their derivatives J.

    Attributes:
        candidate: with the fitted coordinates.
        sse: r'r of every episode, shape [E]; huge where the simulation broke down.
        gradient: J'r, shape [E, P].
        curvature: J'J, shape [E, P, P].
    """

    candidate: Candidate
    sse: Float[np.ndarray, "E"]
    gradient: Float[np.ndarray, "E P"]
    curvature: Float[np.ndarray, "E P P"]

    def cost(self, evidence: Evidence) -> float:
        """Negative log posterior density up to a constant."""
        return -evidence.log_likelihood(self.sse) + 0.5 * float(self.candidate.z @ self.candidate.z)

    def precision(self, evidence: Evidence) -> Float[np.ndarray, "P P"]:
        """Inverse posterior covariance of the coordinates, by Laplace's approximation with fixed weights."""
        return self.weighted_precision(evidence.weight(self.sse))

    def weighted_precision(self, weight: Float[np.ndarray, "E"]) -> Float[np.ndarray, "P P"]:
        """The same with weights of another fit."""
        return np.einsum("epq,e->pq", self.curvature, weight) + np.eye(len(self.candidate.z))

    def free(self, gradient: Float[np.ndarray, "P"]) -> Bool[np.ndarray, "P"]:
        """Coordinates that a descent of the cost may move; those at a bound that want to leave it stay there."""
        z, (lower, upper) = self.candidate.z, self.candidate.bounds.T
        return ~(((z <= lower + 1e-9) & (gradient > 0)) | ((z >= upper - 1e-9) & (gradient < 0)))

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


def evaluate(evidence: Evidence, candidates: Sequence[Candidate]) -> list[Fit]:
    """Replays candidates together with their forward differences."""
    nominal, config = evidence.playback.believed, evidence.playback.config
    physics, steps = [], []
    for c in candidates:
        physics.append(c.physics(nominal, config))
        sign = c.differences
        steps.append(sign)
        for i in range(len(c.z)):
            moved = c.z.astype(np.float64)
            moved[i] += sign[i]
            physics.append(c.physics(nominal, config, np.asarray(moved, np.float32)))
    fits, begin = [], 0
    # in portions, since residuals are larger than what they are summed up to
    for c, sign in zip(candidates, steps, strict=True):
        count = 1 + len(c.z)
        fits.append((c, sign, physics[begin : begin + count]))
        begin += count
    return [fit for portion in _portions(fits, 64) for fit in _evaluate_portion(evidence, portion)]


def _portions(fits, size):
    portion, count = [], 0
    for item in fits:
        portion.append(item)
        count += len(item[2])
        if count >= size:
            yield portion
            portion, count = [], 0
    if portion:
        yield portion


def _evaluate_portion(evidence, portion):
    keypoints = evidence.playback.keypoints([p for _, _, group in portion for p in group])
    residuals = evidence.residuals(keypoints)
    begin = 0
    for c, sign, group in portion:
        r, moved = residuals[begin], residuals[begin + 1 : begin + len(group)]
        begin += len(group)
        broken = ~np.isfinite(r).all(axis=1)
        with np.errstate(invalid="ignore"):
            jacobian = (moved - r) / sign[:, None, None]
        # a breakdown next door gives no derivative
        jacobian = np.where(np.isfinite(jacobian).all(axis=2, keepdims=True), jacobian, 0.0)
        r = np.where(broken[:, None], 0.0, r)
        jacobian = np.where(broken[None, :, None], 0.0, jacobian).astype(np.float64)
        yield Fit(
            candidate=c,
            sse=np.where(broken, _BREAKDOWN, np.einsum("em,em->e", r, r)),
            gradient=np.einsum("pem,em->ep", jacobian, r),
            curvature=np.einsum("pem,qem->epq", jacobian, jacobian, optimize=True),
        )


def improve(evidence: Evidence, fits: Sequence[Fit], *, max_iterations: int, tolerance: float = 0.02) -> list[Fit]:
    """Damped Gauss-Newton (Levenberg 1944, Marquardt 1963) from evaluated candidates, all in lockstep.

    Args:
        evidence: to fit.
        fits: from `evaluate`; each keeps its terms.
        max_iterations: steps, accepted or not.
        tolerance: a candidate is done once a step promises to lower its cost by less than this, in nats.
    """
    fits = list(fits)
    damping = np.full(len(fits), _FIRST_DAMPING)
    running = [len(fit.candidate.z) > 0 for fit in fits]
    for _ in range(max_iterations):
        trials = {}
        for i, fit in enumerate(fits):
            if not running[i]:
                continue
            z, bounds = fit.candidate.z, fit.candidate.bounds
            precision = fit.precision(evidence)
            gradient = fit.gradient.T @ evidence.weight(fit.sse) + z
            free = fit.free(gradient)
            step = np.zeros_like(z)
            damped = precision + damping[i] * np.diag(np.diagonal(precision))
            step[free] = -np.linalg.solve(damped[np.ix_(free, free)], gradient[free])
            promised = -(gradient @ step + 0.5 * step @ precision @ step)
            step *= min(1.0, _LARGEST_STEP / max(np.abs(step).max(), 1e-12))
            if promised < tolerance:
                running[i] = False
                continue
            moved = np.clip(z + step, bounds[:, 0], bounds[:, 1])
            trials[i] = dataclasses.replace(fit.candidate, z=moved)
        if not trials:
            break
        for i, trial in zip(trials, evaluate(evidence, list(trials.values())), strict=True):
            if trial.cost(evidence) < fits[i].cost(evidence):
                fits[i], damping[i] = trial, max(damping[i] / 5, 1e-4)
            else:
                damping[i] = max(damping[i] * 8, 0.1)
                running[i] = damping[i] < 1e3
    return fits
