"""Single plans: certificates, all bounds, bad input, two trials, sampling, and derivatives of the plan."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from against_ipopt.accurate import Accurate
from cablejax.bounded import Result
from cablejax.mpc import (
    SOLVERS,
    CrossEntropy,
    LevenbergMarquardt,
    PathIntegral,
    ShapingProblem,
    differentiable_plan,
    feasible_from,
)
from cablejax.mpc.sampling import Valued, sampled_plan, towards_the_best
from mpc_cases import START, poses, problem

STEPS = 3
EXACT = Accurate(tolerance=1e-12)
STILL = np.zeros((STEPS, 2, 3))
# None of the bounds active; the balls; the balls and the greatest distance.
REGIMES = {
    "inactive": {"target": "near", "radius": 1.0},
    "ball": {"target": "U", "radius": 0.05},
    "distance": {"target": "S", "start": poses(0.985, 0.4, 0.4), "radius": 0.03},
}


@functools.partial(jax.jit, static_argnums=0)
def solved_from(solver, case, start):
    plan = solver(case, case.start(start))
    return plan, case.value(plan.motion), case.feasible.violation(plan.motion)


def solved(solver, case, start=STILL):
    return solved_from(solver, case, jnp.asarray(start, case.target.dtype))


certified = jax.jit(lambda plan, case: plan.certificate(case))
value_at = jax.jit(ShapingProblem.value)
moved = jax.jit(
    lambda case, x: dataclasses.replace(
        case,
        target=case.target + jnp.array([1.0, 0.5]) * x[0],
        weights=case.weights + x[1],
        feasible=dataclasses.replace(case.feasible, radius=case.feasible.radius * (1.0 + x[2])),
    )
)
slopes = jax.jit(jax.jacfwd(lambda case, motion, x: differentiable_plan(moved(case, x), motion), argnums=2))


@pytest.mark.slow
@pytest.mark.parametrize("name", REGIMES)
def test_plan_is_a_minimum_and_its_derivatives_are_those_of_planning_again(name):
    """KKT residuals, then central differences of re-solves, in float64.

    Values tell plans apart by 1e-10 m only, which differences divide by twice their step.
    """
    with jax.enable_x64(True):
        case, step = problem(**REGIMES[name], motion_weight=0.02), 5e-5
        plan, _, violation = solved(EXACT, case)
        assert Result(int(plan.result)) in (Result.CONVERGED, Result.STALLED) and float(violation) == 0.0
        certificate = certified(plan, case)
        assert float(certificate.residual) < 1e-8
        n_active = int((certificate.multipliers > 1e-6).sum())
        assert (n_active > 0) == (name != "inactive")
        half = dataclasses.replace(plan, motion=0.5 * plan.motion)
        assert float(certified(half, case).residual) > 1e-4
        forward = slopes(case, plan.motion, jnp.zeros(3))
        for k in range(3):
            move = jnp.zeros(3).at[k].set(step)
            ahead, behind = solved(EXACT, moved(case, move))[0].motion, solved(EXACT, moved(case, -move))[0].motion
            expected = (ahead - behind) / (2 * step)
            np.testing.assert_allclose(forward[..., k], expected, atol=3e-6 * max(1.0, float(jnp.abs(expected).max())))


@pytest.mark.slow
def test_a_plan_of_two_trials_is_feasible_most_of_the_way_and_one_linearisation():
    case = problem("U")
    plan, value, violation = solved(SOLVERS["two-trials"], case)
    better = STILL
    for _ in range(4):
        better = solved(LevenbergMarquardt(), case, better)[0].motion
    best = float(value_at(case, better))
    start = float(value_at(case, jnp.asarray(STILL)))
    assert float(violation) == 0.0 and int(plan.linearisations) == 1
    assert start - float(value) > 0.9 * (start - best)
    assert float(plan.value) == pytest.approx(float(value), rel=1e-6)


@pytest.mark.slow
def test_workspace_and_change_of_motion_are_kept():
    pose, previous = jnp.asarray(START), jnp.full((2, 3), 0.01)
    bounds = {"workspace": ((-1.0, -0.02), (1.0, 0.03)), "change": 0.015, "previous": previous}
    case = dataclasses.replace(problem("U"), feasible=feasible_from(pose, 0.05, (0.15, 0.99), **bounds))
    plan, value, violation = solved(LevenbergMarquardt(max_iterations=2), case)
    motion = np.asarray(plan.motion)
    assert float(violation) <= 1e-7
    assert float(value) < float(value_at(case, jnp.asarray(STILL)))
    change = np.linalg.norm(np.diff(motion, axis=0, prepend=previous[None]), axis=-1)
    assert 0.0149 < change.max() <= 0.015 + 1e-7
    position = np.asarray(pose)[:, :2] + np.cumsum(motion[..., :2], axis=0)
    assert position[..., 1].min() >= -0.02 - 1e-7 and position[..., 1].max() <= 0.03 + 1e-7
    assert float(case.feasible.constraints(plan.motion).max()) <= 1e-6


def with_bounds(**bounds):
    case = problem("U")
    changed = {name: jnp.asarray(value, jnp.float32) for name, value in bounds.items()}
    return dataclasses.replace(case, feasible=dataclasses.replace(case.feasible, **changed))


BAD = {
    "contradicting distances": (lambda: with_bounds(min_distance=1.2), {Result.EMPTY_SET}),
    "negative radius": (lambda: with_bounds(radius=-0.01), {Result.EMPTY_SET}),
    "unknown radius": (lambda: with_bounds(radius=float("nan")), {Result.EMPTY_SET}),
    "NaN from the model": (lambda: problem("U", rate=float("nan")), {Result.NONFINITE}),
    "zero radius": (lambda: with_bounds(radius=0.0), {Result.CONVERGED, Result.STALLED, Result.STEP_LIMIT}),
    "singular": (lambda: problem("U", rate=0.0), set(Result)),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_gives_a_code(name):
    make, expected = BAD[name]
    plan, _, _ = solved(LevenbergMarquardt(), make())
    result = Result(int(plan.result))
    assert result in expected and len(result.message) > 20
    if result is not Result.EMPTY_SET:
        assert np.isfinite(plan.motion).all()


@pytest.mark.slow
@pytest.mark.parametrize("solver", [CrossEntropy(), PathIntegral()])
def test_sampling_improves_on_the_guess_and_stays_inside(solver):
    case = problem("U")
    start, best = float(case.value(jnp.asarray(STILL))), float(solved(LevenbergMarquardt(max_iterations=2), case)[1])
    _, value, violation = solved(solver, case)
    assert float(violation) == 0.0
    assert start - float(value) > 0.5 * (start - best)
    plan, _, _ = solved(solver, problem("U", rate=float("nan")))
    assert Result(int(plan.result)) is Result.NONFINITE and np.isfinite(plan.motion).all()


@pytest.mark.slow
@pytest.mark.parametrize("solver", [CrossEntropy(samples=16, iterations=3), PathIntegral(samples=16, iterations=3)])
def test_sampling_knows_the_way_back_from_outside(solver):
    """Grippers beyond the workspace: every bound closes in on them, and no plan may break it."""
    workspace = {"workspace": ((0.1, 0.2), (0.8, 1.0))}
    case = dataclasses.replace(
        problem("U"), feasible=feasible_from(jnp.asarray(START), 0.05, (0.15, 0.99), **workspace)
    )
    plan, value, violation = solved(solver, case)
    assert float(violation) <= 1e-7 and Result(int(plan.result)) is Result.STEP_LIMIT
    assert float(value) <= float(value_at(case, case.start(jnp.asarray(STILL)).motion))
    plan, _, _ = solved(solver, with_bounds(min_distance=1.2))
    assert Result(int(plan.result)) is Result.EMPTY_SET


@pytest.mark.parametrize("known", [0, 2, 8, 16])
def test_the_cross_entropy_method_takes_no_plan_without_a_value_for_one_of_the_best(known):
    """With fewer good samples than elites, those at which the model gives NaN moved the mean as much as the best."""
    with jax.enable_x64(True):
        motion = jnp.asarray(np.random.default_rng(0).normal(size=(16, 3, 2, 3)), jnp.float32)
        value = jnp.where(jnp.arange(16) < known, jnp.arange(16.0), jnp.inf)
        old, spread = jnp.full((3, 2, 3), 5.0, jnp.float32), jnp.full((3, 2, 3), 2.0, jnp.float32)
        mean, deviation = towards_the_best(old, spread, Valued(motion, value))
        assert mean.dtype == deviation.dtype == jnp.float32
        best = motion[: min(known, 8)]
        if known == 0:
            np.testing.assert_array_equal(mean, old)
            np.testing.assert_array_equal(deviation, spread)
        else:
            np.testing.assert_allclose(mean, 0.1 * old + 0.9 * best.mean(axis=0), rtol=1e-5)
            np.testing.assert_allclose(deviation, 0.1 * spread + 0.9 * best.std(axis=0), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("size", "expected"), [(1.5, Result.EMPTY_SET), (1.0, Result.STEP_LIMIT)])
def test_what_sampling_counts_as_broken_is_relative_to_the_bound(size, expected):
    """A plan a tenth of a millimetre beyond a bound of two tenths, and one on it."""
    case, motion = with_bounds(radius=2e-4), jnp.zeros_like(STILL, jnp.float32).at[0, 0, 0].set(2e-4 * size)
    plan = sampled_plan(case, Valued(motion, jnp.asarray(1.0)), 1)
    assert Result(int(plan.result)) is expected
