"""Opening a data set to read it, or to begin or continue it, with the checks that it is the one that is meant."""

from __future__ import annotations

import importlib.metadata
import os
import shutil
from pathlib import Path
from typing import Any, Literal

import zarr

from cablejax import __version__
from cablejax.dataset.schema import (
    PARAMETERS,
    SCHEMA,
    DatasetConfig,
    config_from_json,
    config_of_version_1,
    config_to_json,
    differences,
    digest_of_config,
)
from cablejax.dataset.store import Store
from cablejax.limits import shown
from cablejax.schema_version import version_of
from cablejax.text_file import read_json

PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy")
"""Packages whose versions decide the content, besides cablejax itself: those that begin a store must complete it."""

_DIGEST = ((32,), "uint8")


def open_store(path: str | os.PathLike[str], *, mode: Literal["r", "r+"] = "r") -> Store:
    """Opens a data set, complete or not, to read ("r") or also to write its shards ("r+").

    Raises:
        ValueError: there is no data set, or one of a newer schema version; older ones are read.
    """
    store = _recorded(Path(path), mode)
    for name in _arrays(store.config):
        if fault := _fault(store, name):
            raise ValueError(
                f"The data set {path} is damaged: {name} {fault}. Run the generation that began it again, which mends "
                "it, or generate it elsewhere."
            )
    return store


def _recorded(path: Path, mode: Literal["r", "r+"]) -> Store:
    """The data set that a folder says it holds, without a look at its arrays."""
    if not (path / "zarr.json").is_file():
        raise ValueError(f"{path} holds no data set (no zarr.json). Generate one there, or give another folder.")
    try:
        group = zarr.open_group(path, mode=mode)
        attributes: dict[str, Any] = dict(read_json(path / "zarr.json")["attributes"])
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
        array = zarr.open_array(store.path / name, mode="r")
        came = (array.shape, str(array.dtype), (array.shards or array.chunks)[0], array.fill_value)
    except Exception as error:  # zarr raises what its parts raise
        return f"cannot be opened: {_reason(error)}"
    expected = ((store.config.n_trajectories, *shape), dtype, store.config.shard_size, 0)
    return None if came == expected else f"has (shape, type, shard, default) {came}, expected {expected}"


def _reason(error: Exception) -> str:
    return shown(next(iter(str(error).splitlines()), repr(error)).rstrip("."))


def open_or_create(path: str | os.PathLike[str], config: DatasetConfig) -> Store:
    """Opens the data set of `config` to continue it, or creates it. Safe when several processes do so at once.

    Raises:
        ValueError: the folder holds something else, a newer schema version, another configuration, or was begun by
            other package versions. Damaged descriptions of arrays are mended.
    """
    path, versions = Path(path), package_versions()
    if path.exists() and not path.is_dir():
        raise ValueError(f"{path} is a file, expected a folder to write a data set to. Give another path.")
    if path.is_dir() and any(path.iterdir()) and not (path / "zarr.json").is_file():
        raise ValueError(f"{path} exists and holds no data set. Give an empty or new folder; nothing was changed.")
    if not path.is_dir() or not any(path.iterdir()):
        _create(path, config, versions)
    store = _recorded(path, "r+")
    changes = differences(store.recorded, config_to_json(config))
    if changes:
        raise ValueError(
            f"{path} holds a data set of another configuration: {'; '.join(changes)}. "
            "Give another folder, or the configuration that the store was begun with. Nothing was changed."
        )
    changes = differences(store.versions, versions)
    if changes and not store.info().complete:
        raise ValueError(
            f"{path} was begun with other packages: {'; '.join(changes)}. Trajectories of two versions are not mixed: "
            "install those versions, or generate in another folder. Nothing was changed."
        )
    if faulty := [name for name in _arrays(config) if _fault(store, name)]:
        draft = _draft(path, config, versions)
        for name in faulty:  # the trajectories stay: each is checked against its digest
            (path / name).mkdir(exist_ok=True)
            os.replace(draft / name / "zarr.json", path / name / "zarr.json")
        shutil.rmtree(draft)
        store = _recorded(path, "r+")
    return store


def package_versions() -> dict[str, str]:
    """Versions of the packages that decide the content."""
    versions = {"cablejax": __version__}
    for name in PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions


def _create(path: Path, config: DatasetConfig, versions: dict[str, str]) -> None:
    """Makes the empty store under a temporary name and renames it: it appears whole, and only once."""
    draft = _draft(path, config, versions)
    try:
        draft.rename(path)
    except OSError:  # another process was first
        shutil.rmtree(draft)
        if not (path / "zarr.json").is_file():
            raise


def _draft(path: Path, config: DatasetConfig, versions: dict[str, str]) -> Path:
    """An empty store next to the place where one is wanted."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.parent / f".{path.name}.{os.getpid()}.draft"
    shutil.rmtree(draft, ignore_errors=True)
    try:
        group = zarr.create_group(
            draft,
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
    except BaseException:  # a full disk
        shutil.rmtree(draft, ignore_errors=True)
        raise
    return draft
