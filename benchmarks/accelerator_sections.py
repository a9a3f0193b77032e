"""The measurements of `accelerator.py`: what each prepares, and how much work one timed call does."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from cablejax.cable import Cable, Discretisation
from cablejax.commands.workloads import (
    batched_control,
    closed_loop,
    controller_to_s,
    data_stages,
    moving_arches,
    program_bytes,
    repeated,
)
from cablejax.control.shaping import initial_history, load_model
from cablejax.dataset.generate import make_engine, shards_at_once, simulate
from cablejax.dataset.schema import DatasetConfig
from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.networks import GNS
from cablejax.dynamics.normalisation import fit_normalisation
from cablejax.dynamics.train import TrainState, chunk_update
from cablejax.dynamics.train_config import Phase, TrainConfig
from cablejax.effects.physics import nominal_physics
from cablejax.simulate import MjxEngine, ThreadedEngine, compiler_options
from cablejax.simulate.chain.replay import Chain
from cablejax.types import Trajectory


@dataclasses.dataclass(frozen=True)
class Sizes:
    """How large the measurements are. The defaults are for a GPU of the data centre.

    Attributes:
        rounds: timed calls of each program, at least.
        least_seconds: timed calls go on for so long [s]: the energy counter is slow.
        most_seconds: no timed call begins after so long [s].
        batches: cables simulated at once, at the cable's own number of links.
        links: links of the cable, at the batch `batch`.
        batch: cables simulated at once where the links vary.
        gradient_batches: likewise with gradients, which compile for minutes.
        gradient_links: likewise.
        reference_batch: cables on which the engines are compared, and which one core simulates.
        trajectories: of a data set.
        commands: of each trajectory.
        windows: batch and rollout of a training step.
        model: the network that is trained.
        training_steps: optimiser steps in one call.
        controlled: cables under one controller.
        shaped: cables in one closed loop.
        loop_steps: commands of the closed loop.
        horizon: of the controller.
    """

    rounds: int = 5
    least_seconds: float = 1.0
    most_seconds: float = 10.0
    batches: tuple[int, ...] = (64, 4096, 32768)
    links: tuple[int, ...] = (12, 48, 96)
    batch: int = 4096
    gradient_batches: tuple[int, ...] = (64, 4096)
    gradient_links: tuple[int, ...] = ()
    reference_batch: int = 64
    trajectories: int = 10_000
    commands: int = 200
    windows: tuple[tuple[int, int], ...] = ((32, 1), (16, 4), (512, 1), (4096, 1))
    model: ModelConfig = ModelConfig()
    training_steps: int = 20
    controlled: tuple[int, ...] = (1, 64, 1024)
    shaped: int = 1024
    loop_steps: int = 10
    horizon: int = 5

    @classmethod
    def small(cls) -> Sizes:
        """A few seconds of work in each section on a processor."""
        return cls(
            rounds=2,
            least_seconds=0.0,
            batches=(4, 16),
            links=(12,),
            batch=4,
            gradient_batches=(4,),
            gradient_links=(),
            reference_batch=2,
            trajectories=4,
            commands=5,
            windows=((4, 1),),
            model=ModelConfig(latent=16, hidden=16, message_passing=1),
            training_steps=2,
            controlled=(1,),
            shaped=2,
            loop_steps=2,
            horizon=1,
        )


def timed(function: Callable[[], Any]) -> tuple[Any, float]:
    """What a function returns, and how long it took [s]."""
    begin = time.perf_counter()
    return function(), time.perf_counter() - begin


class Prepared(NamedTuple):
    """What is timed.

    Attributes:
        run: does the work and returns when it is done.
        work: units of it in one call.
        bytes: device memory of the program, None where it is not one program.
        details: called after the timing; entries for the record.
    """

    run: Callable[[], Any]
    work: float
    bytes: int | None = None
    details: Callable[[], dict[str, Any]] = dict


class Case(NamedTuple):
    """One measurement: `labels` say which, `prepare` makes it ready to be timed."""

    section: str
    labels: dict[str, Any]
    prepare: Callable[[], Prepared]

    @property
    def name(self) -> str:
        """Identifies the measurement in the records."""
        return ", ".join([self.section, *(f"{key} {value}" for key, value in self.labels.items())])


class Rollouts(NamedTuple):
    """Cables that are simulated at once.

    Attributes:
        function: keypoints at the end [m], shape [B, N, 2], of the arguments.
        arguments: of which the last one is the grippers' motion.
        steps: time steps of all cables together.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    steps: int


# Reverse mode remembers the start of each command and the inside of one, so commands are short here.
_INTERVAL = 0.2


def mjx(config: Discretisation, batch: int, seconds: int) -> Rollouts:
    """MJX from the static equilibrium."""
    engine, commands = MjxEngine(config), round(seconds / _INTERVAL)

    def function(params, state, twist):
        rollout = jax.vmap(functools.partial(engine.unroll, interval=_INTERVAL))
        return rollout(params, state, twist)[1].keypoints[:, -1]

    return Rollouts(function, moving_arches(config, batch, commands), batch * commands * engine.substeps(_INTERVAL))


def chain(config: Discretisation, batch: int, seconds: int) -> Rollouts:
    """The diagnosis' chain, which first settles for twenty steps; they count, since they cost as much as the others."""
    commands, substeps = round(seconds / _INTERVAL), round(_INTERVAL / config.timestep)
    _, state, twist = moving_arches(config, batch, commands)
    moved = jnp.concatenate([jnp.zeros_like(twist[:, :1]), jnp.cumsum(twist, axis=1)], axis=1)
    poses = state.gripper_pose[:, None] + _INTERVAL * moved
    physics = repeated(nominal_physics(config, poses.dtype), batch)

    def one(physics, angles, poses):
        interval = jnp.asarray(_INTERVAL, poses.dtype)
        return Chain(config, with_contact=False).rollout(physics, angles, poses, interval, n_substeps=substeps)[-1]

    return Rollouts(jax.vmap(one), (physics, state.qpos[:, 2:], poses), batch * (commands * substeps + CHAIN_SETTLES))


CHAIN_SETTLES = 20

ENGINES: dict[str, Callable[[Discretisation, int, int], Rollouts]] = {"MJX": mjx, "chain": chain}
"""Engines in JAX by name. A further one is a function of the cable, the batch and the simulated seconds."""


def compiled(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """A simulator's function, compiled for its arguments."""
    return jax.jit(function, compiler_options=compiler_options()).lower(*arguments).compile()


def rollout_cases(sizes: Sizes) -> list[Case]:
    """Environment-steps of one simulated second; C MuJoCo on one core for comparison."""

    def prepare(engine: str, config: Discretisation, batch: int) -> Prepared:
        function, arguments, steps = ENGINES[engine](config, batch, 1)
        program = compiled(function, arguments)
        return Prepared(lambda: jax.block_until_ready(program(*arguments)), steps, program_bytes(program))

    def one_core(config: Discretisation) -> Prepared:
        engine, batch = ThreadedEngine(config, 1), sizes.reference_batch
        arguments = moving_arches(config, batch, 1)
        return Prepared(lambda: engine.rollout(*arguments, 1.0), batch * engine.substeps(1.0))

    cases = grid("rollout", prepare, sizes.batches, sizes.links, sizes.batch)
    for n in (Discretisation().n_links, *sizes.links):
        labels = {"engine": "C MuJoCo, one CPU core", "links": n, "batch": sizes.reference_batch}
        cases.append(Case("rollout", labels, functools.partial(one_core, Discretisation(n_links=n))))
    return cases


def gradient_cases(sizes: Sizes) -> list[Case]:
    """Environment-steps of one simulated second and its gradient in the grippers' motion, in reverse mode."""

    def prepare(engine: str, config: Discretisation, batch: int) -> Prepared:
        function, arguments, steps = ENGINES[engine](config, batch, 1)

        def loss(*arguments):
            return jnp.sum(function(*arguments) ** 2)

        program = compiled(jax.grad(loss, argnums=len(arguments) - 1), arguments)
        return Prepared(lambda: jax.block_until_ready(program(*arguments)), steps, program_bytes(program))

    return grid("gradient", prepare, sizes.gradient_batches, sizes.gradient_links, sizes.batch)


def grid(
    section: str,
    prepare: Callable[[str, Discretisation, int], Prepared],
    batches: tuple[int, ...],
    links: tuple[int, ...],
    batch: int,
) -> list[Case]:
    """Every engine at the cable's own number of links and some batches, then at one batch and other links."""
    sizes = [(Discretisation().n_links, b) for b in batches] + [(n, batch) for n in links]
    return [
        Case(
            section,
            {"engine": engine, "links": n, "batch": b},
            functools.partial(prepare, engine, Discretisation(n_links=n), b),
        )
        for n, b in sizes
        for engine in ENGINES
    ]


def precision_cases(sizes: Sizes) -> list[Case]:
    """How far the keypoints are after 3 s from the same program in double precision, and from C MuJoCo."""
    config, seconds = Discretisation(), 3

    def prepare(engine: str) -> Prepared:
        function, arguments, steps = ENGINES[engine](config, sizes.reference_batch, seconds)
        program = compiled(function, arguments)
        with jax.enable_x64(True):
            function, exact, _ = ENGINES[engine](config, sizes.reference_batch, seconds)
            there = np.asarray(compiled(function, exact)(*exact))

        def details() -> dict[str, Any]:
            here = np.asarray(program(*arguments), float)
            params, state, twist = moving_arches(config, sizes.reference_batch, round(seconds / _INTERVAL))
            _, by_c = ThreadedEngine(config).rollout(params, state, twist, _INTERVAL)
            apart = {"double_mm": there, "c_mm": np.asarray(by_c.keypoints[:, -1], float)}
            return {name: 1e3 * float(np.linalg.norm(here - other, axis=-1).max()) for name, other in apart.items()}

        return Prepared(lambda: jax.block_until_ready(program(*arguments)), steps, program_bytes(program), details)

    return [Case("precision", {"engine": name}, functools.partial(prepare, name)) for name in ENGINES]


def data_cases(sizes: Sizes) -> list[Case]:
    """Transitions into a store by `generate`, once compiled, and how long drawing and simulating take alone."""
    config = DatasetConfig(n_trajectories=sizes.trajectories, n_steps=sizes.commands)

    def prepare() -> Prepared:
        stages, engine = data_stages(config), make_engine(config)
        simulate(config, engine, range(min(shards_at_once(config, engine), config.n_shards)))

        def details() -> dict[str, Any]:
            return {f"{stage}_s": timed(stages[stage])[1] for stage in ("draw", "both")}

        return Prepared(stages["whole"], sizes.trajectories * sizes.commands, None, details)

    return [Case("data", {"engine": config.engine, "trajectories": sizes.trajectories}, prepare)]


def training_cases(sizes: Sizes) -> list[Case]:
    """Windows that a training sees per second, by batch and by steps that the model is rolled out."""

    @functools.cache
    def data() -> Trajectory:
        engine = MjxEngine()
        return engine.rollout(*moving_arches(engine.config, 64, 30))[1]

    def prepare(batch: int, rollout: int) -> Prepared:
        model = dataclasses.replace(sizes.model, normalisation=fit_normalisation(data(), sizes.model))
        phase = Phase(steps=1000, batch=batch, rollout=rollout)
        config = TrainConfig(model=model, phases=(phase,), chunk=sizes.training_steps)
        graphdef, weights = nnx.split(GNS(model, nnx.Rngs(0)))
        state = TrainState(weights, weights, config.optimiser().init(weights), jnp.zeros((), jnp.int32))
        arguments = (state, jax.tree.map(jnp.asarray, data()))
        program = chunk_update(config, 0, graphdef, sizes.training_steps).lower(*arguments).compile()
        work = sizes.training_steps * batch
        return Prepared(lambda: jax.block_until_ready(program(*arguments)), work, program_bytes(program))

    return [
        Case("training", {"batch": batch, "rollout": rollout}, functools.partial(prepare, batch, rollout))
        for batch, rollout in sizes.windows
    ]


def control_cases(sizes: Sizes) -> list[Case]:
    """Plans per second of one compiled controller for many cables."""

    def prepare(size: int) -> Prepared:
        model = load_model("gns-reference")
        history = initial_history(Cable(), model.config)
        call, memory = batched_control(controller_to_s(model, "levenberg-marquardt", sizes.horizon), history, size)
        return Prepared(call, size, memory)

    return [Case("control", {"cables": size}, functools.partial(prepare, size)) for size in sizes.controlled]


def loop_cases(sizes: Sizes) -> list[Case]:
    """Commands per second of whole closed loops: MJX as plant, observation, residual, plan and command.

    `products` is the precision of the network's and the planner's matrix products; the plant's is always full.
    """

    def prepare(products: str) -> Prepared:
        model = load_model("gns-reference")
        controller = controller_to_s(model, "levenberg-marquardt", sizes.horizon)
        loop = closed_loop(controller, sizes.loop_steps, Discretisation())

        def run():
            with jax.default_matmul_precision(products):
                return loop(sizes.shaped)

        error = np.median(run().terminal_error_cm)
        return Prepared(run, sizes.shaped * sizes.loop_steps, None, lambda: {"error_cm": float(error)})

    labels = {"cables": sizes.shaped, "commands": sizes.loop_steps}
    return [
        Case("loop", labels | {"products": products}, functools.partial(prepare, products))
        for products in ("default", "highest")
    ]


SECTIONS: dict[str, Callable[[Sizes], list[Case]]] = {
    "rollout": rollout_cases,
    "gradient": gradient_cases,
    "precision": precision_cases,
    "data": data_cases,
    "training": training_cases,
    "control": control_cases,
    "loop": loop_cases,
}
"""The measurements of each section of the page."""

WAVES = (("data", "loop", "control"), ("rollout",), ("training", "precision"), ("gradient",))
"""Sections that are compiled together, those that the goals need first."""
