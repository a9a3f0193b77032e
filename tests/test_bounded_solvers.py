"""The bounded solvers on standard problems, beside scipy's, and where the input is bad."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scipy.optimize

from bounded_cases import PROBLEMS
from cablejax.bounded import (
    Box,
    FixedPointAdjoint,
    ProjectedDogleg,
    ProjectedGaussNewton,
    ProjectedLevenbergMarquardt,
    SpectralProjectedGradient,
)

LEAST_SQUARES = {
    "Levenberg-Marquardt": ProjectedLevenbergMarquardt,
    "dogleg": ProjectedDogleg,
    "Gauss-Newton": ProjectedGaussNewton,
}


def minimum(residuals, lower, upper, start, solver, *, steps=500, atol=1e-8, adjoint=None, args=None, **settings):
    feasible = Box(jnp.asarray(lower, float), jnp.asarray(upper, float))
    start = feasible.project(jnp.asarray(start, float))
    adjoint = FixedPointAdjoint() if adjoint is None else adjoint
    options = {"max_steps": steps, "throw": False, "adjoint": adjoint, "args": args}
    if solver == "spectral":
        made = SpectralProjectedGradient(feasible, rtol=0.0, atol=atol, **settings)
        return optx.minimise(lambda y, args: 0.5 * jnp.sum(residuals(y) ** 2), made, start, **options)
    made = LEAST_SQUARES[solver](feasible, rtol=0.0, atol=atol, **settings)
    return optx.least_squares(lambda y, args: residuals(y), made, start, **options)


def half_squares(residuals, y):
    return float(0.5 * jnp.sum(residuals(y) ** 2))


def scipy_values(problem):
    """What `trf`, L-BFGS-B and SLSQP reach."""
    residuals = jax.jit(problem.residuals)
    slope = jax.jit(jax.jacfwd(problem.residuals))
    start = np.clip(problem.start, problem.lower, problem.upper)
    inside = np.clip(start, np.asarray(problem.lower) + 1e-10, np.asarray(problem.upper) - 1e-10)
    bounds = scipy.optimize.Bounds(problem.lower, problem.upper)
    tight = {"xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-12}
    values = [
        scipy.optimize.least_squares(
            lambda y: np.asarray(residuals(y)), inside, lambda y: np.asarray(slope(y)), bounds=bounds, **tight
        ).cost
    ]
    both = jax.jit(jax.value_and_grad(lambda y: 0.5 * jnp.sum(problem.residuals(y) ** 2)))

    def both_in_numpy(y):
        value, gradient = both(y)
        return float(value), np.asarray(gradient)

    for method in ("L-BFGS-B", "SLSQP"):
        out = scipy.optimize.minimize(
            both_in_numpy, start, jac=True, method=method, bounds=bounds, options={"maxiter": 2000, "ftol": 1e-15}
        )
        if np.isfinite(out.fun):
            values.append(out.fun)
    return values


@pytest.mark.parametrize("solver", ["Levenberg-Marquardt", "dogleg"])
@pytest.mark.parametrize("name", PROBLEMS)
def test_reaches_what_the_best_of_scipy_reaches(solver, name):
    problem = PROBLEMS[name]
    with jax.enable_x64(True):
        found = minimum(problem.residuals, problem.lower, problem.upper, problem.start, solver)
        values = scipy_values(problem)
        known = max(values) if problem.other_minima else min(values)
        assert half_squares(problem.residuals, found.value) <= known + 1e-7 * known + 1e-10
        assert (found.value >= problem.lower).all() and (found.value <= problem.upper).all()
