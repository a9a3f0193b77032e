"""Data sets larger than memory: a buffer of trajectories, in which blocks from the stores take turns.

The order of the blocks depends only on the seed, and the buffer at a turn only on that order, so a training that is
killed and resumed sees the same data. The next block is read while the devices compute.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Sequence

import jax
import numpy as np

from cablejax.dataset.store import Store
from cablejax.dataset.windows import concatenate, read_trajectories
from cablejax.types import Trajectory


@dataclasses.dataclass(frozen=True)
class StreamedData:
    """Trajectories of stores, some of which are in memory at a time. Made by `split.read_split`.

    Attributes:
        stores: complete, of one protocol.
        blocks: number of a store and rows of it, as many in each block; a row may be in two blocks.
        buffer: blocks that are in memory.
        seed: of the order in which blocks come; in each pass all of them do, in an order of its own.
    """

    stores: tuple[Store, ...]
    blocks: tuple[tuple[int, range], ...]
    buffer: int
    seed: int = 0

    @property
    def identity(self) -> list[np.ndarray]:
        """Arrays that determine all contents of the buffer, for a fingerprint."""
        digests = [np.frombuffer(bytes.fromhex(store.info().digest or ""), np.uint8) for store in self.stores]
        rows = np.array([(store, rows.start, rows.stop) for store, rows in self.blocks])
        return [*digests, rows, np.array([self.buffer, self.seed])]

    def at(self, turn: int) -> Trajectory:
        """The buffer at a turn, as NumPy arrays: the blocks that came in the turns before, each in its place."""
        order = sorted(range(turn, turn + self.buffer), key=lambda number: number % self.buffer)
        return concatenate([self.block(number) for number in order])

    def block(self, number: int) -> Trajectory:
        """The block with this number in the order of streaming, counted from 0 over all passes.

        Raises:
            ValueError: its shard is damaged, or the object storage cannot be reached.
        """
        turn_of_pass, place = divmod(number, len(self.blocks))
        store, rows = self.blocks[np.random.default_rng((self.seed, turn_of_pass)).permutation(len(self.blocks))[place]]
        return read_trajectories(self.stores[store], np.asarray(rows))

    def turns(self, first: int, on_devices: Callable[[Trajectory], Trajectory]) -> Iterator[Trajectory]:
        """The buffer at turn `first` and at all that follow, on devices; the one before is overwritten.

        Args:
            first: turn to begin with; at each, one block of the buffer gives way to another.
            on_devices: puts trajectories there.
        """
        size = len(self.blocks[0][1])
        with concurrent.futures.ThreadPoolExecutor(1) as reader:

            def read(number: int) -> Trajectory:
                return on_devices(self.block(number))

            buffer = on_devices(self.at(first))
            following = reader.submit(read, first + self.buffer)
            for number in itertools.count(first + self.buffer):
                yield buffer
                came, following = following.result(), reader.submit(read, number + 1)
                buffer = _replaced(buffer, came, number % self.buffer * size)


def blocks_of(rows: Sequence[np.ndarray], size: int) -> tuple[tuple[int, range], ...]:
    """Consecutive rows of several stores in blocks of `size`; the last of a store overlaps with the one before it."""
    made = []
    for store, mine in enumerate(rows):
        first, stop = int(mine[0]), int(mine[-1]) + 1
        starts = [*range(first, stop - size, size), stop - size]
        made += [(store, range(start, start + size)) for start in starts]
    return tuple(made)


@functools.partial(jax.jit, donate_argnums=0)
def _replaced(buffer: Trajectory, block: Trajectory, at: int) -> Trajectory:
    return jax.tree.map(lambda whole, part: jax.lax.dynamic_update_slice_in_dim(whole, part, at, axis=0), buffer, block)
