"""Single solves: certificates, outcomes of bad input, many starts, and derivatives of the solution."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.mpc import (
    CrossEntropy,
    Dogleg,
    GaussNewton,
    Outcome,
    PathIntegral,
    ProjectedGradient,
    TrustRegion,
    feasible_from,
    multi_start,
    random_starts,
    solve,
)
from mpc_cases import START, poses, problem, random_motion

STEPS = 3
EXACT = TrustRegion(max_iterations=60, tolerance=1e-12, inner_iterations=300, secant=True)
STILL = jnp.zeros((STEPS, 2, 3))
# None of the bounds active; the balls; the balls and the greatest distance.
REGIMES = {
    "inactive": {"target": "near", "radius": 1.0},
    "ball": {"target": "U", "radius": 0.05},
    "distance": {"target": "S", "start": poses(0.985, 0.4, 0.4), "radius": 0.03},
}


@functools.partial(jax.jit, static_argnums=0)
def solved(solver, case, guess=None):
    return solve(case, solver, jnp.zeros((STEPS, 2, 3)) if guess is None else guess)


@jax.jit
def certified(case, guess):
    solution = solve(case, EXACT, guess)
    return solution, solution.certificate()


@pytest.mark.parametrize("name", REGIMES)
def test_certificate_of_a_minimum_is_zero_and_of_another_plan_is_not(name):
    with jax.enable_x64(True):
        case = problem(**REGIMES[name])
        solution, certificate = certified(case, jnp.zeros((STEPS, 2, 3)))
        assert Outcome(int(solution.outcome)) is Outcome.CONVERGED
        assert solution.message.startswith("Converged")
        assert float(certificate.residual) < 1e-9 and float(certificate.violation) <= 1e-12
        assert int(certificate.active.sum()) == {"inactive": 0}.get(name, int(certificate.active.sum()))
        assert (int(certificate.active.sum()) > 0) == (name != "inactive")
        other = dataclasses.replace(solution, plan=dataclasses.replace(solution.plan, motion=0.5 * solution.motion))
        assert float(other.certificate().residual) > 1e-4


@pytest.mark.slow
def test_every_solver_with_derivatives_finds_the_same_minimum():
    with jax.enable_x64(True):
        case, guess = problem("U", radius=0.05), jnp.zeros((STEPS, 2, 3))
        best = float(certified(case, guess)[0].value)
        for solver in (
            Dogleg(max_iterations=60, tolerance=1e-9, inner_iterations=300, secant=True),
            GaussNewton(max_iterations=200, tolerance=1e-7, inner_iterations=300),
            ProjectedGradient(max_evaluations=400, tolerance=1e-7, memory=5),
        ):
            solution = solved(solver, case, guess)
            assert float(solution.value) == pytest.approx(best, rel=1e-7)
            assert float(solution.plan.optimality) <= 1e-7


@pytest.mark.slow
@pytest.mark.parametrize("solver", [CrossEntropy(), PathIntegral()])
def test_sampling_improves_on_the_guess_and_stays_inside(solver):
    case = problem("U")
    solution, best = solved(solver, case), solved(TrustRegion(max_iterations=8), case).value
    start = float(case.value(STILL))
    assert start - float(solution.value) > 0.6 * (start - float(best))
    assert float(case.feasible.violation(solution.motion)) == 0.0
    broken = solved(solver, problem("U", rate=float("nan")))
    assert Outcome(int(broken.outcome)) is Outcome.NONFINITE and np.isfinite(broken.motion).all()


# --- bad input: a code and a finite, feasible plan --------------------------------------------------------------------


def changed(case, **bounds):
    return dataclasses.replace(
        case, feasible=dataclasses.replace(case.feasible, **{k: jnp.asarray(v) for k, v in bounds.items()})
    )


FLAT = problem("U", rate=0.0, motion_weight=0.0)  # turning a gripper changes nothing, and costs nothing
BAD = {
    "contradicting distances": (changed(problem("U"), min_distance=1.2), TrustRegion(), Outcome.INFEASIBLE),
    "negative radius": (changed(problem("U"), radius=-0.01), TrustRegion(), Outcome.INFEASIBLE),
    "unknown distance": (changed(problem("U"), max_distance=float("nan")), TrustRegion(), Outcome.INFEASIBLE),
    "NaN from the model": (problem("U", rate=float("nan")), TrustRegion(), Outcome.NONFINITE),
    "NaN, gradient": (problem("U", rate=float("nan")), ProjectedGradient(), Outcome.NONFINITE),
    "zero trust region": (changed(problem("U"), radius=0.0), TrustRegion(), Outcome.NO_ROOM),
    "start outside": (changed(problem("U"), separation=[1.03, 0.0]), TrustRegion(), Outcome.OUTSIDE),
    "singular": (FLAT, GaussNewton(), Outcome.SINGULAR),
    "singular, damped": (FLAT, TrustRegion(max_iterations=20), Outcome.CONVERGED),
    "singular, dogleg": (FLAT, Dogleg(max_iterations=20), Outcome.CONVERGED),
}


SLOW = {"NaN, gradient", "singular, damped", "singular, dogleg"}


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in BAD])
def test_bad_input_gives_a_code_and_a_harmless_plan(name):
    case, solver, expected = BAD[name]
    solution = solved(solver, case)
    assert Outcome(int(solution.outcome)) is expected, solution.message
    assert len(solution.message) > 20
    assert np.isfinite(solution.motion).all()
    if expected in (Outcome.INFEASIBLE, Outcome.NO_ROOM, Outcome.NONFINITE):
        assert not np.asarray(solution.motion).any()
    else:
        assert float(case.feasible.violation(solution.motion)) <= 1e-6


def test_a_guess_that_is_outside_or_not_a_number_is_no_harm():
    case = problem("U")
    best = float(solved(TrustRegion(), case).value)
    for guess in (random_motion(0, STEPS, size=1.0), STILL.at[0].set(jnp.nan)):
        solution = solved(TrustRegion(), case, guess)
        assert float(solution.value) == pytest.approx(best, rel=0.05)
        assert float(case.feasible.violation(solution.motion)) == 0.0


@pytest.mark.slow
def test_workspace_and_change_of_motion_are_kept():
    case = problem("U")
    pose, previous = jnp.asarray(START), jnp.full((2, 3), 0.01)
    bounds = {"workspace": ((-1.0, -0.02), (1.0, 0.03)), "change": 0.015, "previous": previous}
    case = dataclasses.replace(case, feasible=feasible_from(pose, 0.05, (0.15, 0.99), **bounds))
    solution = solved(TrustRegion(max_iterations=6), case)
    motion = np.asarray(solution.motion)
    assert float(solution.value) < float(case.value(case.feasible.project(STILL)))
    change = np.linalg.norm(np.diff(motion, axis=0, prepend=previous[None]), axis=-1)
    assert change.max() <= 0.015 + 1e-6 and change.max() > 0.0149
    position = np.asarray(pose)[:, :2] + np.cumsum(motion[..., :2], axis=0)
    assert position[..., 1].min() >= -0.02 - 1e-7 and position[..., 1].max() <= 0.03 + 1e-7


@pytest.mark.slow
def test_many_starts_give_the_best_of_them():
    case = problem("S")
    starts = random_starts(case, STEPS, 4)
    assert float(jax.vmap(case.feasible.violation)(starts).max()) == 0.0
    assert float(jnp.abs(starts).max()) > 0.01
    best, every = jax.jit(lambda case: multi_start(case, TrustRegion(max_iterations=4), starts))(case)
    assert every.value.shape == (4,)
    assert float(best.value) == pytest.approx(float(every.value.min()), rel=1e-6)
    assert float(case.value(best.motion)) == pytest.approx(float(best.value), rel=1e-5)


# --- derivatives of the solution --------------------------------------------------------------------------------------


def varied(case, x):
    """A problem that depends on four numbers: the target, the history, the model's weight, the bound on a step."""
    return dataclasses.replace(
        case,
        target=case.target + jnp.array([1.0, 0.5]) * x[0],
        history=jax.tree.map(lambda leaf: leaf + 0.2 * x[1], case.history),
        weights=case.weights + x[2],
        feasible=dataclasses.replace(case.feasible, radius=case.feasible.radius * (1.0 + x[3])),
    )


@jax.jit
def motion_of(case, x):
    return solve(varied(case, x), EXACT, jnp.zeros((STEPS, 2, 3))).motion


forward_of = jax.jit(jax.jacfwd(motion_of, argnums=1))
backward_of = jax.jit(jax.grad(lambda case, cotangent, x: jnp.vdot(cotangent, motion_of(case, x)), argnums=2))


@pytest.mark.parametrize("name", REGIMES)
def test_derivatives_of_the_solution_are_those_of_solving_again(name):
    """Central differences of re-solves, in float64, in forward and in reverse mode."""
    with jax.enable_x64(True):
        case, x, step = problem(**REGIMES[name], motion_weight=0.02), jnp.zeros(4), 1e-5
        forward, cotangent = forward_of(case, x), random_motion(1, STEPS, size=1.0)
        for k in range(4):
            move = x.at[k].set(step)
            expected = (motion_of(case, move) - motion_of(case, -move)) / (2 * step)
            np.testing.assert_allclose(forward[..., k], expected, atol=1e-6 * max(1.0, float(jnp.abs(expected).max())))
        backward = backward_of(case, cotangent, x)
        np.testing.assert_allclose(backward, jnp.tensordot(cotangent, forward, axes=3), atol=1e-8)
        if name == "ball":
            # Along the normal of an active ball the plan moves only as the radius does.
            motion = motion_of(case, x)
            radial = jnp.einsum("tqi,tqik->tqk", motion, forward) / 0.05
            full = jnp.linalg.norm(motion, axis=-1) > 0.05 * (1 - 1e-9)
            assert int(full.sum()) > 0
            np.testing.assert_allclose(radial[full][:, :3], 0.0, atol=1e-8)
            np.testing.assert_allclose(radial[full][:, 3], 0.05, atol=1e-8)


@pytest.mark.slow
def test_derivatives_in_float32_and_over_a_batch():
    case = problem("U")
    solver = TrustRegion(max_iterations=10, inner_iterations=60)

    def first_move(rate):
        return solve(dataclasses.replace(case, weights=rate), solver, STILL).motion[0].sum()

    slopes = jax.jit(jax.vmap(jax.grad(first_move)))(jnp.asarray([0.6, 0.8]))
    assert np.isfinite(slopes).all() and (np.abs(slopes) > 1e-5).all()
