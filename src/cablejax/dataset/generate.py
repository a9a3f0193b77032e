"""Makes a data set: draws motions, simulates them, checks the result, writes it shard by shard.

Trajectory i is a function of the configuration and i alone. Whoever simulates it, in whatever batch, on however many
devices or processes, writes the same bytes (with the same engine on the same kind of machine).
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import itertools
import math
import os
import shutil
from collections.abc import Callable, Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from cablejax.cores import available_cores
from cablejax.dataset.bucket import Bucket
from cablejax.dataset.drawing import Draw, cable_params, draw_all
from cablejax.dataset.opening import open_or_create, require_same_versions
from cablejax.dataset.parallel import DeviceParallel
from cablejax.dataset.schema import Block, DatasetConfig
from cablejax.dataset.store import DatasetInfo, Store
from cablejax.effects.given import EFFECTS, GivenEffect
from cablejax.simulate import ENGINES, Engine, ThreadedEngine
from cablejax.types import Trajectory
from cablejax.whole_file import sole_writer

MAX_ATTEMPTS = 10
"""Motions drawn for one trajectory before generation gives up."""

CABLES_ON_ACCELERATOR = 2048
"""Cables in a batch on each accelerator: beyond, its steps take longer as their number grows."""

GRASP_TOLERANCE = 1e-2
"""Largest distance of an end keypoint from its gripper, in lengths of the cable: one that snaps through pulls its ends
off a bit."""

COMPRESSED = 0.9
"""Size of random motions in a store, relative to their arrays."""

WRITER = ".writer-"
"""A folder of this name in the store, with its share after it, is locked by each process that writes there."""

STRETCH_TOLERANCE = 0.01
"""Largest excess of the chord between neighbouring keypoints over the arc length between them, relative."""


class GenerationInterrupted(KeyboardInterrupt):
    """Ctrl-C during generation: every shard written so far is kept. The message says how to go on."""


def generate(
    config: DatasetConfig,
    path: str | os.PathLike[str] | Bucket,
    *,
    process_index: int | None = None,
    process_count: int | None = None,
    progress: bool = True,
    engine: Engine | None = None,
) -> DatasetInfo:
    """Makes this process' share of a data set, going on where an earlier run stopped.

    Process p of P makes the shards p, p + P, p + 2 P, ... and may be started by hand, by a batch system, or under
    `jax.distributed.initialize`, which then provides p and P. The store is the same for any P.

    Args:
        config: what to make.
        path: folder of the store, or `s3://BUCKET/PREFIX`: new, empty or begun earlier with the same configuration.
        process_index: p; by default JAX's.
        process_count: P; by default JAX's.
        progress: show a bar with the time left, in trajectories.
        engine: the simulator; by default the one that the configuration names.

    Returns:
        What is on disk afterwards; under `jax.distributed`, once every process has finished.

    Raises:
        ValueError: the folder holds something else (see `open_or_create`), its disk has too little room for what is
            missing, or a trajectory failed its checks `MAX_ATTEMPTS` times.
        GenerationInterrupted: Ctrl-C. Complete shards are kept.
    """
    distributed = process_index is None and process_count is None and jax.process_count() > 1
    index = jax.process_index() if process_index is None else process_index
    count = jax.process_count() if process_count is None else process_count
    if not 0 <= index < count:
        raise ValueError(f"process_index is {index} and process_count {count}, expected 0 <= index < count.")
    store = open_or_create(path, config)
    _check_room(store)
    mine = range(index, config.n_shards, count)
    simulator = engine or make_engine(config)
    at_once = shards_at_once(config, simulator)

    done: list[int] = []
    total = sum(len(config.shard_rows(shard)) for shard in mine)
    label = "trajectories" if count == 1 else f"trajectories ({index + 1}/{count})"
    with (
        _sole_writer(store, f"{WRITER}{index}-of-{count}"),
        tqdm(total=total, desc=label, unit="traj", disable=not progress) as bar,
    ):

        def lacking(shard: int) -> bool:
            if store.status(shard) != "complete":
                require_same_versions(store)  # also where one shard of a complete store is damaged
                return True
            done.append(shard)
            if progress:
                bar.initial += len(config.shard_rows(shard))  # which took no time
            bar.update(len(config.shard_rows(shard)))
            return False

        todo = filter(lacking, mine)
        groups = iter(lambda: list(itertools.islice(todo, at_once)), [])
        try:
            _make(config, simulator, store, groups, done, bar)
        except KeyboardInterrupt:
            raise GenerationInterrupted(
                f"Stopped at {sum(len(config.shard_rows(shard)) for shard in done)} of {total} trajectories; they are "
                f"kept in {path}. Run the same generation again to resume."
            ) from None
    if distributed:
        from jax.experimental import multihost_utils

        multihost_utils.sync_global_devices("cablejax.dataset.generate")
    return store.info()


def _make(
    config: DatasetConfig, engine: Engine, store: Store, groups: Iterator[list[int]], done: list[int], bar: tqdm
) -> None:
    """Simulates groups of shards; what has been simulated is written while the next group is. Adds to `done`."""

    def write(shards: list[int], blocks: list[Block]) -> None:
        for shard, block in zip(shards, blocks, strict=True):
            store.write_shard(shard, block)
            done.append(shard)

    writing = None
    with concurrent.futures.ThreadPoolExecutor(1) as writer:
        for shards in groups:
            blocks = simulate(config, engine, shards, bar.update)
            if writing:
                writing.result()
            writing = writer.submit(write, shards, blocks)
        if writing:
            writing.result()


def _check_room(store: Store) -> None:
    """Raises `ValueError` if the missing trajectories, of all processes, do not fit on the disk of a folder."""
    if isinstance(store.path, Bucket):
        return
    config = store.config
    one = sum(np.dtype(dtype).itemsize * math.prod(shape) for shape, dtype in config.array_shapes().values())
    missing = config.n_trajectories - store.info().n_complete
    needed, free = COMPRESSED * one * missing, shutil.disk_usage(store.path).free
    if needed > free:
        raise ValueError(
            f"{missing} trajectories are missing in {store.path}, which need about {needed / 1e9:.3g} GB, but its disk "
            f"has {free / 1e9:.3g} GB left. Make room, or give a folder on another disk; existing trajectories are "
            "kept."
        )


@contextlib.contextmanager
def _sole_writer(store: Store, name: str) -> Iterator[None]:
    """Keeps other processes from the same share, in a folder; object storage has no locks."""
    if isinstance(store.path, Bucket):
        yield
        return
    writer = store.path / name
    writer.mkdir(exist_ok=True)
    with sole_writer(writer):
        yield
    with contextlib.suppress(OSError):
        writer.rmdir()


def simulate(
    config: DatasetConfig, engine: Engine, shards: Sequence[int], progress: Callable[[int], object] = lambda count: None
) -> list[Block]:
    """The trajectories of some shards, checked by `find_fault`. What fails is drawn again, as the next attempt.

    Args:
        config: what to make.
        engine: the simulator.
        shards: their numbers.
        progress: called with the number of trajectories whenever some more are done.

    Raises:
        ValueError: a trajectory failed `MAX_ATTEMPTS` times.
    """
    rows = np.concatenate([np.asarray(config.shard_rows(shard)) for shard in shards])
    out = {name: np.zeros((len(rows), *shape), dtype) for name, (shape, dtype) in config.array_shapes().items()}
    # one compiled program simulates whole shards; threads take any number of cables
    at_once = len(rows) if isinstance(engine, DeviceParallel) else 2 * available_cores()
    pending, problems = np.arange(len(rows)), {}
    for attempt in range(MAX_ATTEMPTS):
        problems = {}
        for part in np.split(pending, range(at_once, len(pending), at_once)):
            draws = draw_all(config, rows[part].tolist(), attempt)
            trajectory = _rollout(config, engine, draws)
            out["keypoints"][part] = trajectory.keypoints
            out["gripper_pose"][part] = trajectory.gripper_pose
            out["gripper_twist"][part] = [item.gripper_twist for item in draws]
            out["parameters"][part] = [item.parameters for item in draws]
            out["attempts"][part] = attempt
            blocks = ((k, Block(**{n: a[k] for n, a in out.items()})) for k in part)
            faults = {k: find_fault(config, one, config.effects_of(int(rows[k]))) for k, one in blocks}
            problems |= {k: fault for k, fault in faults.items() if fault}
            progress(len(part) - sum(fault is not None for fault in faults.values()))
        pending = np.array(sorted(problems), dtype=int)
        if not problems:
            block = Block(**out)
            ends = np.cumsum([len(config.shard_rows(shard)) for shard in shards])[:-1]
            parts = {name: np.split(getattr(block, name), ends) for name in out}
            return [Block(**{name: part[i] for name, part in parts.items()}) for i in range(len(shards))]
    raise ValueError(
        f"{len(problems)} trajectories failed {MAX_ATTEMPTS} times in a row; number {rows[pending[0]]}: "
        f"{problems[pending[0]]}. Another engine, time step or number of links may help: --engine "
        f"{' or '.join(name for name in ENGINES if name != config.engine)}, --timestep, --links. A soft cable on a "
        "rough table needs another engine or fewer links."
    )


def find_fault(config: DatasetConfig, one: Block, effects: Sequence[GivenEffect]) -> str | None:
    """Why one trajectory (a `Block` without its first axis) of a cable with these effects cannot be real, or None.

    Effects of the observation move keypoints off the grippers, and they and those of the extension stretch the cable:
    with them, that is no fault.
    """
    keypoints, grippers = one.keypoints, one.gripper_pose[..., :2]
    if not (np.isfinite(keypoints).all() and np.isfinite(one.gripper_pose).all()):
        return "the simulation diverged (not finite)"
    hooks = {EFFECTS[effect.name].hook for effect in effects}
    if "observation" in hooks:
        return None
    gap = np.linalg.norm(keypoints[:, [0, -1]] - grippers, axis=-1).max()
    allowed = GRASP_TOLERANCE * config.cable.length
    if gap > allowed:
        return f"an end of the cable is {gap:.2g} m from its gripper (allowed: {allowed:.2g} m)"
    if "extension" in hooks:
        return None
    spacing = np.diff(config.cable.keypoint_arclength)
    stretch = (np.linalg.norm(np.diff(keypoints, axis=1), axis=-1) / spacing).max() - 1
    if stretch > STRETCH_TOLERANCE:
        return f"the cable is stretched by {100 * stretch:.2g} % (allowed: {100 * STRETCH_TOLERANCE:.2g} %)"
    return None


def make_engine(config: DatasetConfig) -> Engine:
    """The simulator that the configuration names, spread over this process' devices.

    A device's batch is one shard on a processor; on an accelerator, which a few cables leave idle, as many whole shards
    as make `CABLES_ON_ACCELERATOR` cables.
    """
    engine = ENGINES[config.engine](config.discretisation)  # pyright: ignore[reportCallIssue]
    if isinstance(engine, ThreadedEngine):
        return engine
    devices = tuple(jax.local_devices())
    threads = os.environ.get("NPROC", "")
    if devices[0].platform == "cpu" and threads.isdecimal() and int(threads) < len(devices):
        raise ValueError(
            f"NPROC={threads} gives XLA fewer threads than there are devices ({len(devices)}), which would deadlock: "
            "raise NPROC, or use fewer devices."
        )
    shards = 1 if devices[0].platform == "cpu" else max(CABLES_ON_ACCELERATOR // config.shard_size, 1)
    return DeviceParallel(engine, min(shards, config.n_shards) * config.shard_size, devices)


def shards_at_once(config: DatasetConfig, engine: Engine) -> int:
    """Shards that `simulate` is best given together."""
    return max(engine.width // config.shard_size, 1) if isinstance(engine, DeviceParallel) else 1


def _rollout(config: DatasetConfig, engine: Engine, draws: Sequence[Draw]) -> Trajectory:
    cables = [cable_params(config, item.parameters, item.index) for item in draws]
    params = jax.tree.map(lambda *leaves: np.stack(leaves), *cables)
    # a data set has the same bytes whatever JAX's default precision is
    with jax.enable_x64(False):
        state = engine.initial_state(jnp.stack([item.gripper_pose for item in draws]))
        if config.effects or config.posterior:
            state = engine.settled(params, state, config.interval)
        twist = jnp.stack([item.gripper_twist for item in draws])
        return engine.rollout(params, state, twist, config.interval)[1]
