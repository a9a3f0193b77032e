"""The bounded solvers on problems with known minima, their result codes, certificates and derivatives."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from cablejax.bounded import (
    Balls,
    BoundedDogleg,
    BoundedGaussNewton,
    BoundedLevenbergMarquardt,
    BoundedQuasiNewton,
    Box,
    Halfspaces,
    Intersection,
    Result,
    SpectralProjectedGradient,
    certify,
    least_squares,
    minimise,
)
from cablejax.bounded.certificate import projected_gradient_size
from cablejax.bounded.implicit import with_derivatives

SOLVERS = {
    "Levenberg-Marquardt": BoundedLevenbergMarquardt(atol=1e-9),
    "dogleg": BoundedDogleg(atol=1e-9),
    "Gauss-Newton": BoundedGaussNewton(atol=1e-9),
    "Levenberg-Marquardt, updated": BoundedLevenbergMarquardt(atol=1e-9, trials_per_linearisation=3),
    "dogleg, updated": BoundedDogleg(atol=1e-9, trials_per_linearisation=3),
    "Gauss-Newton, updated": BoundedGaussNewton(atol=1e-9, trials_per_linearisation=3),
    "spectral": SpectralProjectedGradient(atol=1e-9),
    "quasi-Newton": BoundedQuasiNewton(atol=1e-9),
}


def rosenbrock(y, args):
    return jnp.stack([10.0 * (y[1] - y[0] ** 2), args - y[0]])


@functools.partial(jax.jit, static_argnums=(0, 1))
def solve(fn, solver, start, feasible, args):
    solution = least_squares(fn, SOLVERS[solver], start, feasible, args, max_steps=500)
    return solution, solution.certificate(fn, feasible, args)


# Lower and upper bounds, the minimum, and its value; from the Karush-Kuhn-Tucker conditions by hand.
BOXES = {
    "inactive": ([-2.0, -2.0], [2.0, 2.0], [1.0, 1.0], 0.0),
    "one active": ([-1.5, -1.5], [0.8, 1.5], [0.8, 0.64], 0.02),
    "start outside": ([1.5, -3.0], [4.0, 3.0], [1.5, 2.25], 0.125),
    "corner": ([1.5, -3.0], [4.0, 1.0], [1.5, 1.0], 0.5 * (12.5**2 + 0.5**2)),
    "fixed": ([0.5, -3.0], [0.5, 3.0], [0.5, 0.25], 0.125),
}


@pytest.mark.parametrize(
    ("solver", "steps"), [*((name, 500) for name in SOLVERS), ("Levenberg-Marquardt, updated", 3), ("quasi-Newton", 3)]
)
def test_what_a_function_gives_beside_its_value_is_that_at_the_solution(solver, steps):
    """Through optimistix's own entry points, also where trials are rejected on the way and where steps run out."""

    of_squares = isinstance(SOLVERS[solver], optx.AbstractLeastSquaresSolver)

    def with_aux(y, args):
        residuals = rosenbrock(y, args)
        value = residuals if of_squares else 0.5 * residuals @ residuals
        return value, {"point": y, "residuals": residuals}

    @jax.jit
    def solve_with_aux(start):
        entry = optx.least_squares if of_squares else optx.minimise
        options = {"feasible": Box(jnp.array([-1.5, -1.5]), jnp.array([0.8, 1.5]))}
        found = entry(with_aux, SOLVERS[solver], start, 1.0, options, has_aux=True, max_steps=steps, throw=False)
        return found.value, found.aux, with_aux(found.value, 1.0)[1]

    value, aux, expected = solve_with_aux(jnp.array([-1.2, 1.0]))
    np.testing.assert_array_equal(aux["point"], value)
    np.testing.assert_allclose(aux["residuals"], expected["residuals"], rtol=1e-5, atol=1e-6)
    if steps == 500:
        np.testing.assert_allclose(value, [0.8, 0.64], atol=2e-6)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("name", BOXES)
def test_reaches_the_minimum_of_rosenbrock_in_a_box(solver, name):
    lower, upper, minimum, value = BOXES[name]
    with jax.enable_x64(True):
        feasible = Box(jnp.asarray(lower), jnp.asarray(upper))
        solution, certificate = solve(rosenbrock, solver, jnp.asarray([-1.2, 1.0]), feasible, jnp.asarray(1.0))
        assert Result(int(solution.result)) is Result.CONVERGED
        np.testing.assert_allclose(solution.value, minimum, atol=1e-6)
        assert float(solution.objective) == pytest.approx(value, abs=1e-9)
        assert float(feasible.violation(solution.value)) == 0.0
        assert float(certificate.residual) < 1e-7 and float(certificate.multipliers.min()) >= 0.0
        assert 0 < int(solution.stats.linearisations) <= int(solution.stats.iterations) <= 500


def test_certificate_tells_a_minimum_from_other_points():
    with jax.enable_x64(True):
        feasible = Intersection((Balls(jnp.asarray(1.0)), Halfspaces(jnp.asarray([[1.0, 1.0]]), jnp.asarray([0.5]))))
        # pulled along (1, 0): the ball and the plane meet at a corner with both multipliers positive
        x = (0.5 + np.sqrt(2 - 0.25)) / 2
        corner = jnp.asarray([x, 0.5 - x])
        certified = jax.jit(certify)
        slope, other = jnp.asarray([-2.0, 0.0]), jnp.asarray([0.0, 1.0])
        certificate = certified(slope, feasible, corner)
        assert float(certificate.residual) < 1e-12
        assert certificate.multipliers.shape == (2,) and float(certificate.multipliers.min()) > 0.1
        assert float(projected_gradient_size(feasible, corner, slope)) < 1e-9
        assert float(certified(other, feasible, corner).stationarity) > 0.1
        assert float(projected_gradient_size(feasible, corner, other)) > 0.1
        outside = certified(jnp.asarray([-2.0, 0.0]), feasible, 1.1 * corner)
        assert float(outside.feasibility) > 0.01


# --- bad input --------------------------------------------------------------------------------------------------------

UNIT = np.array([-1.0, -1.0]), np.array([1.0, 1.0])


def itself(y, _):
    """Its minimum is 0. One function for all, so that what it needs is compiled once."""
    return y


def ended(fn, solver, start=(0.5, 0.5), bounds=UNIT):
    feasible = Box(jnp.asarray(bounds[0]), jnp.asarray(bounds[1]))
    solution = least_squares(fn, SOLVERS[solver], jnp.asarray(start), feasible, max_steps=100, throw=False)
    return Result(int(solution.result)), np.asarray(solution.value)


@pytest.mark.parametrize("solver", ["Levenberg-Marquardt", pytest.param("spectral", marks=pytest.mark.slow)])
def test_a_function_that_is_not_a_number_ends_the_solve_with_a_feasible_point(solver):
    with jax.enable_x64(True):
        result, value = ended(lambda y, _: y * jnp.nan, solver)
        assert result is Result.NONFINITE
        np.testing.assert_array_equal(value, [0.5, 0.5])
        # NaN on the way only: beyond y = 0.2, short of the minimum at 0
        result, value = ended(lambda y, _: jnp.where(y < 0.2, jnp.nan, y), solver)
        assert result in (Result.NONFINITE, Result.STEP_LIMIT)
        assert np.isfinite(value).all() and (value >= 0.2).all() and (value < 0.5).all()
        assert ended(itself, solver, start=(np.nan, 0.5))[0] is Result.NONFINITE


def test_where_there_is_a_value_but_no_gradient_is_no_place_to_go_on_from():
    """The slope of `0 sqrt(max(y - 0.4, 0))` is NaN below 0.4, on the way to the minimum at 0.3."""

    def half_known(y, _):
        return 0.5 * jnp.sum((y - 0.3) ** 2) + 0.0 * jnp.sum(jnp.sqrt(jnp.maximum(y - 0.4, 0.0)))

    with jax.enable_x64(True):
        box, start = Box(jnp.full(2, -2.0), jnp.full(2, 2.0)), jnp.asarray([1.5, 1.8])
        found = minimise(half_known, SOLVERS["quasi-Newton"], start, box, throw=False)
        assert Result(int(found.result)) is Result.NONFINITE and int(found.stats.iterations) < 500
        assert (found.value >= 0.4).all() and float(found.objective) < 0.02


def test_the_spectral_gradient_returns_the_point_that_it_says_is_a_minimum():
    """Not one with a value lower by rounding, met before, whose projected gradient is far above the tolerance."""
    solver = SpectralProjectedGradient(atol=1e-8, memory=1)

    def bowl(y, args):
        matrix, centre = args
        return 1e4 + 0.5 * (y - centre) @ matrix @ (y - centre)

    @jax.jit
    @jax.vmap
    def solve_all(matrix, centre):
        box = Box(jnp.full(8, -2.0), jnp.full(8, 2.0))
        found = minimise(bowl, solver, jnp.ones(8), box, (matrix, centre), throw=False)
        size = projected_gradient_size(box, found.value, jax.grad(bowl)(found.value, (matrix, centre)))
        return found.result, size, found.objective - bowl(found.value, (matrix, centre))

    with jax.enable_x64(True):
        rng = np.random.default_rng(0)
        turns = np.linalg.qr(rng.normal(size=(20, 8, 8)))[0]
        matrices = turns @ np.diag(np.logspace(0, 3, 8)) @ turns.swapaxes(1, 2)
        result, size, missed = solve_all(matrices, rng.normal(size=(20, 8)))
        assert (result == Result.CONVERGED).sum() >= 15
        assert float(jnp.where(result == Result.CONVERGED, size, 0.0).max()) <= 1e-8
        np.testing.assert_allclose(missed, 0.0, atol=1e-10)


def test_bounds_that_a_point_keeps_by_rounding_are_active():
    """A kilometre from zero, float32 has steps of 0.06 mm: a certificate has to allow for them."""
    start, plane = jnp.asarray([1e3, 0.0]), Halfspaces(jnp.asarray([[1.0, 0.0]]), jnp.asarray([1e3 * (1 + 1e-6)]))
    slope = jnp.asarray([-1.0, 0.0])
    by_default, strict = jax.jit(lambda y: (certify(slope, plane, y), certify(slope, plane, y, near=1e-6)))(start)
    assert float(by_default.stationarity) < 1e-6 and float(strict.stationarity) == 1.0


@pytest.mark.parametrize("solver", [s if s == "dogleg" else pytest.param(s, marks=pytest.mark.slow) for s in SOLVERS])
def test_a_singular_jacobian_does_no_harm(solver):
    with jax.enable_x64(True):
        result, value = ended(lambda y, _: jnp.stack([y.sum() - 0.4, 2 * y.sum() - 0.8]), solver)
        assert result is Result.CONVERGED
        assert value.sum() == pytest.approx(0.4, abs=1e-8)


def test_an_empty_set_is_distinguished_from_a_point_set():
    with jax.enable_x64(True):
        for bounds in ((UNIT[1], UNIT[0]), (UNIT[0], UNIT[1] * np.nan)):
            assert ended(itself, "Levenberg-Marquardt", bounds=bounds)[0] is Result.EMPTY_SET
        result, value = ended(itself, "Levenberg-Marquardt", bounds=(UNIT[1], UNIT[1]))
        assert result is Result.CONVERGED
        np.testing.assert_array_equal(value, UNIT[1])
        apart = Intersection((Box(*map(jnp.asarray, UNIT)), Halfspaces(jnp.ones((1, 2)), jnp.asarray([-3.0]))))
        out = least_squares(itself, SOLVERS["dogleg"], jnp.zeros(2), apart, max_steps=5, throw=False)
        assert Result(int(out.result)) is Result.EMPTY_SET


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_what_counts_as_empty_is_relative_to_the_bounds(size):
    """A box up to `size` and a plane beyond it or through it, in float32; a third coordinate may go far."""
    box = Box(jnp.zeros(3), size * jnp.asarray([1.0, 1.0, 100.0]))
    for room, empty in ((-1e-2, True), (0.0, False), (1e-2, False)):
        beyond = Halfspaces(jnp.asarray([[-1.0, 0.0, 0.0]]), -size * jnp.asarray([1.0 - room]))
        both, start = Intersection((box, beyond)), size * jnp.asarray([0.0, 0.0, 0.5])
        found = least_squares(itself, BoundedLevenbergMarquardt(), start, both, max_steps=20, throw=False)
        assert (Result(int(found.result)) is Result.EMPTY_SET) == empty


def test_a_zero_radius_holds_the_point():
    with jax.enable_x64(True):
        solver, zero = SOLVERS["Levenberg-Marquardt"], Balls(jnp.asarray(0.0))
        solution = least_squares(lambda y, _: y.ravel() - 1.0, solver, jnp.ones((2, 3)), zero, throw=False)
        np.testing.assert_allclose(solution.value, 0.0, atol=1e-12)
        assert Result(int(solution.result)) in (Result.CONVERGED, Result.STALLED)


def test_outside_compiled_code_failures_are_raised_with_what_to_do():
    with jax.enable_x64(True):
        box = Box(*map(jnp.asarray, UNIT))
        solver = SOLVERS["spectral"]
        with pytest.raises(RuntimeError, match="raise max_steps"):
            minimise(lambda y, _: jnp.sum((y - 0.3) ** 4), solver, jnp.ones(2), box, max_steps=2)
        with pytest.raises(ValueError, match="no feasible point"):
            minimise(lambda y, _: jnp.sum(y**2), solver, jnp.ones(2), Box(box.upper, box.lower))
        assert all(result.message for result in Result)


@pytest.mark.parametrize("name", SOLVERS)
def test_whole_numbers_are_points_too(name):
    box = Box(jnp.array([0, 0]), jnp.array([3, 3]))
    solution = least_squares(lambda y, _: y - 0.7, SOLVERS[name], jnp.array([0, 2]), box)
    np.testing.assert_allclose(solution.value, 0.7, atol=1e-6)


def test_balls_about_whole_numbers():
    np.testing.assert_allclose(Balls(jnp.asarray(0.5)).project(jnp.array([[3, 4]])), [[0.3, 0.4]])


def test_a_start_without_a_value_has_no_optimality():
    start = jnp.array([0.5, 0.5])
    for solver in (SOLVERS["quasi-Newton"], SpectralProjectedGradient()):
        solution = minimise(lambda y, _: jnp.sum(y) * jnp.nan, solver, start, Box(*map(jnp.asarray, UNIT)), throw=False)
        assert Result(int(solution.result)) is Result.NONFINITE and not float(solution.optimality) < 1e-3


def test_projected_gradient_points_break_no_bound_by_rounding():
    """The function has no value there: y + (P(y - g) - y) is not P(y - g)."""
    upper = jnp.array([-0.9, -0.3, -0.7])
    box = Box(jnp.full(3, -jnp.inf), upper)
    seen = []

    def fn(y, _):
        jax.debug.callback(lambda excess: seen.append(float(excess)), (y - upper).max())
        return -jnp.sum(y)

    minimise(fn, SpectralProjectedGradient(), jnp.array([-2.0, -3.1, -4.3]), box)
    jax.effects_barrier()
    assert len(seen) > 1 and max(seen) <= 0.0


@pytest.mark.parametrize(
    ("start", "options", "message"),
    [
        (jnp.ones(2), {"feasible": None}, "feasible is None, expected a set"),
        ({"a": 1.0}, {}, "expected an array of one number or more"),
        (jnp.zeros(0), {}, "expected an array of one number or more"),
        (jnp.zeros(3), {}, r"y0 of shape \(3,\) does not fit the set Box"),
        (jnp.ones(2), {"max_steps": 0}, "max_steps is 0"),
        (jnp.ones(2), {"solver": BoundedQuasiNewton(atol=-1.0)}, "BoundedQuasiNewton: atol is -1.0"),
        (jnp.ones(2), {"solver": BoundedLevenbergMarquardt(rtol=float("nan"))}, "rtol is nan"),
        (jnp.ones(2), {"solver": "lm"}, "The solver is 'lm'. Expected one of `cablejax.bounded`"),
        (jnp.ones(2), {"solver": optx.BFGS(1e-6, 1e-6)}, r"BFGS reports no .*objective.* Expected one of `cablejax\."),
    ],
)
def test_what_no_solver_can_work_with_is_refused(start, options, message):
    options = {"solver": SOLVERS["quasi-Newton"], "feasible": Box(*map(jnp.asarray, UNIT)), **options}
    with pytest.raises(ValueError, match=message):
        minimise(lambda y, _: jnp.sum(y**2), y0=start, **options)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SpectralProjectedGradient(memory=0), "memory is 0, expected a whole number of at least 1"),
        (lambda: SpectralProjectedGradient(memory=2.5), "memory is 2.5, expected"),  # pyright: ignore[reportArgumentType]
        (lambda: BoundedDogleg(trials_per_linearisation=0), "BoundedDogleg: trials_per_linearisation is 0, expected"),
    ],
)
def test_solvers_that_would_try_nothing_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# --- derivatives of the solution --------------------------------------------------------------------------------------

# None active; a ball; a ball and a plane. Where a bound is touched with a zero multiplier there is no derivative.
REGIMES = {"inactive": 5.0, "ball": 0.5, "ball and plane": 0.5}


def curved(y, args):
    """Residuals that cannot all vanish, so that their own curvature counts."""
    return jnp.concatenate([jnp.sin(y).ravel() - 1.5 * args[:3], jnp.stack([y.sum() ** 2 - args[3], y[0] * y[1]])])


def regime(name, x):
    members = [Balls(REGIMES[name] * (1.0 + x[4]))]
    if name == "ball and plane":
        members.append(Halfspaces(jnp.asarray([[0.0, 0.0, 1.0]]), 0.3 + x[4:5]))
    return Intersection(tuple(members))


@functools.partial(jax.jit, static_argnums=0)
def minimum_of(name, x):
    """Where it is, and the objective there."""
    solver = BoundedLevenbergMarquardt(atol=1e-12)
    found = least_squares(curved, solver, jnp.full(3, 0.1), regime(name, x), X0[:4] + x[:4], max_steps=200)
    return jnp.append(found.value, found.objective)


@functools.partial(jax.jit, static_argnums=0)
def both_jacobians(name, x):
    """By forward and by reverse mode, about one solve, which is most of what has to be compiled."""
    _, forward = jax.linearize(functools.partial(minimum_of, name), x)
    backward = jax.vmap(jax.linear_transpose(forward, x))(jnp.eye(4))[0]
    return jax.vmap(forward, out_axes=1)(jnp.eye(5)), backward


X0 = np.array([0.5, 0.3, 0.6, 0.9, 0.0])


@pytest.mark.slow
@pytest.mark.parametrize("name", REGIMES)
def test_derivatives_of_the_solution_are_those_of_solving_again(name):
    """Central differences of re-solves in float64; reverse against forward mode."""
    with jax.enable_x64(True):
        x, step = jnp.zeros(5), 1e-5
        minimum = minimum_of(name, x)[:3]
        active = int((regime(name, x).constraints(minimum) > -1e-9).sum())
        assert active == {"inactive": 0, "ball": 1, "ball and plane": 2}[name]
        forward, backward = both_jacobians(name, x)
        for k in range(5):
            move = x.at[k].set(step)
            expected = (minimum_of(name, move) - minimum_of(name, -move)) / (2 * step)
            np.testing.assert_allclose(forward[:, k], expected, atol=2e-6)
        np.testing.assert_allclose(backward, forward, atol=1e-9)
        known = jax.jit(jax.jacfwd(lambda x: with_derivatives(minimum, curved, regime(name, x), X0[:4] + x[:4])))(x)
        np.testing.assert_allclose(known, forward[:3], atol=1e-7)
        assert np.abs(forward[3]).max() > 0.1


def test_functions_may_close_over_what_is_differentiated():
    def nearest(target):
        found = least_squares(
            *(lambda y, _: y - target, SOLVERS["Levenberg-Marquardt"], jnp.zeros(2), Box(*map(jnp.asarray, UNIT))),
            linearise=lambda y, _: (y - target, jnp.eye(2)),
        )
        return found.value

    with jax.enable_x64(True):
        slope = jax.jit(jax.jacrev(nearest))(jnp.asarray([0.3, 2.0]))
        np.testing.assert_allclose(slope, [[1.0, 0.0], [0.0, 0.0]], atol=1e-9)


def test_statistics_are_counts():
    with jax.enable_x64(True):
        box = Box(*map(jnp.asarray, UNIT))
        solution = least_squares(rosenbrock, SOLVERS["Gauss-Newton"], jnp.zeros(2), box, 0.5)
        for field in dataclasses.fields(solution.stats):
            assert int(getattr(solution.stats, field.name)) > 0


def test_what_does_not_converge_says_so_while_it_is_differentiated():
    def reached(centre):
        box = Box(jnp.full(2, -2.0), jnp.full(2, 2.0))
        return least_squares(rosenbrock, SOLVERS["dogleg"], jnp.asarray([-1.2, 1.0]), box, centre, max_steps=1).value

    with jax.enable_x64(True), pytest.raises(RuntimeError, match=Result.STEP_LIMIT.message):
        jax.jacfwd(reached)(1.0)


@pytest.mark.parametrize("trials", [2, 4])
def test_a_linearisation_lasts_for_as_many_trials_as_asked(trials):
    with jax.enable_x64(True):
        box = Box(jnp.full(2, -2.0), jnp.full(2, 2.0))
        solver = BoundedLevenbergMarquardt(atol=1e-9, trials_per_linearisation=trials)
        start = jnp.asarray([-1.2, 1.0])
        solution = least_squares(rosenbrock, solver, start, box, 1.0, max_steps=3, throw=False)
        assert int(solution.result) == Result.STEP_LIMIT
        assert int(solution.stats.linearisations) == 3 and int(solution.stats.evaluations) == 3 * trials
        value = float(0.5 * jnp.sum(rosenbrock(solution.value, 1.0) ** 2))
        assert float(solution.objective) == pytest.approx(value, rel=1e-12)


def test_updates_between_linearisations_gain_what_a_stale_jacobian_does_not():
    """Five more trials after the first, all from one linearisation."""
    with jax.enable_x64(True):
        box, start = Box(jnp.full(2, -2.0), jnp.full(2, 2.0)), jnp.asarray([-1.2, 1.0])
        values = {}
        for trials in (1, 6):
            solver = BoundedLevenbergMarquardt(atol=1e-12, trials_per_linearisation=trials)
            found = least_squares(rosenbrock, solver, start, box, 1.0, max_steps=1, throw=False)
            assert int(found.stats.linearisations) == 1
            values[trials] = float(found.objective)
        assert values[6] < 0.5 * values[1]
