"""The folder of a training: checks that it belongs to this training before anything in it is replaced."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from cablejax.provenance import package_versions
from cablejax.text_file import differences, read_json, version_of, write_json
from cablejax.whole_file import holds_anything, sole_writer

SCHEMA = "cablejax-training/1"
"""Name and version of the folder's layout; `run.json` without it is of version 1."""

RUN, CHECKPOINTS, METRICS, BOARD = "run.json", "checkpoints", "metrics.csv", "tensorboard"
"""What a training's folder holds: its settings, checkpoints, errors by step, and curves for TensorBoard."""

PACKAGES = ("jax", "jaxlib", "flax", "optax")
"""Packages whose versions decide the weights, besides cablejax itself."""

# Fields that are fitted to the data.
_SCALES = "config.model.normalisation"
# What `cablejax train` adds in the end.
_RESULTS = ("weights.safetensors", "card.md", "summary.json")


def claim_folder(
    out_dir: Path,
    run: dict[str, Any],
    *,
    overwrite: bool,
    report: Callable[[str], object] = lambda text: None,
) -> None:
    """Writes `run.json`, with the versions of the packages, into a fresh folder or one that is taken over.

    Args:
        out_dir: the folder.
        run: what decides the outcome of the training, as for JSON: "config" and "data".
        overwrite: whether another training, or files of something else, may be there. The training is deleted; of the
            other files those are replaced that have the names of its own.
        report: called with a line of text if other versions of the packages began this very training.

    Raises:
        ValueError: the folder holds another run, or something else without `overwrite`, or its name is no UTF-8.
    """
    if out_dir.exists() and not out_dir.is_dir():
        raise ValueError(f"{out_dir} is a file, expected a folder for the training. Name another one.")
    try:
        str(out_dir.absolute()).encode()
    except UnicodeEncodeError as error:
        raise ValueError(
            f"The name of {out_dir.absolute()} is no UTF-8, and checkpoints cannot be written there. Name another "
            "folder (--out)."
        ) from error
    path = out_dir / RUN
    run, versions = {"schema": SCHEMA, **json.loads(json.dumps(run))}, package_versions(PACKAGES)
    if path.exists():
        found = _read(path)
        began = found.pop("versions", versions)  # earlier trainings recorded none
        if found == run:
            if others := differences(began, versions):
                changes = ", ".join(f"{name} ({old}, now {new})" for name, (old, new) in others.items())
                report(
                    f"{out_dir} was begun with other packages: {changes}. The training continues, but its weights may "
                    "differ by rounding from those of a single version; install the earlier versions to reproduce "
                    "these exactly."
                )
            return
        if not overwrite:
            raise ValueError(
                f"{out_dir} holds a training that differs in {_changes(found, run)}. Choose another folder, repeat it "
                "with the same configuration and data, or overwrite it (--overwrite)."
            )
        _discard(out_dir)
    elif holds_anything(out_dir):
        if not overwrite:
            raise ValueError(
                f"{out_dir} exists and is not empty, and holds no training. Choose another folder, or write among its "
                "files (--overwrite)."
            )
        for name in (CHECKPOINTS, BOARD):
            if (out_dir / name).exists():
                raise ValueError(
                    f"{out_dir / name} was not made by a training, which needs a folder of that name. Move it "
                    "elsewhere, or choose another folder."
                )
        _discard(out_dir)
    out_dir.mkdir(parents=True, exist_ok=True)
    write_json(path, {**run, "versions": versions})


def _changes(found: Mapping[str, Any], run: Mapping[str, Any]) -> str:
    """In what two trainings differ, in words where their values tell a reader nothing."""
    other = differences(found, run)
    words = []
    if other.pop("data", None):
        words = ["its data, what is held out of them, or the weights to start from (--data, --held-out, --start-from)"]
        # the scales are those of the data
        other = {name: values for name, values in other.items() if not name.startswith(_SCALES)}
    return ", ".join([*(f"{name} ({old}, now {new})" for name, (old, new) in other.items()), *words])


def _read(path: Path) -> dict[str, Any]:
    try:
        found = read_json(path)
    except ValueError as error:
        raise ValueError(
            f"{error} The configuration of the training in {path.parent} is therefore unknown: choose another folder, "
            "or delete this one."
        ) from error
    if not isinstance(found, dict) or not {"config", "data"} <= found.keys():
        raise ValueError(f"{path} was not made by a training: choose another folder.")
    version_of(found.setdefault("schema", SCHEMA), SCHEMA, path)
    return found


def _discard(out_dir: Path) -> None:
    """Deletes what a training wrote, its name last: until then it can be deleted again."""
    checkpoints, board = out_dir / CHECKPOINTS, out_dir / BOARD
    with sole_writer(out_dir):
        for step in checkpoints.glob("[0-9]*"):
            shutil.rmtree(step)
        for events in board.glob("events.*"):
            events.unlink()
        for name in (METRICS, *_RESULTS, RUN):
            (out_dir / name).unlink(missing_ok=True)
