"""A bounded solver step by step: where it was, when, and how good that was.

The loop over the steps is on the host, one compiled step after the other, as a solver in another language would call
it, so that paths of different solvers can be compared by the clock. `cablejax.bounded` solves in one compiled call.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from cablejax.bounded import AbstractSet


@dataclasses.dataclass(frozen=True)
class SolverPath:
    """Where a solver went.

    Attributes:
        points: the start and the best point after each step, shape [I + 1, ...].
        seconds: wall time of each since the start, shape [I + 1].
        objectives: values of the points, shape [I + 1].
        converged: whether the solver's own test was passed.
    """

    points: Float[np.ndarray, "I1 ..."]
    seconds: Float[np.ndarray, " I1"]
    objectives: Float[np.ndarray, " I1"]
    converged: bool

    def seconds_to(self, objective: float) -> float:
        """When it first had a point as good as this [s]; infinite = never."""
        good = self.objectives <= objective
        return float(self.seconds[good].min()) if good.any() else float("inf")


class PathFinder:
    """Steps of one solver on one function, compiled once for all `args`, sets and starts of the same shapes.

    Args:
        fn: `(y, args) -> residuals` for a least squares solver, `(y, args) -> objective` for a minimiser.
        solver: of `cablejax.bounded`.
        linearise: residuals and Jacobian, if there is a cheaper way than `jax.jacfwd`.
    """

    def __init__(
        self,
        fn: Callable[[Array, Any], Array],
        solver: optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser,
        linearise: Callable[[Array, Any], tuple[Array, Array]] | None = None,
    ):
        self._fn, self._solver, self._linearise = fn, solver, linearise
        self._begin, self._advance = eqx.filter_jit(self._init), eqx.filter_jit(self._step)
        self._value = eqx.filter_jit(self._objective)

    def __call__(
        self, args: Any, feasible: AbstractSet, start: Float[Array | np.ndarray, "..."], max_steps: int
    ) -> SolverPath:
        """The path from a start, projected onto the set first, until the solver stops or the steps are used up."""
        y = feasible.project(jnp.asarray(start))
        state = self._begin(y, args, feasible)
        points, seconds, done, converged = [np.asarray(y)], [0.0], False, False
        began = time.perf_counter()
        while not done and len(seconds) <= max_steps:
            y, state, done, converged = jax.block_until_ready(self._advance(y, state, args, feasible))
            points.append(np.asarray(y))
            seconds.append(time.perf_counter() - began)
        # A rejected trial leaves the point where it is.
        met = {point.tobytes(): point for point in points}
        value = {key: float(self._value(jnp.asarray(point), args)) for key, point in met.items()}
        values = np.array([value[point.tobytes()] for point in points])
        best = np.minimum.accumulate(np.where(np.isfinite(values), values, np.inf))
        last = np.maximum.accumulate(np.where(values <= best, np.arange(len(values)), 0))
        return SolverPath(
            points=np.stack(points)[last], seconds=np.array(seconds), objectives=values[last], converged=bool(converged)
        )

    def _options(self, feasible):
        return {"feasible": feasible, "linearise": self._linearise}

    def _with_aux(self, y, args):
        return self._fn(y, args), None

    def _objective(self, y, args):
        out = self._fn(y, args)
        return out if out.ndim == 0 else 0.5 * jnp.sum(out**2)

    def _init(self, y, args, feasible):
        struct = jax.eval_shape(self._fn, y, args)
        return self._solver.init(self._with_aux, y, args, self._options(feasible), struct, None, frozenset())

    def _step(self, y, state, args, feasible):
        options = self._options(feasible)
        y, state, _ = self._solver.step(self._with_aux, y, args, options, state, frozenset())
        done, result = self._solver.terminate(self._with_aux, y, args, options, state, frozenset())
        return y, state, done, done & (result == optx.RESULTS.successful)
