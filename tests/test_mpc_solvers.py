"""Every solver on every problem, against scipy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from cablejax.bounded import Result
from cablejax.mpc import Dogleg, GaussNewton, LevenbergMarquardt, ProjectedGradient
from mpc_cases import TARGETS, problem, random_motion

STEPS = 3
SOLVERS = {
    "projected gradient": ProjectedGradient(max_evaluations=300, tolerance=1e-5),
    "nonmonotone": ProjectedGradient(max_evaluations=300, tolerance=1e-5, memory=6),
    "Levenberg-Marquardt": LevenbergMarquardt(max_iterations=12, trials_per_linearisation=1, tolerance=1e-5),
    "dogleg": Dogleg(max_iterations=12, trials_per_linearisation=1, tolerance=1e-5),
    "Gauss-Newton": GaussNewton(max_iterations=12, trials_per_linearisation=1, tolerance=1e-5),
}
EACH = [
    name if name in ("projected gradient", "Levenberg-Marquardt") else pytest.param(name, marks=pytest.mark.slow)
    for name in SOLVERS
]
CASES = {
    "unbounded": {"target": "near", "radius": 1.0},
    "bounds active": {"target": "U", "radius": 0.05},
    "some active": {"target": "S", "radius": 0.1},
}


@functools.cache
def reference(name):
    """SLSQP in float64 with the same constraints, gradients by JAX."""
    with jax.enable_x64(True):
        case = problem(**CASES[name])
        radius = CASES[name]["radius"]
        shape = (STEPS, 2, 3)
        value = jax.jit(jax.value_and_grad(lambda flat: 1e2 * case.value(flat.reshape(shape))))
        separation = np.asarray(case.feasible.separation, float)

        def slack(flat):
            motion = flat.reshape(shape)
            distance = separation + np.cumsum(motion[:, 1, :2] - motion[:, 0, :2], axis=0)
            square = np.sum(distance**2, axis=-1)
            return np.concatenate(
                [1e2 * (radius**2 - np.sum(motion**2, axis=-1)).ravel(), 0.99**2 - square, square - 0.15**2]
            )

        def both(flat):
            f, g = value(flat)
            return float(f), np.asarray(g, float)

        out = scipy.optimize.minimize(
            both,
            np.zeros(STEPS * 6),
            jac=True,
            method="SLSQP",
            constraints={"type": "ineq", "fun": slack},
            options={"ftol": 1e-10, "maxiter": 300},
        )
        assert out.success, out.message
        return out.fun / 1e2


@functools.cache
def compiled(solver_name):
    def both(case, guess):
        start = case.start(guess)
        plan = SOLVERS[solver_name](case, start)
        return plan, case.value(plan.motion), case.value_of(start), case.feasible.violation(plan.motion)

    return jax.jit(both)


def solve(solver_name, case, guess):
    """The plan, its value and that of the guess; a plan has to be feasible always."""
    plan, value, start, violation = compiled(solver_name)(case, guess)
    assert float(violation) == 0.0
    return plan, float(value), float(start)


@pytest.mark.parametrize("solver", EACH)
@pytest.mark.parametrize("name", CASES)
def test_reaches_the_objective_that_scipy_reaches(solver, name):
    case = problem(**CASES[name])
    _, value, start = solve(solver, case, jnp.zeros((STEPS, 2, 3)))
    assert value - reference(name) <= 2e-3 * (start - reference(name))


@pytest.mark.parametrize("solver", EACH)
@pytest.mark.parametrize("target", TARGETS)
def test_plan_is_feasible_and_no_worse_than_the_guess_whatever_the_guess(solver, target):
    for seed in range(3):
        case = problem(target)
        _, value, start = solve(solver, case, random_motion(seed, STEPS, size=0.1))
        assert value <= start * (1 + 1e-6)


@pytest.mark.parametrize("solver", EACH)
def test_says_when_it_has_converged(solver):
    case = problem("U")
    plan, value, _ = solve(solver, case, jnp.zeros((STEPS, 2, 3)))
    again, same, _ = solve(solver, case, plan.motion)
    assert Result(int(again.result)) is Result.CONVERGED
    assert int(again.evaluations) <= 10
    assert same == pytest.approx(value, rel=1e-4)


@pytest.mark.parametrize(
    "solver",
    [pytest.param(ProjectedGradient(max_evaluations=3), marks=pytest.mark.slow), LevenbergMarquardt(max_iterations=1)],
)
def test_stops_at_its_budget_with_an_improvement(solver):
    case, guess = problem("U"), jnp.zeros((STEPS, 2, 3))

    @jax.jit
    def planned(case):
        plan = solver(case, case.start(guess))
        return plan, case.value(plan.motion), case.value(guess)

    plan, value, before = planned(case)
    assert Result(int(plan.result)) is Result.STEP_LIMIT
    # the projected gradient counts the guess, too
    if isinstance(solver, ProjectedGradient):
        spent = solver.max_evaluations
    else:
        spent = solver.max_iterations * solver.trials_per_linearisation
    assert int(plan.evaluations) == spent
    assert float(value) < 0.8 * float(before)


@pytest.mark.parametrize("solver", EACH)
def test_stays_finite_where_the_model_is_not(solver):
    """NaN for every motion: the guess comes back."""
    case = problem("U", rate=float("nan"))
    plan, _, _ = solve(solver, case, jnp.zeros((STEPS, 2, 3)))
    np.testing.assert_array_equal(plan.motion, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["projected gradient", "Levenberg-Marquardt"])
def test_solves_many_problems_at_once(solver):
    cases = [problem(target, radius=radius) for target, radius in (("U", 0.05), ("near", 0.05), ("S", 0.02))]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cases)
    guess = jnp.zeros((STEPS, 2, 3))
    plans = jax.jit(jax.vmap(lambda case: SOLVERS[solver](case, case.start(guess))))(batch)
    for i, case in enumerate(cases):
        _, alone, start = solve(solver, case, guess)
        assert abs(float(jax.jit(case.value)(plans.motion[i])) - alone) <= 1e-3 * (start - alone)


def test_budgets_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="at least 2 evaluations"):
        ProjectedGradient(max_evaluations=1)
    with pytest.raises(ValueError, match="max_iterations is 0, expected a whole number from 1"):
        LevenbergMarquardt(max_iterations=0)
    with pytest.raises(ValueError, match="tolerance"):
        LevenbergMarquardt(tolerance=0.0)
