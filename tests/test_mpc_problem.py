import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.mpc import ObjectiveConfig, ShapingProblem
from cablejax.mpc.target_pose import continued, target_pose, total_turn
from cablejax.types import History, advance
from mpc_cases import START, TARGETS, at_rest, feasible_set, hermite_shape, poses, problem, random_motion

# One program each: op by op, every line of the problem is compiled by itself.
rollout = jax.jit(ShapingProblem.rollout)
residuals_at = jax.jit(ShapingProblem.residuals)
value_at = jax.jit(ShapingProblem.value)
linearise = jax.jit(ShapingProblem.linearise)


def jacobian_at(case, motion):
    """By automatic differentiation of the whole rollout."""
    return jax.jit(jax.jacfwd(ShapingProblem.residuals, argnums=1))(case, motion).reshape(-1, motion.size)


def central_difference(f, x, tangent, step=1e-6):
    return (f(x + step * tangent) - f(x - step * tangent)) / (2 * step)


def test_rollout_is_the_model_applied_step_by_step():
    case = problem("U")
    motion = random_motion(0)
    history = case.history
    for step, twist in enumerate(case.objective.to_twist(motion)):
        history = advance(history, case.dynamics(case.weights, history, twist), twist)
        np.testing.assert_allclose(rollout(case, motion).shapes[step], history.keypoints[-1], atol=1e-6)


def test_objective_is_the_weighted_sum_of_squares():
    case = problem("S", terminal_weight=4.0, motion_weight=0.02)
    motion = random_motion(1)
    shapes = rollout(case, motion).shapes
    error = np.sum((shapes - case.target) ** 2, axis=(1, 2)) / case.target.shape[0]
    left = np.sum(np.asarray(residuals_at(case, motion)[-2:]) ** 2)  # a test of its own says what that is
    expected = 0.5 * (np.dot(error, [1, 1, 1, 4]) + 0.02 * np.sum(motion**2) + left)
    assert float(value_at(case, motion)) == pytest.approx(float(expected), rel=1e-5)
    shape_error = case.shape_error(shapes)
    np.testing.assert_allclose(shape_error**2, error, rtol=1e-5)


def test_motion_and_twist_are_inverse_and_a_rotation_counts_by_its_weight():
    objective = ObjectiveConfig(rotation_weight=0.15, interval=0.5)
    motion = random_motion(2)
    np.testing.assert_allclose(objective.to_motion(objective.to_twist(motion)), motion, rtol=1e-6)
    np.testing.assert_allclose(objective.to_twist(jnp.asarray([0.01, 0.02, 0.03])), [0.02, 0.04, 0.4], rtol=1e-6)


@pytest.mark.parametrize("n_steps", [1, 2, 5])
def test_structured_jacobian_is_the_jacobian(n_steps):
    case, motion = problem("U"), random_motion(3, n_steps)
    residuals, jacobian = linearise(case, motion)
    np.testing.assert_allclose(residuals, residuals_at(case, motion), atol=1e-6)
    np.testing.assert_allclose(jacobian, jacobian_at(case, motion), atol=2e-6)


def test_a_known_rollout_is_not_made_again():
    case, motion = problem("U"), random_motion(3, 2)
    own = rollout(case, motion)
    for a, b in zip(linearise(case, motion, own), linearise(case, motion), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
    # what is known is believed: nothing is rolled out
    shifted = dataclasses.replace(own, shapes=own.shapes + 1.0)
    np.testing.assert_array_equal(linearise(case, motion, shifted)[0], case.residuals_of(shifted))


def test_a_solver_begins_at_the_plan_that_was_rolled_out():
    """To the bit, also where bounds are active: what is known of the guess is not made again."""
    for target in TARGETS:
        case = problem(target, radius=0.05)
        guess = case.start(random_motion(5, 4, size=0.1))
        np.testing.assert_array_equal(case.feasible.project(guess.motion), guess.motion)


@pytest.mark.parametrize("name", ["generic", "straight cable at rest", "active bound", "active distance"])
def test_gradient_of_the_objective(name):
    """Central differences and JVP against VJP in float64, through the projection where a bound is active."""
    with jax.enable_x64(True):
        straight = poses(0.985)
        case = problem("S", start=straight if name != "generic" else START)
        motion = random_motion(4) if name == "generic" else jnp.zeros((4, 2, 3))
        projected = name.startswith("active")
        if name == "active bound":
            motion = 3.0 * random_motion(5)
        if name == "active distance":
            motion = motion.at[:, 1, 0].set(0.02)
        if projected:
            assert float(case.feasible.violation(motion)) > 0

        @jax.jit
        def value(motion):
            return case.value(case.feasible.project(motion) if projected else motion)

        tangent = random_motion(6, size=1.0)
        forward = jax.jit(lambda u, t: jax.jvp(value, (u,), (t,))[1])(motion, tangent)
        backward = jnp.vdot(jax.jit(jax.grad(value))(motion), tangent)
        assert abs(forward - central_difference(value, motion, tangent)) <= 1e-5 * abs(forward)
        assert abs(forward - backward) <= 1e-8 * abs(forward)


def test_gradient_in_weights_history_and_target():
    with jax.enable_x64(True):
        motion = random_motion(7)
        history = at_rest(START)

        @jax.jit
        def value(x):
            case = problem("U", rate=x[0])
            moved = jax.tree.map(lambda leaf: leaf + x[1] * 0.1, history)
            return dataclasses.replace(case, history=moved, target=case.target + x[2]).value(motion)

        x, tangent = jnp.asarray([0.8, 0.02, -0.01]), jnp.asarray([0.3, -0.5, 0.8])
        forward = jax.jit(lambda x, t: jax.jvp(value, (x,), (t,))[1])(x, tangent)
        assert abs(forward - central_difference(value, x, tangent)) <= 1e-5 * abs(forward)
        assert abs(forward - jnp.vdot(jax.jit(jax.grad(value))(x), tangent)) <= 1e-8 * abs(forward)


def test_a_wound_up_cable_pays_for_more_than_half_a_turn_and_nothing_else_does():
    """The straight target seen from a cable whose far end was turned by 1.7 pi: a curl, not a reflection."""
    with jax.enable_x64(True):
        angle = np.linspace(0.0, 1.7 * np.pi, 13)
        curl = np.cumsum(np.stack([np.cos(angle), np.sin(angle)], axis=1), axis=0) / 12
        pose = jnp.asarray([[*curl[0], 0.0], [*curl[-1], 1.7 * np.pi - 2 * np.pi]])
        history = History(keypoints=jnp.asarray(np.tile(curl, (3, 1, 1))), gripper_pose=pose)
        case = dataclasses.replace(
            problem("near"), history=history, target=hermite_shape(TARGETS["near"], 13), feasible=feasible_set(pose)
        )
        motion = random_motion(3)
        turn = 1.7 * np.pi + np.cumsum(np.asarray(motion[:, 1, 2] - motion[:, 0, 2])) / 0.15
        wound = np.asarray(residuals_at(case, motion)[-len(motion) - 2 : -2])
        np.testing.assert_allclose(wound, 0.15 * (turn - float(total_turn(case.target)) - np.pi), rtol=1e-9)
        assert wound.min() > 0.05
        residuals, jacobian = linearise(case, motion)
        np.testing.assert_allclose(residuals, residuals_at(case, motion), atol=1e-12)
        np.testing.assert_allclose(jacobian, jacobian_at(case, motion), atol=1e-10)
    for name in TARGETS:
        assert not residuals_at(problem(name), random_motion(4))[-6:-2].any()


def test_the_way_left_to_where_the_targets_ends_are_held_costs_what_it_is_longer_than_the_margin():
    with jax.enable_x64(True):
        case, motion = problem("U"), random_motion(3)
        goal = target_pose(case.target)
        pose = continued(case.history.gripper_pose, case.history.keypoints[-1])
        way = np.asarray(goal - pose) * [1.0, 1.0, 0.15] - np.asarray(motion.sum(axis=0))
        left = np.linalg.norm(way, axis=1) - case.objective.arrival_margin
        assert left.min() > 0.1
        np.testing.assert_allclose(residuals_at(case, motion)[-2:], left, rtol=1e-9)
        heavy = dataclasses.replace(case, objective=dataclasses.replace(case.objective, arrival_weight=4.0))
        np.testing.assert_allclose(residuals_at(heavy, motion)[-2:], 2 * left, rtol=1e-9)
        residuals, jacobian = linearise(case, motion)
        np.testing.assert_allclose(residuals, residuals_at(case, motion), atol=1e-12)
        np.testing.assert_allclose(jacobian, jacobian_at(case, motion), atol=1e-10)
        # on the goal itself nothing is left, and the derivative is finite
        arrived = dataclasses.replace(case, history=dataclasses.replace(case.history, gripper_pose=goal))
        still = jnp.zeros_like(motion)
        assert not residuals_at(arrived, still)[-2:].any()
        assert jnp.isfinite(jax.jit(jax.grad(ShapingProblem.value, argnums=1))(arrived, still)).all()


def test_target_shape_has_no_error():
    case = problem("U")
    assert float(case.shape_error(hermite_shape(TARGETS["U"], 7))) == 0.0


@pytest.mark.parametrize("change", [{"terminal_weight": -1.0}, {"motion_weight": float("nan")}, {"interval": 0.0}])
def test_impossible_objectives_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        ObjectiveConfig(**change)
