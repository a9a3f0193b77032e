"""A batch of closed loops is the same as each of them alone, in Python, on the same simulator."""

import dataclasses
import os
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.bounded import Result
from cablejax.cable import Cable, Discretisation
from cablejax.commands.workloads import varied_params
from cablejax.control.batched import for_each_cable, shape_batch
from cablejax.control.loop import run_closed_loop
from cablejax.control.shaping import NetworkDynamics, load_model, make_controller
from cablejax.control.targets import Target, make_target, straight_start
from cablejax.effects.given import GivenEffect
from cablejax.effects.physics import Physics
from cablejax.mpc import MPC, MPCConfig, Plan
from cablejax.mpc.target_pose import target_pose
from cablejax.simulate import MjxEngine
from cablejax.simulate.plant import Plant, PlantConfig
from cablejax.types import History
from dynamics_cases import SMALL, network
from engine_plant import EnginePlant

CABLE = Discretisation(Cable(n_keypoints=5), n_links=9)
ENGINE = MjxEngine(CABLE)
RATIOS = np.array([0.5, 2.0, 1.0])


@dataclasses.dataclass(frozen=True)
class Info:
    radius: jax.Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class GoToTarget:
    """Moves the grippers straight to the target's; its state counts the commands."""

    target: jax.Array
    speed: jax.Array | float

    def init(self, history: History):
        return jnp.zeros((), jnp.int32)

    def step(self, state, measurement):
        way = target_pose(jnp.asarray(self.target)) - measurement.gripper_pose
        size = jnp.linalg.norm(way * jnp.array([1.0, 1.0, 0.15]), axis=1).max()
        return state + 1, way * jnp.minimum(1.0, self.speed / jnp.maximum(size, 1e-9)), Info(0.01 * state)


@dataclasses.dataclass(frozen=True)
class OneGradientStep:
    """A planner that compiles in no time."""

    def __call__(self, problem, guess):
        motion = problem.feasible.project(guess.motion - 0.1 * jax.grad(problem.value)(guess.motion))
        return Plan(motion, problem.value(motion), jnp.ones((), jnp.int32), jnp.full((), Result.STEP_LIMIT, jnp.int32))


def targets(letters: str) -> list[Target]:
    return [make_target(letter, CABLE.cable) for letter in letters]  # pyright: ignore[reportArgumentType]


def arguments(letters="USU", ratios=RATIOS):
    """Plant, cables, and where they start; controller, targets and number of commands follow."""
    starts = np.stack([straight_start(CABLE.cable)] * len(letters))
    return ENGINE, varied_params(CABLE, ratios), ENGINE.initial_state(starts)


def member(params: Physics, index: int) -> Physics:
    return jax.tree.map(lambda leaf: leaf[index], params)


def shapes(letters: str) -> np.ndarray:
    return np.stack([target.keypoints for target in targets(letters)])


def alone(controller, params: Physics, target: Target, steps: int):
    return run_closed_loop(
        EnginePlant(ENGINE, params), controller, target, steps,
        start=straight_start(CABLE.cable), record_hz=1.0,
    )  # fmt: skip


def test_a_batch_of_loops_equals_each_loop_alone():
    steps, letters = 6, "USU"
    controller = GoToTarget(shapes("U")[0], 0.05)
    engine, params, state = arguments(letters)
    run = shape_batch(engine, params, state, controller, shapes(letters), steps)
    assert run.keypoints.shape == (3, 7, 5, 2) and run.twist.shape == (3, 6, 2, 3)
    for i, target in enumerate(targets(letters)):
        one = alone(GoToTarget(target.keypoints, 0.05), member(params, i), target, 6)
        np.testing.assert_allclose(run.keypoints[i], one.keypoints, atol=1e-6)
        np.testing.assert_allclose(run.gripper_pose[i], one.gripper_pose, atol=1e-6)
        np.testing.assert_allclose(run.twist[i], one.twist[:-1], atol=1e-6)
        np.testing.assert_allclose(run.error_cm[i], one.error_cm, atol=1e-4)
    assert (run.error_cm[:, -1] < 0.7 * run.error_cm[:, 0]).all()
    np.testing.assert_allclose(run.radius, np.tile(0.01 * np.arange(6), (3, 1)), atol=1e-6)
    assert np.isnan(run.residual_share).all()  # this controller reports none
    # The stiffness is in the plant: two cables with the same target part by more than rounding.
    assert np.abs(run.keypoints[0] - run.keypoints[2]).max() > 1e-4


@pytest.mark.slow
def test_the_controller_in_a_batch_equals_the_controller_alone():
    """With a graph network, the online residual and a plan of two steps."""
    graphdef, weights = network(SMALL)
    config = MPCConfig(horizon=1, history_length=SMALL.history, solver=OneGradientStep())
    engine, params, state = arguments("SU", np.array([2.0, 0.5]))
    target = targets("SU")[1]
    controller = MPC(config, NetworkDynamics(graphdef), weights, target.keypoints)
    run = shape_batch(engine, params, state, controller, shapes("SU"), 5)
    one = alone(controller, member(params, 1), target, 5)
    np.testing.assert_allclose(run.keypoints[1], one.keypoints, atol=3e-6)
    np.testing.assert_allclose(run.twist[1], one.twist[:-1], atol=3e-6)
    np.testing.assert_allclose(run.radius[1], one.radius[:-1], atol=1e-6)
    np.testing.assert_allclose(run.residual_share[1], one.residual_share[:-1], atol=1e-3)
    assert (run.residual_share[:, 1:] > 0).any()
    assert (run.error_cm[:, -1] < run.error_cm[:, 0]).all()


@pytest.mark.slow
def test_two_and_eight_devices_shape_as_one(tmp_path):
    code = """
import sys; sys.path.insert(0, {folder!r})
import jax, numpy as np
from test_control_batched import *
controller = GoToTarget(shapes("U")[0], 0.05)
run = shape_batch(*arguments("USU"), controller, shapes("USU"), 3, devices=jax.devices())
print(jax.device_count()); np.save({path!r}, run.keypoints)
"""
    results = []
    for count in (1, 2, 8):
        path = str(tmp_path / f"{count}.npy")
        flags = f"--xla_force_host_platform_device_count={count}"
        done = subprocess.run(
            [sys.executable, "-c", code.format(folder=str(pathlib.Path(__file__).parent), path=path)],
            env=os.environ | {"XLA_FLAGS": flags}, capture_output=True, text=True, timeout=300,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert done.stdout.split()[-1] == str(count)
        results.append(np.load(path))
    for shared in results[1:]:
        assert shared.shape == (3, 4, 5, 2)  # copies that fill the other devices' shares are not shown
        np.testing.assert_allclose(shared, results[0], atol=1e-6)


@pytest.mark.slow
def test_the_batch_ends_where_the_contact_plant_ends():
    """U by the released model, on the planar simulator and in C MuJoCo with contacts.

    Not for very soft cables: at a tenth of the stiffness the two end a millimetre apart (0.056 and 0.156 cm from the
    target), since contacts hold the cable where it lies, while the simulator's friction is viscous at a creep.
    """
    cable, ratios, steps = Discretisation(), np.array([1.0, 3.0]), 20
    engine, model, target = MjxEngine(cable), load_model("gns-reference"), make_target("U", cable.cable)
    controller = make_controller(model, target, method="residual", solver="levenberg-marquardt")
    state = engine.initial_state(np.stack([straight_start(cable.cable)] * 2))
    goals = np.stack([target.keypoints] * 2)
    run = shape_batch(
        engine, varied_params(cable, ratios), state, controller, goals, steps
    )  # fmt: skip
    fine = Discretisation(n_links=24, dimension=3, timestep=0.005)
    for i, ratio in enumerate(ratios):
        plant = Plant(
            PlantConfig(discretisation=fine, effects=(GivenEffect("bending_stiffness", (("ratio", float(ratio)),)),))
        )
        one = run_closed_loop(plant, controller, target, steps, start=straight_start(cable.cable), record_hz=1.0)
        assert np.abs(one.keypoints[:10] - run.keypoints[i, :10]).max() < 1.5e-3
        assert abs(one.terminal_error_cm - run.terminal_error_cm[i]) < 0.1


def test_each_cable_is_stepped_as_alone():
    """A loop that takes another number of rounds for every cable, as a planner's does."""

    def step(state, measurement):
        halved = jax.lax.while_loop(lambda x: x > measurement, lambda x: 0.5 * x, state)
        return halved, {"twist": halved * jnp.ones(3)}

    states, measurements = jnp.array([8.0, 1.0, 3.0]), jnp.array([1.5, 2.0, 0.1])
    for devices in (None, jax.devices()[:1]):
        after, command = jax.jit(for_each_cable(step, devices))(states, measurements)
        np.testing.assert_array_equal(after, [1.0, 1.0, 0.09375])
        np.testing.assert_array_equal(command["twist"], np.repeat(after[:, None], 3, axis=1))
    with pytest.raises(ValueError, match="2 devices cannot share 3 cables equally, expected a multiple of 2"):
        jax.jit(for_each_cable(step, 2 * jax.devices()[:1]))(states, measurements)


def test_wrong_requests_are_refused():
    engine, params, state = arguments("UU", np.ones(2))
    controller = GoToTarget(shapes("U")[0], 0.05)
    with pytest.raises(ValueError, match=r"Targets of shape \(2, 5\)"):
        shape_batch(engine, params, state, controller, shapes("UU")[:, :, 0], 1)
    with pytest.raises(ValueError, match="expected 1, the number of targets"):
        shape_batch(engine, params, state, controller, shapes("U"), 1)
    with pytest.raises(ValueError, match="multiple of the time step"):
        shape_batch(engine, params, state, controller, shapes("UU"), 1, interval=0.015)
    unknown = shapes("UU")
    unknown[0, 2] = np.nan
    with pytest.raises(ValueError, match=r"target has shape .* with non-finite values"):
        shape_batch(engine, params, state, controller, unknown, 1)
    with pytest.raises(ValueError, match="steps is 0"):
        shape_batch(engine, params, state, controller, shapes("UU"), 0)
