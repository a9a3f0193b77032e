"""The workloads that `cablejax bench` and `benchmarks/` time, and the clock they share."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import pathlib
import tempfile
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cablejax.cable import Discretisation
from cablejax.commands.options import say
from cablejax.control.batched import BatchRun, for_each_cable, shape_batch
from cablejax.control.shaping import Model, make_controller
from cablejax.control.targets import make_target, straight_start
from cablejax.cores import available_cores
from cablejax.dataset.drawing import draw_all
from cablejax.dataset.generate import generate, make_engine, shards_at_once, simulate
from cablejax.dataset.schema import DatasetConfig
from cablejax.dynamics.evaluate import snapping
from cablejax.effects.physics import Physics, nominal_physics
from cablejax.mpc import MPC, MPCConfig
from cablejax.provenance import machine
from cablejax.simulate import MjxEngine
from cablejax.simulate.compile import on_devices
from cablejax.simulate.elastica import solve_elastica
from cablejax.simulate.equilibrium import equilibrium_state
from cablejax.solver_names import SolverName
from cablejax.types import CableState, History, Measurement, Trajectory

ARCH = np.array([[0.0, 0.0, 0.6], [0.8, 0.0, -0.6]])
"""Gripper poses that bend a cable of 1 m into an arch, shape [Q, 3]."""


def seconds_in_turns(
    contestants: Mapping[str, Callable[[], Any]], rounds: int, *, least: float = 0.0, most: float = np.inf
) -> dict[str, list[float]]:
    """Wall times [s] of every round, after one call each that does not count.

    The contestants take turns, so that a busy moment of the machine hits all of them alike.

    Args:
        contestants: functions that return once their work is done.
        rounds: how often each takes its turn.
        least: further rounds follow until all together have taken so long [s].
        most: no further round begins once all together have taken so long [s].
    """
    seconds: dict[str, list[float]] = {name: [] for name in contestants}
    for run in contestants.values():
        run()  # caches, and what is compiled on first use
    done, spent = 0, 0.0
    while (done < rounds or spent < least) and (done == 0 or spent < most):
        for name, run in contestants.items():
            seconds[name] += seconds_of_calls(run, 1)
            spent += seconds[name][-1]
        done += 1
        if done <= rounds:
            say(f"round {done} of {rounds}")
    return seconds


def seconds_of_calls(call: Callable[[], Any], count: int) -> list[float]:
    """Wall times [s] of calls one after the other, the first of which may compile."""
    seconds = []
    for _ in range(count):
        begin = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - begin)
    return seconds


def setting() -> dict[str, str]:
    """The device and the processor that a measurement depends on."""
    return {"device": jax.devices()[0].device_kind, "machine": machine()}


def program_bytes(compiled: Any) -> int:
    """Memory [bytes] of a compiled program: arguments, results and temporaries."""
    memory = compiled.memory_analysis()
    return memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes


def clouds_of_an_arch(
    count: int, points: int, length: float, seed: int = 0
) -> tuple[list[Float[np.ndarray, "n 2"]], list[Float[np.ndarray, "Q 3"]]]:
    """Point clouds, with 2 mm noise, of an arch that is carried to and fro by a millimetre per frame, and its poses.

    Args:
        count: number of frames.
        points: in each cloud.
        length: of the cable [m].
        seed: of the clouds.
    """
    random, pose = np.random.default_rng(seed), np.array([[-0.3, 0.0, 0.8], [0.35, 0.0, -0.6]])
    curve = solve_elastica(pose, length).position
    shifts = 0.01 * np.sin(0.1 * np.arange(count))
    grid, clouds = np.linspace(0.0, 1.0, len(curve)), []
    for shift in shifts:
        s = random.random(points)
        cloud = np.stack([np.interp(s, grid, axis) for axis in curve.T], axis=1)
        clouds.append(cloud + [shift, 0.0] + 0.002 * random.standard_normal(cloud.shape))
    return clouds, [pose + np.array([shift, 0.0, 0.0]) for shift in shifts]


def moving_arches(
    config: Discretisation, batch: int, commands: int, seed: int = 0
) -> tuple[Physics, CableState, Float[Array, "B T Q 3"]]:
    """Arguments of a batched rollout: arches moved slowly, so that table, bending and grasps are all at work."""
    twist = np.random.default_rng(seed).uniform(-0.01, 0.01, (batch, commands, 2, 3))
    pose = ARCH * [config.cable.length, config.cable.length, 1.0]
    params, states = repeated((nominal_physics(config), equilibrium_state(config, pose)), batch)
    return params, states, jnp.asarray(twist, float)


def distance_from_fine(config: DatasetConfig) -> Float[np.ndarray, "samples"]:
    """Largest distance [m] of a keypoint from the chain with steps of 2 ms, at every sample of a data set's motions.

    Samples after a snap-through are left out: on which side of it a cable is says nothing of the time step.
    """
    fine = dataclasses.replace(
        config,
        engine="chain",
        discretisation=dataclasses.replace(config.discretisation, timestep=0.002),
        shard_size=config.n_trajectories,
    )
    config = dataclasses.replace(config, shard_size=config.n_trajectories)
    truth, one = (simulate(made, make_engine(made), [0])[0] for made in (fine, config))
    away = np.linalg.norm(one.keypoints - truth.keypoints, axis=-1).max(axis=-1)[:, 1:]
    known = Trajectory(truth.keypoints, truth.gripper_pose, truth.gripper_twist)  # pyright: ignore[reportArgumentType]
    steps, length = config.n_steps, config.cable.length
    snapped = snapping(known, steps=steps, stride=steps, interval=config.interval, length=length)
    return away[~snapped & (one.attempts == truth.attempts)[:, None]]


def data_stages(config: DatasetConfig) -> dict[str, Callable[[], Any]]:
    """Stages of making a data set, to be timed: drawing motions, drawing and simulating, all including the store."""
    engine = make_engine(config)
    at_once, shards = shards_at_once(config, engine), range(config.n_shards)
    groups = [shards[first : first + at_once] for first in shards[::at_once]]
    rows = [[row for shard in group for row in config.shard_rows(shard)] for group in groups]

    def store() -> None:
        with tempfile.TemporaryDirectory() as folder:
            generate(config, pathlib.Path(folder) / "data.zarr", progress=False, engine=engine)

    return {
        "draw": lambda: [draw_all(config, indices) for indices in rows],
        "both": lambda: [simulate(config, engine, group) for group in groups],
        "whole": store,
    }


def repeated(tree: Any, size: int) -> Any:
    """Every leaf `size` times along a new first axis."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(jnp.asarray(leaf), (size, *jnp.shape(leaf))), tree)


def controller_to_s(model: Model, solver: SolverName, horizon: int = MPCConfig.horizon) -> MPC:
    """The controller with the online residual on the way to an S, with one of the solvers at its defaults."""
    controller = make_controller(model, make_target("S", model.cable), method="residual", solver=solver)
    return dataclasses.replace(controller, config=dataclasses.replace(controller.config, horizon=horizon))


def control_calls(controller: MPC, history: History) -> Callable[[], None]:
    """A function that controls a cable for one step at each call, from the observation to the command on the host.

    The loop is closed through the controller's own prediction, so that its window fills, its plans are warm and the
    work is that of a real run.
    """
    state = controller.init(history)
    measurement = Measurement(np.asarray(history.keypoints[-1]), np.asarray(history.gripper_pose))

    def call() -> None:
        nonlocal state, measurement
        state, twist, _ = jax.block_until_ready(controller.step(state, measurement))
        pose = measurement.gripper_pose + controller.config.objective.interval * np.asarray(twist)
        measurement = Measurement(np.asarray(state.last.predicted), pose)

    return call


def cores_as_devices() -> None:
    """Makes every core of a processor a device, over which cables can be spread, unless JAX has computed already."""
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", available_cores())


def batched_control(controller: MPC, history: History, size: int) -> tuple[Callable[[], None], int]:
    """A function that controls `size` cables for one step at each call, compiled, and its memory [bytes].

    They are spread over as many devices as divide their number.
    """
    measurement = Measurement(history.keypoints[-1], history.gripper_pose)
    devices = next(jax.devices()[:n] for n in range(len(jax.devices()), 0, -1) if size % n == 0)
    arguments = on_devices(repeated((controller.init(history), measurement), size), devices, size // len(devices))
    steps = for_each_cable(lambda state, measurement: controller.step(state, measurement), devices)
    step = jax.jit(steps).lower(*arguments).compile()

    def call() -> None:
        nonlocal arguments
        state, twist, _ = jax.block_until_ready(step(*arguments))
        pose = arguments[1].gripper_pose + controller.config.objective.interval * twist
        arguments = state, Measurement(state.last.predicted, pose)

    return call, program_bytes(step)


def varied_params(config: Discretisation, stiffness_ratio: Float[np.ndarray, " B"]) -> Physics:
    """The nominal parameters B times, with bending stiffnesses of given ratios to the nominal one."""
    nominal = nominal_physics(config)
    one = [dataclasses.replace(nominal, stiffness=nominal.stiffness * np.float32(r)) for r in stiffness_ratio]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *one)


def closed_loop(controller: MPC, steps: int, chain: Discretisation) -> Callable[[int], BatchRun]:
    """A function that shapes a number of straight cables, half to twice as stiff as nominal, for `steps` commands."""
    engine = MjxEngine(chain)

    @functools.lru_cache
    def inputs(size: int):
        state = repeated(engine.initial_state(straight_start(chain.cable)), size)
        return varied_params(chain, np.linspace(0.5, 2.0, size)), state, np.stack([controller.target] * size)

    def run(size: int) -> BatchRun:
        params, state, goals = inputs(size)
        devices, interval = jax.devices()[:size], controller.interval
        return jax.block_until_ready(
            shape_batch(engine, params, state, controller, goals, steps, interval=interval, devices=devices)
        )

    return run
