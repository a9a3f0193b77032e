"""Opens a data set to read, begin or continue it, and checks that it is the intended one."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import zarr
from zarr.buffer import default_buffer_prototype
from zarr.storage import MemoryStore

from cablejax.dataset.bucket import Bucket, place_of
from cablejax.dataset.schema import (
    PARAMETERS,
    SCHEMA,
    DatasetConfig,
    config_from_json,
    config_of_version_1,
    config_to_json,
    digest_of_config,
)
from cablejax.dataset.store import Store
from cablejax.limits import shown
from cablejax.provenance import package_versions
from cablejax.text_file import differences, read_json, version_of
from cablejax.whole_file import DRAFT, draft_folder, whole_file

PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy")
"""Packages whose versions decide the content, besides cablejax itself: those that begin a store must complete it."""

_DIGEST = ((32,), "uint8")


def open_store(path: str | os.PathLike[str]) -> Store:
    """Opens a data set, complete or not, to read it.

    Raises:
        ValueError: there is no data set, or one of a newer schema version; older ones are read.
    """
    store = recorded_store(place_of(path))
    for name in _arrays(store.config):
        if fault := _fault(store, name):
            raise ValueError(
                f"The data set {path} is damaged: {name} {fault}. Run the command that generated it again, which "
                "repairs it, or generate it elsewhere."
            )
    return store


def recorded_store(path: Path | Bucket, mode: Literal["r", "r+"] = "r") -> Store:
    """The data set that a folder says it holds; its arrays are not read and may be damaged.

    Raises:
        ValueError: there is no data set, its description is damaged, or it is of a newer schema version.
    """
    there = path.read("zarr.json") if isinstance(path, Bucket) else (path / "zarr.json").is_file() or None
    if there is None:
        raise ValueError(
            f"{path} holds no data set (no zarr.json): give the folder of one, or generate one in a new folder."
        )
    try:
        group = zarr.open_group(path.zarr(read_only=mode == "r") if isinstance(path, Bucket) else path, mode=mode)
        described = json.loads(there) if isinstance(there, bytes) else read_json(path / "zarr.json")  # pyright: ignore[reportOperatorIssue]
        attributes: dict[str, Any] = dict(described["attributes"])
    except Exception as error:  # zarr raises what its parts raise
        raise ValueError(f"The data set {path} is damaged: {_reason(error)}. Generate it again elsewhere.") from error
    version = version_of(attributes.get("schema"), SCHEMA, path)
    recorded = attributes.get("config", {})
    if attributes.get("config_digest") != digest_of_config(recorded):
        raise ValueError(
            f"The configuration recorded in {path} was altered: it no longer matches its digest. "
            "Restore its zarr.json, or generate the data set again elsewhere."
        )
    if version == 1:
        recorded = config_of_version_1(recorded)
    versions = attributes.get("versions")
    if not isinstance(versions, dict):
        raise ValueError(f"The data set {path} is damaged: its versions are {shown(versions)}. Generate it again.")
    return Store(path, config_from_json(DatasetConfig, recorded), recorded, versions, group)


def _arrays(config: DatasetConfig) -> dict[str, tuple[tuple[int, ...], str]]:
    """Shape of one trajectory and dtype of every array in the store."""
    return {**config.array_shapes(), "digest": _DIGEST}


def _fault(store: Store, name: str) -> str | None:
    """What is wrong with the description of an array, or None."""
    shape, dtype = _arrays(store.config)[name]
    try:
        array = zarr.open_array(store.group.store, path=name, mode="r")
        came = (array.shape, str(array.dtype), (array.shards or array.chunks)[0], array.fill_value)
        expected = ((store.config.n_trajectories, *shape), dtype, store.config.shard_size, 0)
        if came != expected:
            return f"has (shape, type, shard, default) {came}, expected {expected}"
        return None if _keeps(array) else "is encoded in a way that loses what is written"
    except Exception as error:  # zarr raises what its parts raise
        if isinstance(store.path, Bucket) and not isinstance(error, (FileNotFoundError, ValueError, KeyError)):
            with store.path.reached():
                raise
        return f"cannot be used: {_reason(error)}"


def _keeps(array: zarr.Array[Any]) -> bool:
    """Whether an array that is described like this one gives back what is written. Raises what its codecs raise.

    Descriptions are not compared with new ones, for versions of zarr word the same codecs differently.
    """
    described = array.metadata.to_buffer_dict(default_buffer_prototype())
    like = zarr.open_array(MemoryStore(dict(described)), mode="r+")
    like[0] = 1
    return bool(np.all(like[0] == 1))


def _reason(error: Exception) -> str:
    return shown(next(iter(str(error).splitlines()), repr(error)).rstrip("."))


def open_or_create(path: str | os.PathLike[str] | Bucket, config: DatasetConfig) -> Store:
    """Opens the data set of `config` to continue it, or creates it. Safe when several processes do so at once.

    Raises:
        ValueError: the folder holds something else, a newer schema version, another configuration, or was begun by
            other package versions. Damaged descriptions of arrays are mended.
    """
    place, versions = place_of(path), package_versions(PACKAGES)
    if isinstance(place, Bucket):
        _create_in_bucket(place, config, versions)
    elif place.exists() and not place.is_dir():
        raise ValueError(f"{place} is a file, expected a folder to write a data set to. Give another place.")
    elif not (place / "zarr.json").is_file():
        _create(place, config, versions)
    store = recorded_store(place, "r+")
    changes = _changes(store.recorded, config_to_json(config))
    if changes:
        raise ValueError(
            f"{place} holds a data set of another configuration: {changes}. Give another folder, or the configuration "
            "with which it was begun. Nothing was changed."
        )
    if not store.info().complete:
        require_same_versions(store)
    faulty = [f"{name}/zarr.json" for name in _arrays(config) if _fault(store, name)]
    descriptions = _descriptions(config, versions) if faulty else {}
    for name in faulty:  # the trajectories stay: each is checked against its digest
        _write(place, name, descriptions[name])
    return recorded_store(place, "r+") if faulty else store


def require_same_versions(store: Store) -> None:
    """Raises ValueError if the data set was begun with other packages, whose trajectories cannot be mixed with ours."""
    if changes := _changes(store.versions, package_versions(PACKAGES)):
        raise ValueError(
            f"{store.path} was begun with other packages: {changes}. Trajectories of different versions cannot be "
            "mixed: install those versions, or generate in another folder. Nothing was changed."
        )


def _changes(stored: Mapping[str, Any], asked: Mapping[str, Any]) -> str:
    found = differences(stored, asked).items()
    return "; ".join(f"{name} is {old!r} in the store and {new!r} here" for name, (old, new) in found)


def _create(path: Path, config: DatasetConfig, versions: dict[str, str]) -> None:
    """Makes the empty store under a temporary name and renames it: it appears whole, and only once.

    Into a folder that cannot be replaced, as a mounted one, its own description is written last; a process that was
    killed before may have left the others there.

    Raises:
        ValueError: the folder holds anything else.
    """
    path = path.resolve()
    folders = [path / name for name in _arrays(config)]
    own = {place / f"zarr.json{end}" for place in folders for end in ("", DRAFT)} | {
        path / f"zarr.json{DRAFT}",
        *folders,
    }
    if any(file not in own for file in path.rglob("*")):
        if (path / "zarr.json").is_file():  # another process was first
            return
        raise ValueError(
            f"{path} exists and holds files other than a data set. Give an empty or new folder; nothing was changed."
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    with draft_folder(path) as draft:
        _fill(draft, config, versions)
        try:
            draft.rename(path)
        except OSError:
            if (path / "zarr.json").is_file():  # another process was first
                return
            if not path.is_dir():
                raise
            for name, content in _descriptions(config, versions).items():
                _write(path, name, content)


def _create_in_bucket(bucket: Bucket, config: DatasetConfig, versions: dict[str, str]) -> None:
    """Makes the empty store, unless there is one: its own description last, as it says that the others are there.

    Of two processes that do so at once, the later one writes what the earlier one wrote.
    """
    if bucket.read("zarr.json") is not None:
        return
    names = bucket.names()
    if "zarr.json" in names:  # another process was first
        return
    if any(not name.endswith("/zarr.json") for name in names):
        raise ValueError(f"{bucket} holds objects, but no data set. Give a new prefix; nothing was changed.")
    for name, content in _descriptions(config, versions).items():
        _write(bucket, name, content)


def _write(place: Path | Bucket, name: str, content: bytes) -> None:
    """Writes a description, whole or not at all."""
    if isinstance(place, Bucket):
        place.write(name, content)
        return
    (place / name).parent.mkdir(exist_ok=True)
    with whole_file(place / name) as stream:
        stream.write(content)


def _descriptions(config: DatasetConfig, versions: dict[str, str]) -> dict[str, bytes]:
    """The files of an empty store by their names, its own last, as it says that the others are there."""
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / "draft"
        _fill(draft, config, versions)
        files = sorted(draft.rglob("zarr.json"), key=lambda file: file.parent == draft)
        return {str(file.relative_to(draft)): file.read_bytes() for file in files}


def _fill(folder: Path, config: DatasetConfig, versions: dict[str, str]) -> None:
    """Writes an empty store into a new folder."""
    group = zarr.create_group(
        folder,
        attributes={
            "schema": SCHEMA,
            "config": config_to_json(config),
            "config_digest": digest_of_config(config_to_json(config)),
            "versions": versions,
            "parameters": list(PARAMETERS),
        },
    )
    for name, (shape, dtype) in _arrays(config).items():
        per_trajectory = dtype == "float32"  # the small arrays are one plain chunk per shard
        group.create_array(
            name,
            shape=(config.n_trajectories, *shape),
            dtype=dtype,
            chunks=(1 if per_trajectory else config.shard_size, *shape),
            shards=(config.shard_size, *shape) if per_trajectory else None,
            fill_value=0,
        )
