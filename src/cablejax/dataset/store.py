"""The data set on disk: a Zarr v3 group in which a shard exists once its digests do.

    keypoints [M, T + 1, N, 2]   gripper_pose [M, T + 1, Q, 3]   gripper_twist [M, T, Q, 3]   float32
    parameters [M, 3] float64    attempts [M] int32              digest [M, 32] uint8, SHA-256 of each trajectory

Every array is sharded alike: one file per shard of trajectories, in the large arrays with an inner chunk for each.
The digests of a shard are written last, each file by an atomic rename, so that a process killed at any instant leaves
either a whole shard or one that the next run makes again. Shards belong to one process each, so processes never write
the same file.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import zarr

from cablejax.dataset.bucket import Bucket, UnreachableError
from cablejax.dataset.schema import Block, DatasetConfig
from cablejax.whole_file import naming


class MissingShardError(ValueError):
    """A shard is read that has not been generated yet."""


@dataclasses.dataclass(frozen=True)
class DatasetInfo:
    """Summary of a store.

    Attributes:
        n_complete: trajectories on disk in complete shards.
        attempts: motions drawn in vain, over all complete shards.
        digest: SHA-256 over all trajectories, or None until all are there. It does not depend on the shard size.
    """

    n_complete: int
    attempts: int
    digest: str | None

    @property
    def complete(self) -> bool:
        """Whether every trajectory is there."""
        return self.digest is not None


@dataclasses.dataclass(frozen=True)
class Store:
    """An open data set. Made by `opening.open_store` or `opening.open_or_create`.

    Attributes:
        path: its folder, or where it is in object storage.
        config: what was asked for; `recorded` as an object.
        recorded: the configuration as it stands in the store.
        versions: package versions that began it.
        group: the Zarr group.
    """

    path: Path | Bucket
    config: DatasetConfig
    recorded: dict[str, Any]
    versions: dict[str, str]
    group: zarr.Group

    @property
    def names(self) -> set[str]:
        """What a store holds at its top, besides its writers' locks."""
        return {"zarr.json", *self.config.array_shapes(), "digest"}

    def status(self, shard: int) -> Literal["missing", "complete", "corrupt"]:
        """Whether a shard is on disk and intact: reads it and compares the digests."""
        try:
            self.read_shard(shard)
        except MissingShardError:
            return "missing"
        except UnreachableError:
            raise
        except ValueError:
            return "corrupt"
        return "complete"

    def write_shard(self, shard: int, block: Block) -> None:
        """Writes one whole shard; it counts from the moment its digests are on disk.

        Raises:
            ValueError: the block's arrays do not have the shapes and dtypes of this shard.
        """
        rows = self._slice(shard)
        for name, (shape, dtype) in self.config.array_shapes().items():
            array, expected = getattr(block, name), (rows.stop - rows.start, *shape)
            if array.shape != expected or array.dtype != dtype:
                raise ValueError(
                    f"Shard {shard}: {name} is {array.dtype}{list(array.shape)}, expected {dtype}{list(expected)}."
                )
        self._clear(shard)
        with self._reached():
            for name in self.config.array_shapes():
                self._array(name)[rows] = getattr(block, name)
            self._array("digest")[rows] = block.digests()

    def read_shard(self, shard: int) -> Block:
        """One shard, checked against its digests.

        Raises:
            ValueError: the shard is not complete, truncated or corrupt.
        """
        rows = self._slice(shard)
        try:
            digest = self._load("digest", rows)
            if not digest.any():
                raise MissingShardError(
                    f"Shard {shard} of {self.path} has not been generated yet. Run the same generation again to make "
                    "it."
                )
            block = Block(**{name: self._load(name, rows) for name in self.config.array_shapes()})
        except (MissingShardError, UnreachableError):
            raise
        except Exception as error:  # a damaged file may fail in any codec
            raise ValueError(self._damaged(shard, f"cannot be decoded ({error})")) from error
        if not np.array_equal(digest, block.digests()):
            raise ValueError(self._damaged(shard, "does not match its checksums"))
        return block

    def read(self, rows: Sequence[int] | np.ndarray | None = None) -> Block:
        """The given trajectories (all by default), in that order, checked against their digests.

        Raises:
            ValueError: a shard that is needed is missing or damaged, or a row does not exist.
        """
        rows = np.arange(self.config.n_trajectories) if rows is None else np.asarray(rows, dtype=int)
        if len(rows) == 0 or rows.min() < 0 or rows.max() >= self.config.n_trajectories:
            raise ValueError(
                f"Rows {rows[:5]}... requested of {self.path}, expected some of 0..{self.config.n_trajectories - 1}."
            )
        out = {
            name: np.empty((len(rows), *shape), dtype) for name, (shape, dtype) in self.config.array_shapes().items()
        }
        for shard in np.unique(rows // self.config.shard_size):
            block = self.read_shard(int(shard))
            here = np.flatnonzero(rows // self.config.shard_size == shard)
            for name, array in out.items():
                array[here] = getattr(block, name)[rows[here] - shard * self.config.shard_size]
        return Block(**out)

    def parameters(self) -> np.ndarray:
        """The columns of `schema.PARAMETERS` of every trajectory, not checked against its digest, shape [M, 3]."""
        return self._load("parameters", slice(None))

    def digests(self) -> tuple[np.ndarray, np.ndarray]:
        """Digest of each trajectory, zero where it is not there, shape [M, 32]; and its attempts, shape [M]."""
        digest = np.zeros((self.config.n_trajectories, 32), np.uint8)
        attempts = np.zeros(self.config.n_trajectories, np.int32)
        for shard in range(self.config.n_shards):
            try:
                rows = self._slice(shard)
                attempts[rows], digest[rows] = self._load("attempts", rows), self._load("digest", rows)
            except UnreachableError:
                raise
            except Exception:  # a damaged shard counts as not there
                continue
        return digest, attempts

    def info(self) -> DatasetInfo:
        """Summary of what is on disk, from the digests alone: fast, and reads no trajectory."""
        digest, attempts = self.digests()
        done = digest.any(axis=1)
        return DatasetInfo(
            n_complete=int(done.sum()),
            attempts=int(attempts[done].sum()),
            digest=hashlib.sha256(digest.tobytes()).hexdigest() if done.all() else None,
        )

    def _array(self, name: str) -> zarr.Array:
        try:
            return cast(zarr.Array, self.group[name])
        except KeyError:
            raise ValueError(
                f"{self.path} no longer has {name}: was it removed? Start again in another folder."
            ) from None

    def _load(self, name: str, rows: slice) -> np.ndarray:
        with self._reached():
            return np.asarray(self._array(name)[rows])

    def _reached(self) -> contextlib.AbstractContextManager[None]:
        return self.path.reached() if isinstance(self.path, Bucket) else naming(self.path)

    def _slice(self, shard: int) -> slice:
        if not 0 <= shard < self.config.n_shards:
            raise ValueError(f"Shard {shard} requested of {self.path}, which has shards 0..{self.config.n_shards - 1}.")
        rows = self.config.shard_rows(shard)
        return slice(rows.start, rows.stop)

    def _clear(self, shard: int) -> None:
        """Removes a shard with whatever a killed writer left of it, the digests first."""
        for name in ("digest", *self.config.array_shapes()):
            if isinstance(self.path, Bucket):
                whole = f"{name}/c/{shard}"
                self.path.remove([one for one in self.path.names(f"{name}/c") if f"{one}/".startswith(f"{whole}/")])
                continue
            folder = self.path / name / "c" / str(shard)
            if folder.is_dir():
                shutil.rmtree(folder)
            else:  # a one-dimensional array keeps its shards as files
                for file in folder.parent.glob(f"{shard}*"):
                    if file.name == str(shard) or file.name.startswith(f"{shard}."):
                        file.unlink()

    def _damaged(self, shard: int, what: str) -> str:
        rows = self.config.shard_rows(shard)
        return (
            f"Shard {shard} of {self.path} (trajectories {rows.start}..{rows.stop - 1}) {what}. "
            "Run the same generation again: it replaces this shard and keeps the others."
        )
