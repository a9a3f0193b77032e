"""The lockstep Gauss-Newton driver: known minima, bounds, breakdowns, and problems that do not disturb each other."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.optimize

from cablejax.bounded import BatchedGaussNewton, QuadraticModel, Result, solve_arrow

SOLVER = BatchedGaussNewton(tolerance=1e-14, max_steps=300)


def rosenbrock(y):
    return np.array([10 * (y[1] - y[0] ** 2), 1 - y[0]]), np.array([[-20 * y[0], 10.0], [-1.0, 0.0]])


def decay(y):
    """An exponential through five noisy points."""
    t, seen = np.arange(5.0), np.array([2.1, 1.1, 0.7, 0.3, 0.25])
    shape = np.exp(-y[1] * t)
    return y[0] * shape - seen, np.stack([shape, -y[0] * t * shape], axis=1)


def line(y):
    return np.array([y[0] - 3.0, 2 * (y[0] - 3.0)]), np.array([[1.0], [2.0]])


PROBLEMS = {
    "free": (rosenbrock, [-1.2, 1.0], [-5.0, -5.0], [5.0, 5.0]),
    "bounded": (rosenbrock, [-1.0, 0.5], [-1.5, -1.5], [0.8, 1.5]),
    "corner": (rosenbrock, [2.0, -1.0], [1.5, -3.0], [4.0, 1.0]),
    "exponential": (decay, [1.0, 1.0], [0.0, 0.0], [np.inf, np.inf]),
    "one number": (line, [0.0], [-1.0], [2.0]),
}


def linearised(problem, y):
    fn, _, lower, upper = problem
    r, jacobian = fn(np.asarray(y))
    return QuadraticModel(
        point=np.asarray(y, float),
        lower=np.array(lower),
        upper=np.array(upper),
        value=0.5 * float(r @ r),
        gradient=jacobian.T @ r,
        curvature=jacobian.T @ jacobian + 1e-12 * np.eye(len(y)),
        kept=fn.__name__,
    )


def solve(problems, solver=SOLVER):
    problems = list(problems)
    calls = []

    def linearise(trials):
        calls.append(len(trials))
        return [linearised(problems[i], y) for i, y in trials.items()]

    return solver.minimise([linearised(p, p[1]) for p in problems], linearise), calls


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_minimum_is_that_of_scipy(name):
    fn, start, lower, upper = PROBLEMS[name]
    ((ended,), _) = solve([PROBLEMS[name]])
    inside = np.clip(start, np.array(lower) + 1e-6, np.array(upper) - 1e-6)
    best = scipy.optimize.least_squares(
        lambda y: fn(y)[0], inside, bounds=(lower, upper), xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    assert ended.result is Result.CONVERGED
    np.testing.assert_allclose(ended.best.point, best.x, atol=2e-6)
    assert ended.best.value <= best.cost + 1e-12
    assert ended.best.kept == fn.__name__


def test_problems_of_all_sizes_in_lockstep_end_as_they_do_alone():
    together, calls = solve(PROBLEMS.values())
    for problem, ended in zip(PROBLEMS.values(), together, strict=True):
        ((alone,), _) = solve([problem])
        np.testing.assert_array_equal(ended.best.point, alone.best.point)
        assert (ended.result, ended.evaluations) == (alone.result, alone.evaluations)
    assert calls[0] == len(PROBLEMS) and calls == sorted(calls, reverse=True), "one call for all that still run"
    assert sum(calls) == sum(ended.evaluations for ended in together)


def test_every_trial_point_keeps_to_the_bounds_and_to_the_longest_step():
    problem, last, met = PROBLEMS["bounded"], [np.array(PROBLEMS["bounded"][1])], []

    def linearise(trials):
        (y,) = trials.values()
        met.append(y)
        assert np.abs(y - last[0]).max() <= 0.1 + 1e-12
        there = linearised(problem, y)
        if there.value < linearised(problem, last[0]).value:
            last[0] = y
        return [there]

    solver = BatchedGaussNewton(tolerance=1e-14, max_steps=300, largest_step=0.1)
    (ended,) = solver.minimise([linearised(problem, problem[1])], linearise)
    assert ended.result is Result.CONVERGED and len(met) == ended.evaluations > 10
    assert (np.array(met) >= problem[2]).all() and (np.array(met) <= problem[3]).all()


def test_a_point_without_a_value_is_never_kept():
    def edge(y):
        """Breaks down above 2, towards its minimum at 3."""
        return (np.full(2, np.nan), np.full((2, 1), np.nan)) if y[0] > 2 else line(y)

    ((ended,), _) = solve([(edge, [0.0], [-9.0], [9.0])])
    assert ended.result is Result.STALLED and 1.9 < ended.best.point[0] <= 2.0
    ((dead,), calls) = solve([(edge, [4.0], [-9.0], [9.0])])
    assert dead.result is Result.NONFINITE and calls == []


def test_the_steps_are_limited_and_a_loose_tolerance_saves_them():
    ((short,), calls) = solve([PROBLEMS["free"]], BatchedGaussNewton(tolerance=1e-14, max_steps=3))
    assert short.result is Result.STEP_LIMIT and short.evaluations == len(calls) == 3
    ((loose,), few) = solve([PROBLEMS["exponential"]], BatchedGaussNewton(tolerance=1e-2, max_steps=300))
    ((_,), many) = solve([PROBLEMS["exponential"]])
    assert loose.result is Result.CONVERGED and len(few) < len(many)


def test_nothing_to_move_has_converged():
    empty = QuadraticModel(np.zeros(0), np.zeros(0), np.zeros(0), 1.0, np.zeros(0), np.zeros((0, 0)), None)
    (ended,) = SOLVER.minimise([empty], lambda trials: pytest.fail("evaluated"))
    assert ended.result is Result.CONVERGED and ended.evaluations == 0


def arrow(n_blocks: int, seed: int = 0):
    """A positive definite arrow matrix of three shared coordinates and blocks of two, shuffled; and its blocks."""
    generator, size = np.random.default_rng(seed), 3 + 2 * n_blocks
    matrix = np.eye(size)
    for k in range(n_blocks):
        rows = np.r_[0:3, 3 + 2 * k, 4 + 2 * k]
        root = generator.normal(size=(7, 5))
        matrix[np.ix_(rows, rows)] += root.T @ root
    order = generator.permutation(size)
    place = np.argsort(order)
    return matrix[np.ix_(order, order)], [place[[3 + 2 * k, 4 + 2 * k]] for k in range(n_blocks)]


@pytest.mark.parametrize("columns", [(), (4,)])
def test_elimination_of_blocks_solves_the_whole_system(columns):
    matrix, blocks = arrow(6)
    right = np.random.default_rng(1).normal(size=(len(matrix), *columns))
    np.testing.assert_allclose(solve_arrow(matrix, right, blocks), np.linalg.solve(matrix, right), rtol=1e-9)
    np.testing.assert_array_equal(solve_arrow(matrix, right), np.linalg.solve(matrix, right))


def test_blocks_change_no_step_though_some_of_their_coordinates_are_at_a_bound():
    matrix, blocks = arrow(4)
    middle = np.random.default_rng(2).normal(size=len(matrix))

    def quadratic(blocks):
        def at(point):
            off = point - middle
            value, gradient = 0.5 * float(off @ matrix @ off) + 0.25 * float((off**4).sum()), matrix @ off + off**3
            curvature = matrix + np.diag(3 * off**2)
            return QuadraticModel(
                point, np.full(len(off), -0.3), np.full(len(off), 0.5), value, gradient, curvature, None, blocks
            )

        (ended,) = SOLVER.minimise([at(np.zeros(len(middle)))], lambda trials: [at(y) for y in trials.values()])
        return ended

    dense, eliminated = quadratic(()), quadratic(tuple(blocks))
    assert dense.result == eliminated.result == Result.CONVERGED
    assert 0 < (~dense.best.free).sum() < len(middle)
    np.testing.assert_allclose(eliminated.best.point, dense.best.point, atol=1e-7)


def test_a_problem_whose_steps_are_rejected_is_stalled_and_not_converged():
    """The derivative has the wrong sign: no step lowers the value, however much the damping shortens it."""

    def wrong(y):
        return np.array([y[0] - 3.0]), np.array([[-1.0]])

    def linearise(points):
        return [
            QuadraticModel(
                y, np.full(1, -9.0), np.full(1, 9.0), 0.5 * float(r @ r), jacobian.T @ r, jacobian.T @ jacobian, None
            )
            for y in points.values()
            for r, jacobian in [wrong(y)]
        ]

    solver = BatchedGaussNewton(tolerance=1e-6, max_steps=300)
    (end,) = solver.minimise(linearise({0: np.zeros(1)}), linearise)
    assert end.result is Result.STALLED and end.best.point[0] == 0.0


def test_a_start_in_a_valley_goes_along_it():
    """Damping by the curvature across hides what a step along the valley promises."""
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    matrix = turn @ np.diag([1e5, 1.0]) @ turn.T

    def linearise(points):
        wide = np.full(2, 99.0)
        return [
            QuadraticModel(y, -wide, wide, 0.5 * float(y @ matrix @ y), matrix @ y, matrix, None)
            for y in points.values()
        ]

    (end,) = BatchedGaussNewton(tolerance=0.02, max_steps=8).minimise(linearise({0: turn @ [0.0, 3.0]}), linearise)
    assert end.result is Result.CONVERGED and end.best.value < 0.02


def test_a_start_outside_of_its_bounds_is_refused():
    """A coordinate beyond a bound that the descent would leave counted as converged."""
    start = QuadraticModel(
        np.array([2.0]), np.array([-9.0]), np.array([1.0]), 0.5, np.array([-1.0]), np.eye(1), kept=None
    )
    with pytest.raises(ValueError, match=r"Problem 0 begins at 2 in coordinate 0, expected -9 to 1"):
        SOLVER.minimise([start], lambda trials: [])
