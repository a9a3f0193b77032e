"""Checks gap logs against their format and against what a cable and its recording can be."""

from __future__ import annotations

import contextlib
import difflib
import math
import os
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from cablejax.cable_file import NUMBERS, cable_from_fields
from cablejax.limits import LIMITS, require, shown
from cablejax.log_geometry import geometry_fault
from cablejax.text_file import json_text, unknown_key, version_of
from cablejax.types import GapLog

SCHEMA = "cablejax-gap-log/1"
"""Format and version of a gap log."""

DTYPES = {
    "time": np.float64,
    "keypoints": np.float32,
    "gripper_pose": np.float32,
    "gripper_command": np.float32,
    "episode_length": np.int32,
    "hold": np.bool_,
}
"""Type of each array of a gap log."""
META_FIELDS = (
    "schema", "cable", "table", "gravity_m_per_s2", "keypoint_arclength_m", "grasp", "motion", "source",
)  # fmt: skip
"""Fields that `meta` has to have."""
# By how much the first and the last mark may miss the cable's ends, relative to its length.
_ENDS = 0.05
# Of the samples on an even clock of its usual interval, an episode has at least one in so many.
_LOST = 20
_FRICTION = "friction_coefficient"
# How alike the spellings of two keys are that mean one, see `difflib`.
_NEARLY = 0.8
# Columns of a pose and of a twist, by the dimension of the keypoints.
_POSE_WIDTH, _TWIST_WIDTH = {2: 3, 3: 7}, {2: 3, 3: 6}


class GapLogError(ValueError):
    """A gap log that violates the format."""


@contextlib.contextmanager
def reading_export(path: os.PathLike[str]) -> Iterator[None]:
    """Turns the various errors that libraries raise on a damaged export into one that names the file or folder."""
    try:
        yield
    except GapLogError as error:
        raise GapLogError(f"{path}: {error}") from error
    except Exception as error:
        raise GapLogError(
            f"{path} could not be read ({type(error).__name__}: {error}). Export the log again."
        ) from error


def meta_text(meta: Mapping[str, Any], indent: int | None = None) -> str:
    """JSON of the `meta` of a log, NaN included; raises `GapLogError` if JSON cannot hold it."""
    try:
        return json_text(dict(meta), indent=indent)
    except ValueError as error:
        raise GapLogError(f"Field 'meta' cannot be written: {error}") from None


def validate(log: GapLog) -> None:
    """Checks a gap log; raises `GapLogError` with the field, what it is and what was expected."""
    try:
        _validate_arrays(log)
        _validate_meta(log)
    except ValueError as error:
        raise GapLogError(str(error)) from None
    if fault := geometry_fault(log):
        raise GapLogError(fault)


def _validate_arrays(log: GapLog) -> None:
    for name, dtype in DTYPES.items():
        array = getattr(log, name)
        if array is None and name == "hold":
            continue
        if not isinstance(array, np.ndarray) or array.dtype != dtype:
            found = array.dtype if isinstance(array, np.ndarray) else type(array).__name__
            raise ValueError(f"Field '{name}' is {found}, expected an array of {np.dtype(dtype)}.")
    if log.keypoints.ndim != 4 or log.keypoints.shape[3] not in _POSE_WIDTH:
        raise ValueError(f"Field 'keypoints' has shape {log.keypoints.shape}, expected (E, T, N, 2) or (E, T, N, 3).")
    episodes, samples, points, dimension = log.keypoints.shape
    if episodes < 1 or points < 2:
        raise ValueError(
            f"Field 'keypoints' has shape {log.keypoints.shape}, expected at least one episode and two keypoints: the "
            "first and the last are at the grippers."
        )
    # any number of grippers but none
    grippers = max(log.gripper_pose.shape[2], 1) if log.gripper_pose.ndim == 4 else 2
    shapes = {
        "time": (episodes, samples),
        "gripper_pose": (episodes, samples, grippers, _POSE_WIDTH[dimension]),
        "gripper_command": (episodes, samples, grippers, _TWIST_WIDTH[dimension]),
        "episode_length": (episodes,),
        "hold": (episodes, samples),
    }
    for name, shape in shapes.items():
        array = getattr(log, name)
        if array is not None and array.shape != shape:
            raise ValueError(f"Field '{name}' has shape {array.shape}, expected {shape} for these keypoints.")
    for index, length in enumerate(log.episode_length):
        if not 1 <= length <= samples:
            raise ValueError(f"Field 'episode_length' is {length} in episode {index}, expected 1 to {samples}.")
        time = log.time[index, :length]
        if not np.isfinite(time).all() or (np.diff(time) <= 0).any():
            raise ValueError(f"Field 'time' does not increase, or is not finite, in episode {index}.")
        _check_clock(time, f"of episode {index}")
        # the last command is held for no sample
        for name, limit, end in (("gripper_pose", "coordinate", length), ("gripper_command", "speed", length - 1)):
            values = getattr(log, name)[index, :end]
            if not np.isfinite(values).all():
                raise ValueError(f"Field '{name}' is not finite in episode {index}; only keypoints may be NaN.")
            largest = float(np.abs(values).max(initial=0.0))
            require(largest, limit, f"The largest entry of field '{name}' in episode {index}")
        if np.isinf(log.keypoints[index, :length]).any():
            raise ValueError(f"Field 'keypoints' is infinite in episode {index}; a keypoint not observed is NaN.")
        if dimension == 3:
            norm = np.linalg.norm(log.gripper_pose[index, :length, :, 3:], axis=-1)
            if np.abs(norm - 1).max() > 1e-3:
                raise ValueError(f"Field 'gripper_pose' has quaternions not of unit length in episode {index}.")


def _check_clock(time: Float[np.ndarray, " T"], which: str) -> None:
    """Raises unless the samples are as far apart as those of a recording may be."""
    step = np.diff(time)
    if not len(step):
        return
    usual, advice = round(float(np.median(step)), 9), "Is the time in seconds (in a layout: `time_unit`)?"
    begin = "Times are seconds from the episode's start: subtract the first of each episode."
    require(abs(float(time[0])), "duration", f"The first time {which}", begin)
    slow = " If it is, record at least once a second: between samples poses are interpolated."
    require(usual, "sample_interval", f"The usual time between samples {which}", advice + (slow if usual > 1 else ""))
    require(float(time[-1] - time[0]), "duration", f"The time from the first to the last sample {which}", advice)
    if time[-1] - time[0] > _LOST * usual * len(time):
        raise ValueError(
            f"Field 'time' has a pause of {step.max():.4g} s after sample {int(step.argmax())} {which}, where "
            f"{usual:.4g} s is usual: split the episode there."
        )


def _validate_meta(log: GapLog) -> None:
    meta = log.meta
    if not isinstance(meta, dict):
        raise ValueError(f"Field 'meta' is a {type(meta).__name__}, expected a JSON object.")
    if "schema" in meta:
        version_of(meta["schema"], SCHEMA, "Field 'meta'")
    for name in META_FIELDS:
        if name not in meta:
            raise ValueError(f"Field 'meta.{name}' is missing.")
    points, grippers = log.keypoints.shape[2], log.gripper_pose.shape[2]
    _check_cable(meta, points, in_space=log.keypoints.shape[3] == 3)
    for name, length in (("gravity_m_per_s2", 3), ("keypoint_arclength_m", points)):
        value = meta[name]
        if not isinstance(value, list) or len(value) != length or not all(v in LIMITS["finite"] for v in value):
            raise ValueError(f"Field 'meta.{name}' is {shown(value)}, expected {length} finite numbers.")
    gravity = meta["gravity_m_per_s2"]
    require(math.hypot(*gravity), "gravity", "The magnitude of field 'meta.gravity_m_per_s2'")
    if log.keypoints.shape[3] == 2 and gravity[2] > 0:
        raise ValueError(f"Field 'meta.gravity_m_per_s2' is {gravity}: off the table, expected the third negative.")
    marks, cable_length = np.asarray(meta["keypoint_arclength_m"], float), float(meta["cable"]["length_m"])
    if (np.diff(marks) <= 0).any():
        raise ValueError("Field 'meta.keypoint_arclength_m' does not increase.")
    if np.abs(marks[[0, -1]] - [0.0, cable_length]).max() > _ENDS * cable_length:
        raise ValueError(
            f"Field 'meta.keypoint_arclength_m' goes from {marks[0]:g} to {marks[-1]:g} m, expected 0 to the cable's "
            f"length of {cable_length:g} m: the first and the last keypoint are at the grippers."
        )
    if not (marks[1:-1] > 0.0).all() or not (marks[1:-1] < cable_length).all():
        raise ValueError(
            "Field 'meta.keypoint_arclength_m' has keypoints beyond the cable: expected all within 0 to "
            f"{cable_length:g} m."
        )
    for name, length in (("grasp", grippers), ("motion", len(log.episode_length))):
        value = meta[name]
        if not isinstance(value, list) or len(value) != length or not all(isinstance(entry, str) for entry in value):
            raise ValueError(f"Field 'meta.{name}' is {shown(value)}, expected {length} strings.")
    if not isinstance(meta["source"], str):
        raise ValueError(f"Field 'meta.source' is {shown(meta['source'])}, expected text.")


def _check_cable(meta: dict[str, Any], points: int, *, in_space: bool) -> None:
    """Raises unless the cable and its table could exist."""
    cable, table = meta["cable"], {_FRICTION: 0.0} if meta["table"] is None else meta["table"]
    for name, value in (("cable", cable), ("table", table)):
        if not isinstance(value, dict):
            raise ValueError(f"Field 'meta.{name}' is {shown(value)}, expected an object.")
    if strangers := [key for key in table if key in NUMBERS and key != _FRICTION]:
        raise ValueError(f"Field 'meta.table' has {', '.join(strangers)}, which belongs into 'meta.cable'.")
    if not in_space and meta["table"] is None and cable.get(_FRICTION):
        raise ValueError(f"Field 'meta.cable' has {_FRICTION}, which belongs into 'meta.table', and that is null.")
    known = {key: value for key, value in cable.items() if key in NUMBERS and key != _FRICTION}
    lacking = {key: LIMITS[name].unit for key, (name, _) in NUMBERS.items() if key not in {**known, _FRICTION: None}}
    for key in cable:
        # a new field may be added, but one that is nearly of the cable was meant to be
        if key not in NUMBERS and difflib.get_close_matches(key, lacking, 1, _NEARLY):
            raise ValueError(f"Field 'meta.cable' has {unknown_key(key, lacking)}")
    known |= {key: value for key, value in table.items() if key == _FRICTION}
    cable_from_fields({**known, "keypoints": points}, "Field 'meta.cable' or 'meta.table'")
