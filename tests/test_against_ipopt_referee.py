"""IPOPT as the referee, on a small analytic cable: it agrees with ours, and its limits are those of the problem."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from against_ipopt.control_call import race, ratios
from against_ipopt.judge import comparable_seconds, kkt_residual, slopes_along
from against_ipopt.planning_problems import (
    CONFIG,
    PlanningCase,
    ProblemMaker,
    RecordingSolver,
    load_cases,
    other_radii,
    save_cases,
    smooth_model,
)
from against_ipopt.referee import Limits, RefereeConfig, referee
from against_ipopt.solver_path import PathFinder
from cablejax.bounded import BoundedLevenbergMarquardt, SpectralProjectedGradient, certify
from cablejax.cable import Cable
from cablejax.control.shaping import Model
from cablejax.mpc import MPC, SOLVERS
from cablejax.types import Measurement
from mpc_cases import START, at_rest, planning_case, problem, random_motion, relaxing_cable

pytest.importorskip("ipyopt")
STEPS = 3
NAMES = ("near", "U", "S")


def limits(case) -> Limits:
    feasible = case.feasible
    values = (float(feasible.radius), float(feasible.min_distance), float(feasible.max_distance))
    return Limits(np.asarray(feasible.separation, float), *values)


@pytest.fixture(scope="module")
def ours():
    return PathFinder(
        lambda motion, case: case.residuals(motion),
        BoundedLevenbergMarquardt(atol=1e-9),
        lambda motion, case: case.linearise(motion),
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_ours_and_the_referees_agree(ours, name):
    with jax.enable_x64(True):
        case, start = problem(name), np.zeros((STEPS, 2, 3))
        bounds = limits(case)
        path = ours(case, case.feasible, start, 40)
        assert path.converged and bounds.violation(path.points[-1]) <= 1e-9
        assert kkt_residual(case, path.points[-1]) < 1e-6
        found = referee(case, bounds, start)
        assert found.found and found.violation <= 1e-8 and found.evaluations[2] == 0
        assert path.objectives[-1] <= found.objective * (1 + 1e-6)
        assert found.objective <= path.objectives[-1] * (1 + 1e-6)
        assert found.seconds_to(found.objective * (1 + 1e-6)) <= found.seconds


def test_slopes_and_residuals_are_those_of_the_objective():
    with jax.enable_x64(True):
        case, rng = problem("U"), np.random.default_rng(0)
        motion = np.asarray(case.feasible.project(random_motion(0, STEPS)))
        along = slopes_along(case, motion, rng, reach=1e-4, points=3)
        direction = np.random.default_rng(0).normal(size=motion.shape)
        direction /= np.linalg.norm(direction)
        ends = [float(case.value(jnp.asarray(motion + t * direction))) for t in (-1e-4, 1e-4)]
        assert along[1] == pytest.approx((ends[1] - ends[0]) / 2e-4, rel=1e-4)
        plain = jax.jit(lambda case, motion: certify(jax.grad(case.value)(motion), case.feasible, motion).residual)
        assert kkt_residual(case, motion) == pytest.approx(float(plain(case, jnp.asarray(motion))), rel=1e-9)


def test_seconds_are_compared_where_objectives_are_equal():
    def row(objective, ours, theirs):
        return {
            "objective": objective,
            "limited": {"objective": 1.0, "seconds_to_both": theirs, "ours_seconds_to_both": ours},
        }

    # equal; another minimum; a start as good as the end; IPOPT without a feasible plan as good
    rows = [row(1.0 + 1e-8, 2.0, 6.0), row(1.1, 1.0, 1.0), row(1.0, 0.0, 3.0), row(1.0, 1.0, np.inf)]
    for equal, expected in ((1e-6, ([2.0], [6.0])), (np.inf, ([2.0, 1.0], [6.0, 1.0]))):
        mine, theirs = comparable_seconds(rows, "limited", equal)
        assert (mine.tolist(), theirs.tolist()) == expected
    assert comparable_seconds(rows, "exact")[0].size == 0


def test_only_networks_have_corners_to_round():
    with pytest.raises(ValueError, match="nothing to round"):
        smooth_model(Model("analytic", None, relaxing_cable, None, Cable()))  # pyright: ignore[reportArgumentType]


@pytest.mark.slow
def test_the_exact_hessian_leads_to_the_same_plan_in_fewer_iterations():
    with jax.enable_x64(True):
        case, start = problem("S"), np.zeros((STEPS, 2, 3))
        approximate, exact = (referee(case, limits(case), start, RefereeConfig(exact=flag)) for flag in (False, True))
        assert exact.found and exact.evaluations[2] > 0 and exact.iterations < approximate.iterations
        assert exact.objective == pytest.approx(approximate.objective, rel=1e-8)
        np.testing.assert_allclose(exact.motion, approximate.motion, atol=1e-5)


def test_the_referee_stops_in_time():
    with jax.enable_x64(True):
        case = problem("U")
        found = referee(case, limits(case), np.zeros((STEPS, 2, 3)), RefereeConfig(max_seconds=0.0))
        assert not found.found and found.iterations == 1
        assert found.seconds_to(0.0) == np.inf


@pytest.mark.slow
def test_a_control_calls_solver_is_timed_beside_the_referee_in_single_precision():
    case = planning_case()
    make = ProblemMaker(Model("analytic", None, relaxing_cable, jnp.asarray(0.8), Cable()), np.float32)  # pyright: ignore[reportArgumentType]
    one = {"two-trials": SOLVERS["two-trials"]}
    row = race(make, case, one)
    ours, theirs = row["two-trials"], row["ipopt"]
    assert theirs["objective"] < row["start"] and ours["objective"] < 0.9 * row["start"]
    assert ours["ipopt_seconds"] is None or 0 < ours["ipopt_seconds"] <= theirs["seconds"]
    row["two-trials"] |= {"seconds": 2.0, "ipopt_seconds": 6.0}
    never = {**row, "two-trials": {**ours, "ipopt_seconds": None}}
    useless = {**row, "two-trials": {**ours, "objective": row["start"]}}
    assert ratios([row, never, useless], "two-trials").tolist() == [3.0, np.inf]


def test_limits_measure_what_the_feasible_set_measures():
    """Two independent statements of the same bounds."""
    with jax.enable_x64(True):
        case = problem("U")
        bounds = limits(case)
        for seed in range(5):
            motion = random_motion(seed, STEPS, size=0.03)
            assert bounds.violation(np.asarray(motion)) == pytest.approx(
                float(case.feasible.violation(motion)), abs=1e-12
            )
            inside = case.feasible.project(motion)
            assert bounds.violation(np.asarray(inside)) <= 1e-9


def test_a_path_never_gets_worse_and_ends_where_the_solver_does():
    """The non-monotone search accepts worse points; what counts is the best so far."""
    with jax.enable_x64(True):
        case = problem("S")
        find = PathFinder(lambda motion, case: case.value(motion), SpectralProjectedGradient(atol=1e-7))
        path = find(case, case.feasible, np.zeros((STEPS, 2, 3)), 300)
        assert path.converged and (np.diff(path.objectives) <= 0).all() and (np.diff(path.seconds) > 0).all()
        assert path.points.shape == (len(path.seconds), STEPS, 2, 3)
        assert float(case.value(jnp.asarray(path.points[-1]))) == pytest.approx(path.objectives[-1], rel=1e-12)
        assert path.seconds_to(path.objectives[-1]) <= path.seconds[-1] and path.seconds_to(0.0) == np.inf


def test_cases_survive_their_file(tmp_path):
    cases = [planning_case("one"), planning_case("two", radius=0.01)]
    save_cases(tmp_path / "folder" / "cases.npz", cases)
    for before, after in zip(cases, load_cases(tmp_path / "folder" / "cases.npz"), strict=True):
        for field in dataclasses.fields(PlanningCase):
            np.testing.assert_array_equal(getattr(before, field.name), getattr(after, field.name))


def test_other_radii_are_the_controllers():
    cases = other_radii([planning_case(str(i)) for i in range(50)], seed=3)
    radii = np.array([case.radius for case in cases])
    assert (radii >= CONFIG.radius_min).all() and (radii <= CONFIG.radius_max).all() and np.ptp(np.log(radii)) > 1
    assert all(case.name.endswith("another radius") for case in cases)
    assert cases[0].limits().radius == cases[0].radius
    assert cases[0].limits().max_distance == pytest.approx(0.99)


@pytest.mark.slow
def test_the_recorder_takes_down_what_the_controller_asks():
    case = planning_case()
    log = RecordingSolver(CONFIG.solver)
    config = dataclasses.replace(CONFIG, solver=log, horizon=STEPS - 1)
    controller = MPC(config, relaxing_cable, jnp.asarray(0.8), case.target)
    state = controller.init(at_rest(START))
    seen = []
    for _ in range(2):
        keypoints, pose = np.asarray(state.history.keypoints[-1]), np.asarray(state.history.gripper_pose)
        state, _, info = controller.step(state, Measurement(keypoints, pose))
        seen.append((keypoints, pose, float(info.radius)))
    jax.effects_barrier()
    assert len(log.met) == 2
    for met, (keypoints, pose, radius) in zip(log.met, seen, strict=True):
        np.testing.assert_allclose(met.keypoints[-1], keypoints, atol=1e-7)
        np.testing.assert_allclose(met.gripper_pose, pose, atol=1e-7)
        np.testing.assert_allclose(met.target, case.target, atol=1e-7)
        assert met.guess.shape == (STEPS, 2, 3) and met.radius == pytest.approx(radius)
