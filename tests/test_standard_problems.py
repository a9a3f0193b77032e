"""The standard problems are what their sources say, and every solver is crossed with them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.bounded import (
    BoundedDogleg,
    BoundedGaussNewton,
    BoundedLevenbergMarquardt,
    BoundedQuasiNewton,
    Result,
    SpectralProjectedGradient,
    least_squares,
    minimise,
)
from cablejax.simulate.elastica import elastica, solve_elastica
from standard_problems import BoundedProblem, all_problems
from standard_problems import more_garbow_hillstrom as mgh
from standard_problems.elastica_shaping import ROTATION, ElasticaShaping
from standard_problems.nist import DATA_SETS

PROBLEMS = {problem.name: problem for problem in all_problems()}
SOLVERS = {
    "Levenberg-Marquardt": BoundedLevenbergMarquardt(atol=1e-9),
    "dogleg": BoundedDogleg(atol=1e-9),
    "Gauss-Newton": BoundedGaussNewton(atol=1e-9),
    "quasi-Newton": BoundedQuasiNewton(atol=1e-9),
    "spectral gradient": SpectralProjectedGradient(atol=1e-9),
}
QUICK = (
    "Rosenbrock 2, x2 <= 0.5",
    "Beale, x1 <= 2",
    "Bard, x2 <= 1",
    "HS2",
    "elastica to arch, steps <= 0.01 m",
)
"""One of each kind whose solve is quick and that every solver for it must find; some bounds active in all."""
SMOOTH = ("HS4", "HS5", "HS45")
"""Not sums of squares."""


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


@functools.cache
def compiled(solver, residuals, function):
    """Bounds and start are traced: problems that share a function compile once."""
    if residuals is not None:
        solve = functools.partial(least_squares, lambda y, _: residuals(y).ravel(), SOLVERS[solver], max_steps=2000)
    else:
        solve = functools.partial(minimise, lambda y, _: function(y), SOLVERS[solver], max_steps=2000)
    return jax.jit(functools.partial(solve, throw=False))


def check(solver, problem: BoundedProblem):
    """Solved, feasible, and an optimum by the certificate, which knows neither solver nor optimum."""
    out = compiled(solver, problem.residuals, problem.function)(jnp.asarray(problem.start), problem.feasible())
    objective = float(problem.objective(out.value))
    assert problem.is_solved(np.asarray(out.value), objective), (objective, problem.optimum, Result(int(out.result)))
    assert objective == pytest.approx(float(out.objective), rel=1e-12)
    residual, scale = judge_of(problem.name)(out)
    assert float(residual) <= 1e-5 * (1.0 + float(scale))


@functools.cache
def judge_of(name: str):
    """Residual of the certificate, and the size of the gradient at the start; compiled as a whole."""
    problem = PROBLEMS[name]
    fn = problem.residuals if problem.is_least_squares else problem.function
    assert fn is not None

    @jax.jit
    def judge(out):
        certificate = out.certificate(lambda y, _: fn(y), problem.feasible())
        return certificate.residual, jnp.abs(
            jax.grad(problem.objective)(problem.feasible().project(problem.start))
        ).max()

    return judge


def every_pair():
    """All solvers on the first problem and two on each other one are quick; the rest, and the rod, is slow."""
    for i, name in enumerate(QUICK):
        for j, solver in enumerate(SOLVERS):
            quick = i == 0 or ((j - i) % len(SOLVERS) < 2 and name != QUICK[-1])
            yield pytest.param(name, solver, marks=() if quick else pytest.mark.slow)


@pytest.mark.parametrize(("name", "solver"), list(every_pair()))
def test_every_solver_finds_the_quick_ones(solver, name):
    check(solver, PROBLEMS[name])


@pytest.mark.parametrize("solver", ["quasi-Newton", "spectral gradient"])
@pytest.mark.parametrize("name", SMOOTH)
def test_solvers_by_gradients_find_what_is_no_sum_of_squares(name, solver):
    check(solver, PROBLEMS[name])


@pytest.mark.slow
@pytest.mark.parametrize("name", [problem.name for problem in PROBLEMS.values() if problem.is_least_squares])
def test_some_least_squares_solver_finds_each(name):
    """Which finds which is in docs/results/bounded_solvers.md; here, that no problem is out of reach."""
    problem = PROBLEMS[name]
    solved = []
    for solver in ("Levenberg-Marquardt", "dogleg"):
        out = compiled(solver, problem.residuals, None)(jnp.asarray(problem.start), problem.feasible())
        solved.append(problem.is_solved(np.asarray(out.value), float(problem.objective(out.value))))
    assert any(solved)


@pytest.mark.parametrize("data", DATA_SETS, ids=lambda data: data.name)
def test_nist_data_give_the_certified_sum_of_squares(data):
    """Eleven certified digits come out only if every datum is typed right."""
    squares = np.sum(np.asarray(data.residuals(jnp.asarray(data.certified))) ** 2)
    assert squares == pytest.approx(data.sum_of_squares, rel=1e-9)


@pytest.mark.parametrize(
    ("residuals", "point", "squares"),
    [
        (mgh.freudenstein_roth, (11.4127789869, -0.8968052533), 48.9842536792),
        (mgh.brown_badly_scaled, (1e6, 2e-6), 0.0),
        (mgh.beale, (3.0, 0.5), 0.0),
        (mgh.jennrich_sampson, (0.2578252136, 0.2578252136), 124.362),
        (mgh.helical_valley, (1.0, 0.0, 0.0), 0.0),
        (mgh.bard, (0.08241056, 1.13303609, 2.34369518), 8.21487e-3),
        (mgh.powell_singular, (0.0, 0.0, 0.0, 0.0), 0.0),
        (mgh.wood_function, (1.0, 1.0, 1.0, 1.0), 0.0),
        (mgh.brown_dennis, (-11.5944399, 13.2036300, -0.4034394, 0.2367787), 85822.2),
        (mgh.watson_function, (-0.01572509, 1.01243487, -0.23299162, 1.26043009, -1.51372892, 0.99299643), 2.28767e-3),
    ],
)
def test_functions_have_the_papers_values_at_the_papers_optima(residuals, point, squares):
    assert float(jnp.sum(residuals(jnp.asarray(point)) ** 2)) == pytest.approx(squares, rel=1e-5, abs=1e-15)


def test_values_at_the_papers_starts():
    """Sums of squares at the starts, from the paper's definitions by hand."""
    assert float(jnp.sum(mgh.powell_singular(jnp.array([3.0, -1.0, 0.0, 1.0])) ** 2)) == pytest.approx(215.0)
    assert float(jnp.sum(mgh.helical_valley(jnp.array([-1.0, 0.0, 0.0])) ** 2)) == pytest.approx(2500.0)
    assert float(jnp.sum(mgh.wood_function(jnp.array([-3.0, -1.0, -3.0, -1.0])) ** 2)) == pytest.approx(19192.0)
    assert float(PROBLEMS["HS38"].objective(jnp.array([-3.0, -1.0, -3.0, -1.0]))) == pytest.approx(19192.0)
    assert float(PROBLEMS["Broyden tridiagonal 10"].objective(-jnp.ones(10))) == pytest.approx(0.5 * 21.0)


def test_all_problems_are_complete():
    @jax.jit
    def begin(feasible, start):
        start = feasible.project(start)
        return start, feasible.violation(start), feasible.empty()

    assert len(PROBLEMS) == len(all_problems()) >= 60
    for problem in PROBLEMS.values():
        assert np.isfinite(problem.optimum) and problem.note
        start, violation, empty = begin(problem.feasible(), jnp.asarray(problem.start))
        assert problem.violation(np.asarray(start)) <= 1e-15 and float(violation) <= 1e-15
        assert not bool(empty)


def test_a_problem_states_one_objective_and_one_set():
    start = np.zeros(2)
    with pytest.raises(ValueError, match="residuals or its function"):
        BoundedProblem("none", "test", start, 0.0, radius=1.0)
    with pytest.raises(ValueError, match="lower and upper bounds or a radius"):
        BoundedProblem("both", "test", start, 0.0, residuals=lambda y: y, lower=start, upper=start, radius=1.0)
    with pytest.raises(ValueError, match="lower and upper bounds or a radius"):
        BoundedProblem("half", "test", start, 0.0, residuals=lambda y: y, lower=start)


def test_success_is_strict():
    problem = PROBLEMS["HS4"]
    assert problem.is_solved(np.array([1.0, 0.0]), 8 / 3)
    assert not problem.is_solved(np.array([1.0, 0.0]), 8 / 3 * (1 + 1e-5))
    assert not problem.is_solved(np.array([1.0 - 1e-6, 0.0]), 8 / 3)
    assert not problem.is_solved(np.array([np.nan, 0.0]), 8 / 3)


def shaping() -> ElasticaShaping:
    residuals = PROBLEMS["elastica to hook, steps <= 0.05 m"].residuals
    return residuals.__self__  # the task that the bound method belongs to


def test_the_rod_is_the_collocated_elastica():
    """Against `solve_bvp` on the same ends, which shares no code with the shooting."""
    task = shaping()
    motion = 0.02 * np.random.default_rng(0).normal(size=(4, 2, 3))
    shapes = task.shapes(jnp.asarray(motion))
    pose = task.start + np.cumsum(motion / np.array([1.0, 1.0, ROTATION]), axis=0)
    arclength = np.linspace(0.0, 1.0, shapes.shape[1])
    guess = solve_elastica(task.start, 1.0).position
    expected = elastica(pose[-1], 1.0, arclength, guess=guess)
    np.testing.assert_allclose(shapes[-1], expected, atol=2e-6)


def test_the_rods_derivatives():
    """JVP against central differences and against VJP, at a plan with all its steps different."""
    task = shaping()
    rng = np.random.default_rng(1)
    motion, way = (jnp.asarray(0.01 * rng.normal(size=(4, 2, 3))) for _ in range(2))
    residuals = jax.jit(task.residuals)
    tangent = jax.jvp(residuals, (motion,), (way,))[1]
    h = 1e-4
    numeric = (residuals(motion + h * way) - residuals(motion - h * way)) / (2 * h)
    np.testing.assert_allclose(tangent, numeric, atol=1e-8 * float(jnp.abs(tangent).max()) + 1e-10)
    cotangent = jnp.asarray(rng.normal(size=tangent.shape))
    pulled = jax.vjp(residuals, motion)[1](cotangent)[0]
    np.testing.assert_allclose(jnp.sum(pulled * way), jnp.sum(cotangent * tangent), rtol=1e-10)
