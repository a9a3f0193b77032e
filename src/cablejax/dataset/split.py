"""Splits trajectories of data sets into training and held-out ones, and reads or streams them."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cablejax.dataset.drawing import moves_alike
from cablejax.dataset.opening import open_store
from cablejax.dataset.schema import DatasetConfig, config_from_json
from cablejax.dataset.store import Store
from cablejax.dataset.streaming import StreamedData, blocks_of
from cablejax.dataset.windows import concatenate, read_trajectories
from cablejax.types import Trajectory


def split(n_trajectories: int, held_out: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Rows to train on and rows held out: the last `held_out` of them, rounded down, but at least one of each.

    Raises:
        ValueError: `held_out` is not a fraction in (0, 1), or there are fewer than two trajectories.
    """
    if not 0 < held_out < 1:
        raise ValueError(f"held_out is {held_out}, expected a fraction between 0 and 1.")
    if n_trajectories < 2:
        raise ValueError(f"{n_trajectories} trajectories cannot be split: generate at least 2.")
    first = n_trajectories - min(max(1, int(held_out * n_trajectories)), n_trajectories - 1)
    return np.arange(first), np.arange(first, n_trajectories)


def read_split(
    sources: Sequence[str | os.PathLike[str] | Store],
    held_out: float = 0.05,
    *,
    buffer: int | None = None,
    seed: int = 0,
) -> tuple[Trajectory | StreamedData, list[Trajectory]]:
    """Trajectories to train on, of all stores one after the other, and those that `split` holds out of each store.

    Args:
        sources: stores, or where they are.
        held_out: fraction of each.
        buffer: trajectories to train on that are in memory at a time, rounded down to whole blocks of the size of the
            smallest shard; None reads all of them, and so does a buffer with room for all.
        seed: of the order in which they come, where not all are read.

    Raises:
        ValueError: a store is not complete or damaged, they differ in keypoints, length of trajectories, interval or
            length of the cable, what is held out of one is in another, or the buffer holds less than two blocks.
    """
    stores = [source if isinstance(source, Store) else open_store(source) for source in sources]
    if not stores:
        raise ValueError("No data set given: expected at least one.")
    first = stores[0].config
    digests = [store.digests()[0] for store in stores]
    for store, digest in zip(stores, digests, strict=True):
        complete, cable = digest.any(axis=1), store.config.cable
        if not complete.all():
            raise ValueError(
                f"{store.path} holds {complete.sum()} of {store.config.n_trajectories} trajectories. Complete it "
                "first: run the command that generated it again."
            )
        came = (cable.n_keypoints, cable.length, store.config.n_steps, store.config.interval)
        expected = (first.cable.n_keypoints, first.cable.length, first.n_steps, first.interval)
        if came != expected:
            raise ValueError(
                f"{store.path} has (keypoints, cable length [m], commands, interval [s]) = {came}, but "
                f"{stores[0].path} has {expected}: only data sets of the same cable and protocol can be used together."
            )
    rows = [split(store.config.n_trajectories, held_out) for store in stores]
    _check_apart(stores, rows, digests)
    rest = [read_trajectories(store, last) for store, (_, last) in zip(stores, rows, strict=True)]
    training = [first for first, _ in rows]
    if buffer is not None and buffer < sum(map(len, training)):
        size = min(store.config.shard_size for store in stores)
        size = min(size, *map(len, training))
        if buffer < 2 * size:
            raise ValueError(
                f"A buffer of {buffer} trajectories is too small: data come in blocks of {size}, the size of a shard, "
                f"and at least two are in memory. Give at least {2 * size}, or leave the buffer out to read all at "
                "once."
            )
        return StreamedData(tuple(stores), blocks_of(training, size), buffer // size, seed), rest
    return concatenate([read_trajectories(store, mine) for store, mine in zip(stores, training, strict=True)]), rest


def _check_apart(
    stores: Sequence[Store], rows: Sequence[tuple[np.ndarray, np.ndarray]], digests: Sequence[np.ndarray]
) -> None:
    """Raises ValueError if a trajectory that is held out of one store is trained on in another."""
    # eight bytes of a digest tell billions of trajectories apart
    names = [np.ascontiguousarray(digest[:, :8]).view(np.uint64)[:, 0] for digest in digests]
    trained = [name[mine] for name, (mine, _) in zip(names, rows, strict=True)]
    for store, name, (_, last) in zip(stores, names, rows, strict=True):
        for other, there in zip(stores, trained, strict=True):
            if (both := np.isin(name[last], there)).any():
                raise ValueError(
                    f"{both.sum()} of the {len(last)} trajectories held out of {store.path} are training trajectories "
                    f"of {other.path}: simulate one of the two with another --seed."
                )


def known_motions(
    stores: Sequence[Store], held_out: Sequence[int], before: Sequence[Mapping[str, Any]] = ()
) -> list[str]:
    """Sentences on trajectories that are held out though their motion is trained on, with this cable or another.

    Args:
        stores: that are trained on.
        held_out: how many trajectories of each are held out.
        before: data sets of the model to start from, as its weights record them.
    """
    trained = [
        (str(store.path), store.config, store.config.n_trajectories - count)
        for store, count in zip(stores, held_out, strict=True)
    ]
    own = list(trained)
    for data in before:
        with contextlib.suppress(ValueError, KeyError, TypeError):  # an earlier version's, or somebody's
            config = config_from_json(DatasetConfig, data["config"])
            trained.append(
                (f"{data['name']}, of the model to start from", config, config.n_trajectories - data["held_out"])
            )
    found = []
    for name, config, first in own:
        for other, there, end in trained:
            known = min(config.n_trajectories, end) - first
            if known > 0 and moves_alike(config, there):
                found.append(
                    f"{known} of the {config.n_trajectories - first} trajectories held out of {name} have motions that "
                    f"are trained on in {other}: the error that will be measured is too small."
                )
    return found
