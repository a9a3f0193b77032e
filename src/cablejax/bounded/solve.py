"""Entry points of the solvers: minimise a function, or a sum of squares, over a feasible set."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jax.core import Tracer
from jaxtyping import Array, Bool

from cablejax.bounded.implicit import FixedPointAdjoint
from cablejax.bounded.objective import derivative_along, forward, squared_jacobian, value_of
from cablejax.bounded.results import Result, Solution, Stats, result_of
from cablejax.bounded.sets import AbstractSet

_SOLVERS = "Expected one of `cablejax.bounded`, such as BoundedLevenbergMarquardt() or BoundedQuasiNewton()."


def minimise(
    fn: Callable[[Array, Any], Array],
    solver: optx.AbstractMinimiser,
    y0: Array,
    feasible: AbstractSet,
    args: Any = None,
    *,
    hessian: Callable[[Array, Any], Array] | None = None,
    max_steps: int = 1000,
    throw: bool = True,
) -> Solution:
    """Minimises `fn(y, args)`, a scalar, over the y in a set.

    Args:
        fn: the function.
        solver: `BoundedQuasiNewton(...)` or `SpectralProjectedGradient(...)`.
        y0: where to start; projected onto the set first.
        feasible: the set.
        args: what else the function depends on.
        hessian: at the start a model of the Hessian [P, P], positive semi-definite, if there is one;
            `BoundedQuasiNewton` begins with it.
        max_steps: of the solver at most, with one trial point each unless `trials_per_linearisation` is larger.
        throw: whether to raise outside compiled code; within, the result code is all there is.

    Returns:
        The solution, differentiable in `args` and the set where it has converged, see `FixedPointAdjoint`.

    Raises:
        ValueError: the set is empty, or start, set or tolerances are not valid.
        RuntimeError: the solve ended in another way than convergence.
    """
    return _solve(optx.minimise, fn, solver, y0, feasible, args, "hessian", hessian, max_steps, throw)


def least_squares(
    residual_fn: Callable[[Array, Any], Array],
    solver: optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser,
    y0: Array,
    feasible: AbstractSet,
    args: Any = None,
    *,
    linearise: Callable[[Array, Any], tuple[Array, Array]] | None = None,
    max_steps: int = 200,
    throw: bool = True,
) -> Solution:
    """Minimises half the sum of squares of `residual_fn(y, args)`, a flat array, over the y in a set.

    Args:
        residual_fn: the residuals.
        solver: `BoundedLevenbergMarquardt(...)`, `BoundedDogleg(...)`, `BoundedGaussNewton(...)`, or a solver for
            `minimise`, which is given half the sum of squares and J'J at the start.
        y0: where to start; projected onto the set first.
        feasible: the set.
        args: what else the residuals depend on.
        linearise: residuals and Jacobian [M, P], if there is a cheaper way than `jax.jacfwd`.
        max_steps: of the solver at most, with one trial point each unless `trials_per_linearisation` is larger.
        throw: whether to raise outside compiled code; within, the result code is all there is.

    Returns:
        The solution, differentiable in `args` and the set where it has converged, see `FixedPointAdjoint`.

    Raises:
        ValueError: the set is empty, or start, set or tolerances are not valid.
        RuntimeError: the solve ended in another way than convergence.
    """
    if isinstance(solver, optx.AbstractMinimiser):

        def half_squares(y, args):
            return value_of(residual_fn(y, args))

        squared = squared_jacobian(linearise or forward(residual_fn))
        return minimise(half_squares, solver, y0, feasible, args, hessian=squared, max_steps=max_steps, throw=throw)
    return _solve(optx.least_squares, residual_fn, solver, y0, feasible, args, "linearise", linearise, max_steps, throw)


def _solve(entry, fn, solver, y0, feasible: AbstractSet, args, option: str, given, max_steps: int, throw: bool):
    """By one of optimistix's entry points; `given` is the function that the solver takes as an option, or None."""
    y0, start = _checked(solver, y0, feasible, max_steps)
    # with what they close over as arguments, so that it may be traced
    fn = eqx.filter_closure_convert(fn, start, args)
    given = None if given is None else eqx.filter_closure_convert(given, start, args)
    options = {"feasible": feasible, option: given}
    out: optx.Solution = entry(
        fn, solver, start, args, options, max_steps=max_steps, adjoint=FixedPointAdjoint(), throw=False
    )
    if missing := {"objective", "optimality", "evaluations", "linearisations"} - {*out.stats}:
        raise ValueError(
            f"The solver {type(solver).__name__} reports no {', '.join(sorted(missing))}. {_SOLVERS} Optimistix' own "
            "solvers keep to no feasible set."
        )
    unknown = jnp.isnan(y0).any() | ~jnp.isfinite(start).all()
    apart = ~unknown & feasible.outside(start, y0)
    return _finish(out, fn, args, feasible.empty() | apart, unknown, throw)


def _checked(solver, y0, feasible, max_steps: int) -> tuple[Array, Array]:
    """The start as an array, and its projection; raises ValueError for what no solver can work with."""
    if not isinstance(solver, optx.AbstractMinimiser | optx.AbstractLeastSquaresSolver):
        raise ValueError(f"The solver is {solver!r}. {_SOLVERS}")
    if not isinstance(feasible, AbstractSet):
        raise ValueError(f"feasible is {feasible!r}, expected a set: Box, Balls, Halfspaces, Intersection or your own.")
    if not eqx.is_array_like(y0) or jnp.size(y0) == 0:
        raise ValueError(
            f"y0 is {y0!r}, expected an array of one number or more (of a pytree: jax.flatten_util.ravel_pytree)."
        )
    for name in ("rtol", "atol"):
        tolerance = getattr(solver, name)
        if isinstance(tolerance, float | int) and not tolerance >= 0:
            raise ValueError(f"{type(solver).__name__}: {name} is {tolerance}, expected a number of at least 0.")
    if max_steps < 1:
        raise ValueError(f"max_steps is {max_steps}, expected at least 1.")
    y0 = jnp.asarray(y0)
    y0 = y0 if jnp.issubdtype(y0.dtype, jnp.inexact) else y0.astype(float)
    try:
        return y0, feasible.project(y0)
    except TypeError as error:
        raise ValueError(f"y0 of shape {y0.shape} does not fit the set {type(feasible).__name__}: {error}") from error


@eqx.filter_custom_jvp
def _value_at(fn, y, args, known):
    """`known`, which is `value_of(fn(y, args))`, with its derivatives; only for these the function is called."""
    del fn, y, args
    return known


@_value_at.def_jvp
def _value_at_jvp(primals, tangents):
    *inputs, known = primals
    return known, derivative_along(lambda fn, y, args: value_of(fn(y, args)), tuple(inputs), tuple(tangents[:-1]))


def _finish(out: optx.Solution, fn, args, empty: Bool[Array, ""], unknown: Bool[Array, ""], throw: bool) -> Solution:
    """The solution as ours; `empty` = no point is feasible, `unknown` = the start was not finite."""
    code = jnp.where(unknown, Result.NONFINITE, result_of(out.result))
    code = jnp.where(empty, Result.EMPTY_SET, code).astype(jnp.int32)
    solution = Solution(
        value=out.value,
        objective=_value_at(fn, out.value, args, out.stats["objective"]),
        result=code,
        stats=Stats(
            iterations=jnp.asarray(out.stats["num_steps"], jnp.int32),
            evaluations=out.stats["evaluations"],
            linearisations=out.stats["linearisations"],
        ),
        optimality=out.stats["optimality"],
    )
    if throw and not isinstance(code, Tracer):
        result = Result(int(code))
        if result is Result.EMPTY_SET:
            raise ValueError(result.message)
        if result is not Result.CONVERGED:
            # a derivative is being taken of the objective, not of the code
            reached = "" if isinstance(solution.objective, Tracer) else f" (objective {float(solution.objective):.6g})"
            raise RuntimeError(f"{result.message}{reached}")
    return solution
