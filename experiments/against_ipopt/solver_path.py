"""Records a bounded solver step by step: points, times and objectives.

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
from cablejax.bounded.objective import squared_jacobian, value_of


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

    def followed_by(self, rest: SolverPath) -> SolverPath:
        """This path, and one that begins at its end."""
        return SolverPath(
            points=np.concatenate([self.points, rest.points[1:]]),
            seconds=np.concatenate([self.seconds, self.seconds[-1] + rest.seconds[1:]]),
            objectives=np.concatenate([self.objectives, rest.objectives[1:]]),
            converged=rest.converged,
        )


class PathFinder:
    """Steps of one solver on one function, compiled once for all `args`, sets and starts of the same shapes.

    Args:
        fn: `(y, args) -> residuals`, or `(y, args) -> objective` for a minimiser; given residuals, it minimises half
            their squares.
        solver: of `cablejax.bounded`.
        linearise: residuals and Jacobian, if there is a cheaper way than `jax.jacfwd`; a minimiser begins with J'J.
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
        points, seconds, done, converged = [np.asarray(y)], [0.0], False, False
        began = time.perf_counter()
        state = jax.block_until_ready(self._begin(y, args, feasible))
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
        hessian = None if self._linearise is None else squared_jacobian(self._linearise)
        return {"feasible": feasible, "linearise": self._linearise, "hessian": hessian}

    def _with_aux(self, y, args):
        minimises = isinstance(self._solver, optx.AbstractMinimiser)
        return (self._objective if minimises else self._fn)(y, args), None

    def _objective(self, y, args):
        return value_of(self._fn(y, args))

    def _init(self, y, args, feasible):
        struct, _ = jax.eval_shape(self._with_aux, y, args)
        return self._solver.init(self._with_aux, y, args, self._options(feasible), struct, None, frozenset())

    def _step(self, y, state, args, feasible):
        options = self._options(feasible)
        y, state, _ = self._solver.step(self._with_aux, y, args, options, state, frozenset())
        done, result = self._solver.terminate(self._with_aux, y, args, options, state, frozenset())
        return y, state, done, done & (result == optx.RESULTS.successful)
