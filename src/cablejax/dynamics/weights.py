"""Trained weights on disk: one safetensors file with all that is needed to use them, and no executable code.

The file's metadata has one key, "cablejax", whose JSON object holds

    schema   "cablejax-weights/1"
    config   the `ModelConfig`, normalisation included
    info     where the weights come from: the cable (keys of the cable file), the inputs of a conditioned network in
             its data (`control.cable_inputs`), data sets and their digests, seeds, package versions, kind of machine
    digest   SHA-256 of the tensors, config and info; the released files of version 1.0 have none

and its tensors are the network's, named by their place in it: "processor.0.edge.first.1.kernel".
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.resources
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from cablejax.cable import Cable
from cablejax.cable_file import cable_from_fields
from cablejax.dynamics.config import RECORDED, ModelConfig, Normalisation
from cablejax.dynamics.model import structure_of
from cablejax.limits import require
from cablejax.simulate.chain.statics import Statics
from cablejax.text_file import json_text, parse_json, version_of
from cablejax.whole_file import whole_file

SCHEMA = "cablejax-weights/1"
"""Name and version of the file's layout."""

FILE_NAME = "weights.safetensors"
"""Name of the file in a training's folder."""

SUFFIX = ".safetensors"
"""Ending of files with weights."""

_KEY = "cablejax"


class WeightsError(ValueError):
    """A weights file that cannot be used: says what was found, what was expected and what to do."""


def save_weights(
    path: str | os.PathLike[str], model_config: ModelConfig, weights: nnx.State, info: Mapping[str, Any]
) -> None:
    """Writes weights and their description, whole or not at all.

    Args:
        path: the file, by custom `*.safetensors`.
        model_config: of the network, with the normalisation that it was trained with.
        weights: all arrays of a network of this configuration.
        info: a JSON object: where they come from. It goes into the file as it is, so it should name no local path.

    Raises:
        WeightsError: the weights do not fit the configuration.
    """
    path = Path(path)
    tensors = {name: np.asarray(leaf) for name, leaf in _named(weights).items()}
    _check_tensors(tensors, _named(structure_of(model_config)[1]), f"The weights to be saved in {path}")
    content = {"schema": SCHEMA, "config": RECORDED | dataclasses.asdict(model_config), "info": dict(info)}
    content = json.loads(json_text(content, allow_nan=False))  # as it will be read
    data = save(tensors, metadata={_KEY: json.dumps(content | {"digest": _digest(tensors, content)})})
    with whole_file(path) as stream:
        stream.write(data)


def load_weights(source: str | os.PathLike[str]) -> tuple[ModelConfig, nnx.GraphDef, nnx.State]:
    """The network in a file, in a training's folder, or released under a name, as `apply` takes it.

    Args:
        source: a weights file, a folder that `cablejax train` wrote, or the name of a released model.

    Raises:
        WeightsError: there is no such file, it is no weights file or one of another schema, or its tensors do not fit
            its configuration.
    """
    path, content = _open(source)
    config = _config_of(content, path)
    graphdef, expected = structure_of(config)
    with safe_open(path, framework="numpy") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    _check_tensors(tensors, _named(expected), path)
    if content.get("digest", digest := _digest(tensors, content)) != digest:
        raise WeightsError(
            f"{path} is damaged, or was changed after training: it does not match its digest. Restore it, or run the "
            "training's command again."
        )
    flat = nnx.to_flat_state(expected)
    leaves = [(key, variable.replace(jnp.asarray(tensors[_name(key)]))) for key, variable in flat]
    return config, graphdef, nnx.from_flat_state(leaves)


def load_info(source: str | os.PathLike[str]) -> dict[str, Any]:
    """The provenance of the weights, as given to `save_weights`; `source` as in `load_weights`."""
    return _open(source)[1]["info"]


def weights_path(source: str | os.PathLike[str]) -> Path:
    """The file of the weights; `source` as in `load_weights`."""
    return _open(source)[0]


def cable_of_weights(source: str | os.PathLike[str]) -> Cable:
    """The nominal cable of the data that a network was trained on; `source` as in `load_weights`.

    Weights that record no cable, as those of version 1 of the data sets' format, have it in their data's configuration.

    Raises:
        WeightsError: there is no such file, or it names no cable.
    """
    path, content = _open(source)
    try:
        info = content["info"]
        if "cable" in info:
            return cable_from_fields(info["cable"], f"{path}: info.cable")
        flat = info["data"][0]["config"]["cable"]
        return Cable(**{field.name: flat[field.name] for field in dataclasses.fields(Cable) if field.name in flat})
    except (KeyError, IndexError, TypeError, AttributeError) as error:
        raise WeightsError(
            f"{path} does not say which cable the network was trained on (no {error} in its description). Train it "
            "again with this version of cablejax."
        ) from error
    except ValueError as error:
        raise WeightsError(str(error)) from error


def released_names() -> tuple[str, ...]:
    """Names of the models released with this package."""
    folder = _folder()
    if not folder.is_dir():
        return ()
    return tuple(sorted(p.name.removesuffix(SUFFIX) for p in folder.iterdir() if p.name.endswith(SUFFIX)))


def _folder():
    return importlib.resources.files("cablejax") / "weights"


def _released(name: str) -> Path:
    if name not in released_names():
        known = ", ".join(released_names()) or "none in this installation"
        raise WeightsError(
            f"There is no file or folder {name!r} here, and no model is released under that name (released: {known})."
        )
    return Path(str(_folder() / f"{name}{SUFFIX}"))


def _open(source: str | os.PathLike[str]) -> tuple[Path, dict[str, Any]]:
    """The file that is meant and its description, of this schema."""
    path = Path(source)
    if path.is_dir():
        path = path / FILE_NAME
        if not path.is_file():
            raise WeightsError(f"{path.parent} holds no {FILE_NAME}: is its training complete? Run it again to resume.")
    elif not path.is_file():
        if path.suffix or len(path.parts) != 1:
            raise WeightsError(f"There is no weights file {path}. Train one with `cablejax train`.")
        path = _released(str(source))
    try:
        require(path.stat().st_size, "array_bytes", f"The size of {path}", "Are these the intended weights?")
    except ValueError as error:
        raise WeightsError(str(error)) from None
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
        content = parse_json(metadata.get(_KEY, "null"))
    except (SafetensorError, OSError, ValueError) as error:
        raise WeightsError(f"{path} is no safetensors file, or a damaged one ({error}).") from error
    try:
        version_of(content.get("schema") if isinstance(content, dict) else None, SCHEMA, path)
    except ValueError as error:
        raise WeightsError(str(error)) from error
    if not isinstance(content.get("info"), dict):
        raise WeightsError(f"{path} has schema {SCHEMA!r} without its info: the file is damaged. Save it again.")
    return path, content


def _config_of(content: dict[str, Any], path: Path) -> ModelConfig:
    try:
        recorded: dict[str, Any] = dict(content["config"])
        if (kind := {name: recorded.pop(name, value) for name, value in RECORDED.items()}) != RECORDED:
            raise ValueError(f"{kind}, expected {RECORDED}. Networks for comparison are read by experiments/rivals.py.")
        recorded["normalisation"] = Normalisation(**recorded["normalisation"])
        recorded["statics"] = Statics(**recorded.get("statics", {}))
        return ModelConfig(**recorded)
    except (TypeError, KeyError, AttributeError) as error:
        raise WeightsError(
            f"{path} records a configuration that this version of cablejax does not know ({error}). "
            "Read it with the version that wrote it."
        ) from error
    except ValueError as error:
        raise WeightsError(f"{path} records an impossible configuration: {error}") from error


def _digest(tensors: Mapping[str, np.ndarray], content: Mapping[str, Any]) -> str:
    """SHA-256 of the fingerprint of tensors in the order of their names, their configuration and provenance."""
    of_all = [content["config"], content["info"], fingerprint(dict(tensors))]
    return hashlib.sha256(json.dumps(of_all, sort_keys=True).encode()).hexdigest()


def fingerprint(tree: Any) -> str:
    """Hash of all arrays of a pytree, with their shapes and dtypes."""
    digest = hashlib.blake2b(digest_size=16)
    for leaf in jax.tree.leaves(tree):
        array = np.ascontiguousarray(leaf)
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(array.data)
    return digest.hexdigest()


def _name(key: tuple[Any, ...]) -> str:
    return ".".join(map(str, key))


def _named(weights: nnx.State) -> dict[str, Any]:
    return {_name(key): variable.get_value() for key, variable in nnx.to_flat_state(weights)}


def _check_tensors(tensors: Mapping[str, np.ndarray], expected: Mapping[str, Any], what: Path | str) -> None:
    """Raises unless there is exactly one finite tensor of the right shape and dtype for every weight."""
    faults = [f"{name} is missing" for name in expected if name not in tensors]
    faults += [f"{name} is unknown" for name in tensors if name not in expected]
    for name in expected.keys() & tensors.keys():
        came, wanted = tensors[name], expected[name]
        if came.shape != wanted.shape or came.dtype != wanted.dtype:
            faults.append(f"{name} is {came.dtype}{list(came.shape)}, expected {wanted.dtype}{list(wanted.shape)}")
        elif not np.isfinite(came).all():
            faults.append(f"{name} holds NaN or infinity")
    if faults:
        shown = "; ".join(sorted(faults)[:4]) + (f"; and {len(faults) - 4} more" if len(faults) > 4 else "")
        raise WeightsError(f"{what} does not fit its configuration: {shown}. Save the weights again.")
