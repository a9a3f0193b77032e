"""Damped Gauss-Newton within bounds for several problems at once whose functions run outside JAX.

The other solvers of this room are compiled: one problem, one traceable function. Fits to recordings are another case.
Their function is a batch of simulations which is the faster the more of them run together, their problems differ in
size, and value, gradient and curvature come from one and the same batch. Here all problems advance in lockstep: each
proposes one trial point, and one call evaluates all of them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from cablejax.bounded.results import Result

Kept = TypeVar("Kept")
"""What the caller keeps of each linearisation."""

# A coordinate this close to its bound is at it; one beyond it by the second has not got there by rounding.
_AT_BOUND, _BEYOND = 1e-9, 1e-6

# Damping begins at the first; an accepted step multiplies it by `_EASED`, a rejected one by `_RAISED`.
_DAMPING, _EASED, _RAISED = 1e-2, 0.2, 8.0
# It is never below the first, after a rejected step never below the second; at the third a problem has stalled.
_LEAST_DAMPING, _LEAST_RAISED, _MOST_DAMPING = 1e-8, 0.1, 1e3


@dataclasses.dataclass(frozen=True)
class QuadraticModel(Generic[Kept]):
    """A quadratic model of one problem about one point.

    Attributes:
        point: shape [P]; P may differ between problems.
        lower, upper: bounds of the point, shape [P]; infinite where there is none.
        value: of the function. What is not finite is never accepted.
        gradient: shape [P].
        curvature: Gauss-Newton's matrix, positive definite (a prior makes it so), shape [P, P].
        kept: what the caller wants back with the point.
        blocks: sets of coordinates that do not see each other, such as each recording's own values: the curvature is an
            arrow matrix, and steps eliminate them, see `solve_arrow`.
    """

    point: Float[np.ndarray, "P"]
    lower: Float[np.ndarray, "P"]
    upper: Float[np.ndarray, "P"]
    value: float
    gradient: Float[np.ndarray, "P"]
    curvature: Float[np.ndarray, "P P"]
    kept: Kept
    blocks: tuple[Int[np.ndarray, "B"], ...] = ()

    @property
    def free(self) -> Bool[np.ndarray, "P"]:
        """Coordinates that a descent may move; those at a bound that want to leave it stay there, shape [P]."""
        leaving_below = (self.point <= self.lower + _AT_BOUND) & (self.gradient > 0)
        leaving_above = (self.point >= self.upper - _AT_BOUND) & (self.gradient < 0)
        return ~(leaving_below | leaving_above)


@dataclasses.dataclass(frozen=True)
class Minimised(Generic[Kept]):
    """Result of one problem.

    Attributes:
        best: the point of the lowest value that was met.
        result: `Result.CONVERGED` where a step promises less than the tolerance, `STALLED` where damping found no lower
            value, `STEP_LIMIT` where the steps were used up, `NONFINITE` where the start had no value.
        evaluations: trial points of this problem.
    """

    best: QuadraticModel[Kept]
    result: Result
    evaluations: int


@dataclasses.dataclass(frozen=True, kw_only=True)
class BatchedGaussNewton:
    """Levenberg-Marquardt with bounds on coordinates, by an active set.

    The step solves `(H + damping diag H) s = -g` over the free coordinates and is cut off at the bounds (Levenberg
    1944, Marquardt 1963; the choice of free coordinates as in Bertsekas, SIAM J. Control Optim. 20, 1982).

    Attributes:
        tolerance: a problem has converged once a step promises to lower its value by less than this.
        max_steps: trial points of each problem, accepted or not.
        largest_step: longest change of one coordinate in one step; points are best given in units in which 1 is much.
    """

    tolerance: float
    max_steps: int
    largest_step: float = np.inf

    def minimise(
        self,
        starts: Sequence[QuadraticModel[Kept]],
        linearise: Callable[[Mapping[int, Float[np.ndarray, "P"]]], Sequence[QuadraticModel[Kept]]],
    ) -> list[Minimised[Kept]]:
        """Minimises all problems.

        Args:
            starts: where they begin; a problem without coordinates has converged.
            linearise: problems by their index in `starts` at trial points, all of one step in one call; the results
                in the mapping's order.

        Raises:
            ValueError: a start is outside of its bounds.
        """
        for i, start in enumerate(starts):
            beyond = np.maximum(start.lower - start.point, start.point - start.upper)
            if (beyond > _BEYOND).any():
                k = int(beyond.argmax())
                raise ValueError(
                    f"Problem {i} begins at {start.point[k]:.6g} in coordinate {k}, expected {start.lower[k]:.6g} to "
                    f"{start.upper[k]:.6g}: clip it to its bounds."
                )
        now, damping, trials_made = list(starts), np.full(len(starts), _DAMPING), np.zeros(len(starts), int)
        results, rejected = [self._at_start(start) for start in starts], np.zeros(len(starts), bool)
        for _ in range(self.max_steps):
            trials = {}
            for i, at in enumerate(now):
                if results[i] is not Result.STEP_LIMIT:
                    continue
                trial = self._trial(at, damping[i])
                if trial is None:
                    # a step that is damped enough promises next to nothing, along a valley soon
                    trial, damping[i] = self._trial(at, _LEAST_DAMPING), _LEAST_DAMPING
                    if trial is None or rejected[i]:
                        results[i] = Result.CONVERGED if trial is None else Result.STALLED
                        continue
                trials[i] = trial
            if not trials:
                break
            for i, there in zip(trials, linearise(trials), strict=True):
                trials_made[i] += 1
                rejected[i] = not there.value < now[i].value
                if not rejected[i]:
                    now[i], damping[i] = there, max(damping[i] * _EASED, _LEAST_DAMPING)
                else:
                    damping[i] = max(damping[i] * _RAISED, _LEAST_RAISED)
                    results[i] = Result.STALLED if damping[i] >= _MOST_DAMPING else Result.STEP_LIMIT
        return [Minimised(*ended) for ended in zip(now, results, trials_made.tolist(), strict=True)]

    def _at_start(self, start: QuadraticModel[Kept]) -> Result:
        """A problem counts as out of steps until it has ended in another way."""
        if not len(start.point):
            return Result.CONVERGED
        known = np.isfinite(start.value) and np.isfinite(start.gradient).all() and np.isfinite(start.curvature).all()
        return Result.STEP_LIMIT if known else Result.NONFINITE

    def _trial(self, at: QuadraticModel[Kept], damping: float) -> Float[np.ndarray, "P"] | None:
        """The next point to try; None where that promises too little."""
        free, step = np.flatnonzero(at.free), np.zeros_like(at.point)
        damped = at.curvature + damping * np.diag(np.diagonal(at.curvature))
        blocks = [np.flatnonzero(np.isin(free, block)) for block in at.blocks]
        step[free] = -solve_arrow(damped[np.ix_(free, free)], at.gradient[free], blocks)
        if -(at.gradient @ step + 0.5 * step @ at.curvature @ step) < self.tolerance:
            return None
        step *= min(1.0, self.largest_step / max(np.abs(step).max(), 1e-12))
        return np.clip(at.point + step, at.lower, at.upper)


def solve_arrow(
    matrix: Float[np.ndarray, "P P"], right: Float[np.ndarray, "P *K"], blocks: Sequence[Int[np.ndarray, "B"]] = ()
) -> Float[np.ndarray, "P *K"]:
    """Solves `matrix x = right` by eliminating the blocks first (Schur complement).

    What is left has the size of the other coordinates, however many blocks there are.

    Args:
        matrix: its entries between two different blocks are zero.
        right: one right hand side, or several as columns.
        blocks: disjoint sets of indices.
    """
    inner = np.setdiff1d(np.arange(len(matrix)), np.concatenate([np.zeros(0, int), *blocks]))
    reduced, pull, kept = matrix[np.ix_(inner, inner)], right[inner], []
    for block in blocks:
        across = matrix[np.ix_(inner, block)]
        solved = np.linalg.solve(matrix[np.ix_(block, block)], np.column_stack([across.T, right[block]]))
        by_inner, alone = solved[:, : len(inner)], solved[:, len(inner) :].reshape(right[block].shape)
        reduced, pull = reduced - across @ by_inner, pull - across @ alone
        kept.append((by_inner, alone))
    solution = np.empty(right.shape)
    solution[inner] = np.linalg.solve(reduced, pull)
    for block, (by_inner, alone) in zip(blocks, kept, strict=True):
        solution[block] = alone - by_inner @ solution[inner]
    return solution
