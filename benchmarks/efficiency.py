"""How much faster two devices, or two processes, do one piece of work than one core: data, training, evaluation.

python benchmarks/efficiency.py                     # prints a table, on a machine with nothing else to do
python benchmarks/efficiency.py --small             # shows that it works

Efficiency is the time on one core over twice the time of both. All times of a row are taken in turns, in one run.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import os
import pathlib
import subprocess
import sys
import tempfile
from collections.abc import Callable

import numpy as np


@dataclasses.dataclass(frozen=True)
class Contestant:
    """Who does the work.

    Attributes:
        devices: of each process.
        processes: that share the work.
        cores: that each process may use; None = all.
    """

    devices: int = 1
    processes: int = 1
    cores: int | None = None


CONTESTANTS = {
    "one core": Contestant(cores=1),
    "one device, all cores": Contestant(),
    "two devices": Contestant(devices=2),
    "two processes": Contestant(processes=2),
}


def data(share: int, shares: int, small: bool, weights: str) -> Callable[[], object]:
    """Makes trajectories and writes them to a store."""
    from cablejax.dataset.generate import generate, make_engine
    from cablejax.dataset.schema import DatasetConfig

    config = DatasetConfig(
        n_trajectories=8 if small else 256, n_steps=4 if small else 200, shard_size=2 if small else 32
    )
    engine = make_engine(config)

    def run() -> None:
        with tempfile.TemporaryDirectory() as folder:
            place = pathlib.Path(folder) / "data.zarr"
            generate(config, place, process_index=share, process_count=shares, progress=False, engine=engine)

    return run


def training(share: int, shares: int, small: bool, weights: str) -> Callable[[], object]:
    """Some steps of a training like that of the released model; a training is one process."""
    import jax
    import jax.numpy as jnp
    from flax import nnx

    from cablejax.cable import Discretisation
    from cablejax.dataset.generate import make_engine, simulate
    from cablejax.dataset.schema import DatasetConfig
    from cablejax.dynamics.config import ModelConfig
    from cablejax.dynamics.networks import GNS
    from cablejax.dynamics.normalisation import fit_normalisation
    from cablejax.dynamics.parallel import on_all_devices, training_mesh
    from cablejax.dynamics.train import TrainState, chunk_update
    from cablejax.dynamics.train_config import Phase, TrainConfig
    from cablejax.types import Trajectory

    count, commands = (2, 4) if small else (16, 30)
    made = DatasetConfig(
        count, commands, shard_size=count, engine="threaded", discretisation=Discretisation(n_links=13)
    )
    (block,) = simulate(made, make_engine(made), [0])
    trajectories = Trajectory(*(jnp.asarray(a) for a in (block.keypoints, block.gripper_pose, block.gripper_twist)))
    model = ModelConfig(latent=8, hidden=8, hidden_layers=1, message_passing=1) if small else ModelConfig()
    model = dataclasses.replace(model, normalisation=fit_normalisation(trajectories, model))
    steps = 2 if small else 10
    config = TrainConfig(model=model, phases=(Phase(steps=steps),))
    mesh = training_mesh(config)
    graphdef, start = nnx.split(GNS(model, nnx.Rngs(0)))
    state = TrainState(start, start, config.optimiser().init(start), jnp.zeros((), jnp.int32))
    arguments = on_all_devices((state, trajectories), mesh)
    update = chunk_update(config, 0, graphdef, steps, mesh)
    return lambda: jax.block_until_ready(update(*arguments))


def evaluation(share: int, shares: int, small: bool, weights: str) -> Callable[[], object]:
    """Closed loops of a batch of cables."""
    import jax

    from cablejax.cable import Discretisation
    from cablejax.commands.workloads import closed_loop, controller_to_s
    from cablejax.control.shaping import load_model

    model = load_model(weights)
    controller = controller_to_s(model, "levenberg-marquardt", 1 if small else 5)
    run = closed_loop(controller, 1 if small else 10, Discretisation(n_links=12))
    size = (4 if small else 16) // shares
    assert size % len(jax.devices()) == 0
    return lambda: run(size)


WORK = {"data": data, "training": training, "evaluation": evaluation}


def serve(name: str, options: argparse.Namespace) -> None:
    """In a child: prepares the work, then does it once for every line that comes, and answers each with a line."""
    if options.cores is not None:
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: options.cores])
    run = WORK[name](options.share, options.shares, options.small, options.weights)
    for _ in sys.stdin:
        run()
        print("done", flush=True)


@contextlib.contextmanager
def at_work(name: str, contestant: Contestant, options: argparse.Namespace):
    """The work of a contestant as a function, with its processes waiting in between."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={contestant.devices}"
    command = [sys.executable, __file__, "--serve", name, "--shares", str(contestant.processes)]
    command += ["--weights", options.weights, *(["--small"] if options.small else [])]
    command += [] if contestant.cores is None else ["--cores", str(contestant.cores)]
    # XLA's pool of fewer threads than four can deadlock in batched steps of MJX
    environment = {"NPROC": "4"} | os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    processes = [
        subprocess.Popen(
            [*command, "--share", str(share)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )
        for share in range(contestant.processes)
    ]

    def run() -> None:
        for process in processes:
            print("go", file=process.stdin, flush=True)
        for process in processes:
            # libraries print lines of their own
            if process.stdout is None or "done\n" not in iter(process.stdout.readline, ""):
                raise RuntimeError(f"A process failed at {name}: see its error above.")

    try:
        yield run
    finally:
        for process in processes:
            process.kill()
            process.communicate()


def row(name: str, options: argparse.Namespace) -> list[str]:
    """Median times [s] of one kind of work, and the efficiencies of two devices and two processes."""
    from cablejax.commands.workloads import seconds_in_turns

    with contextlib.ExitStack() as stack:
        contestants = {
            label: stack.enter_context(at_work(name, contestant, options))
            for label, contestant in CONTESTANTS.items()
            if name != "training" or contestant.processes == 1
        }
        times = {label: float(np.median(s)) for label, s in seconds_in_turns(contestants, options.rounds).items()}
    efficiency = [
        f"{times['one core'] / (2 * times[label]):.2f}" if label in times else "-"
        for label in ("two devices", "two processes")
    ]
    return [name, *(f"{times[label]:.2f}" if label in times else "-" for label in CONTESTANTS), *efficiency]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--small", action="store_true", help="sizes that show only that all parts run")
    parser.add_argument("--only", nargs="+", choices=tuple(WORK), default=tuple(WORK))
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--weights", default="gns-reference", help="model of the closed loops")
    parser.add_argument("--serve", choices=tuple(WORK), help=argparse.SUPPRESS)
    for name, default in (("--share", 0), ("--shares", 1), ("--cores", None)):
        parser.add_argument(name, type=int, default=default, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve is not None:
        serve(options.serve, options)
        return
    head = ["work", *(f"{label} [s]" for label in CONTESTANTS), "efficiency, devices", "efficiency, processes"]
    print(f"| {' | '.join(head)} |\n|{' --- |' * len(head)}")
    for name in options.only:
        print(f"| {' | '.join(row(name, options))} |", flush=True)


if __name__ == "__main__":
    main()
