"""Reads and writes recorded cable runs: the `cablejax-gap-log/1` format, one `.npz` file per cable set-up.

Files are read without unpickling, checked field by field, and written whole or not at all.
"""

from __future__ import annotations

import dataclasses
import json
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from cablejax.cable import GRAVITY, Cable
from cablejax.json_file import parse_json
from cablejax.log_geometry import geometry_fault
from cablejax.npz import NpzError, read_npz
from cablejax.types import GapLog
from cablejax.whole_file import whole_file

SCHEMA = "cablejax-gap-log/1"
"""Format and version of a gap log."""

_DTYPES = {
    "time": np.float64,
    "keypoints": np.float32,
    "gripper_pose": np.float32,
    "gripper_command": np.float32,
    "episode_length": np.int32,
    "hold": np.bool_,
}
_CABLE_POSITIVE = ("length_m", "diameter_m", "linear_density_kg_per_m", "bending_stiffness_n_m2")
_CABLE_NOT_NEGATIVE = ("bending_damping_s",)
_META_FIELDS = (
    "schema", "cable", "table", "gravity_m_per_s2", "keypoint_arclength_m", "grasp", "motion", "source",
)  # fmt: skip
# By how much the first and the last mark may miss the cable's ends, relative to its length.
_ENDS = 0.05
# Columns of a pose and of a twist, by the dimension of the keypoints.
_POSE_WIDTH, _TWIST_WIDTH = {2: 3, 3: 7}, {2: 3, 3: 6}


class GapLogError(ValueError):
    """A gap log that violates the format."""


@dataclasses.dataclass(frozen=True)
class Episode:
    """One episode of a gap log before padding; the arrays are those of `GapLog` without their leading axis.

    Attributes:
        motion: what the grippers did, for example "approach_u".
        time: seconds from the episode's start, shape [T].
        keypoints: [m], NaN = not observed, shape [T, N, D].
        gripper_pose: shape [T, Q, 3 or 7].
        gripper_command: twist held from `time[t]` to `time[t + 1]`, shape [T, Q, 3 or 6].
        hold: both grippers at rest and the cable settled, shape [T].
    """

    motion: str
    time: Float[np.ndarray, " T"]
    keypoints: Float[np.ndarray, "T N D"]
    gripper_pose: Float[np.ndarray, "T Q P"]
    gripper_command: Float[np.ndarray, "T Q V"]
    hold: np.ndarray


def gap_log_from_episodes(
    episodes: Sequence[Episode],
    cable: Cable,
    *,
    source: str,
    grasp: Sequence[str] = ("clamped", "clamped"),
    keypoint_arclength: Sequence[float] | None = None,
    extra: Mapping[str, Any] | None = None,
) -> GapLog:
    """One gap log of several episodes of the same cable, padded to the longest.

    Args:
        episodes: at least one; their number of samples may differ.
        cable: the cable and table as they are believed to be, which is what the nominal simulator uses.
        source: free text: what recorded this.
        grasp: how each gripper holds the cable.
        keypoint_arclength: of each keypoint [m], shape [N]; by default uniform over the cable.
        extra: fields of `meta` beyond those of the format, which readers that do not know them leave alone.

    Raises:
        GapLogError: no episodes, episodes that do not fit each other or the format, or an extra field that it has.
    """
    if not episodes:
        raise GapLogError("A gap log needs at least one episode, got none.")
    if taken := set(extra or {}) & set(_META_FIELDS):
        raise GapLogError(f"The extra fields {', '.join(sorted(taken))} are fields of the format: choose other names.")
    arclength = cable.keypoint_arclength if keypoint_arclength is None else np.asarray(keypoint_arclength, float)
    lengths = [len(episode.time) for episode in episodes]

    def padded(name: str, fill) -> np.ndarray:
        arrays = [np.asarray(getattr(episode, name)) for episode in episodes]
        rest = arrays[0].shape[1:]
        for array, length in zip(arrays, lengths, strict=True):
            if array.shape != (length, *rest):
                raise GapLogError(
                    f"An episode's {name} has shape {array.shape}, expected {(length, *rest)}: all arrays of an "
                    "episode have its number of samples, and all episodes are of the same cable."
                )
        whole = np.empty((len(arrays), max(lengths), *rest), _DTYPES[name])
        for row, array in zip(whole, arrays, strict=True):
            row[: len(array)] = array
            # Poses and times stay at their last value, so that a reader which ignores the lengths sees a cable at rest.
            row[len(array) :] = array[-1] if fill is None else fill
        return whole

    log = GapLog(
        time=padded("time", None),
        keypoints=padded("keypoints", np.nan),
        gripper_pose=padded("gripper_pose", None),
        gripper_command=padded("gripper_command", 0.0),
        episode_length=np.array(lengths, np.int32),
        hold=padded("hold", False),
        meta={
            "schema": SCHEMA,
            "cable": {
                "length_m": cable.length,
                "diameter_m": cable.diameter,
                "linear_density_kg_per_m": cable.linear_density,
                "bending_stiffness_n_m2": cable.bending_stiffness,
                "bending_damping_s": cable.damping_time,
                "rest_curvature_per_m": cable.rest_curvature,
            },
            # a cable in the plane lies on a table even where that is perfectly smooth
            "table": {"friction_coefficient": cable.friction_coefficient}
            if cable.friction_coefficient > 0 or episodes[0].keypoints.shape[-1] == 2
            else None,
            "gravity_m_per_s2": [0.0, 0.0, -GRAVITY],
            "keypoint_arclength_m": arclength.tolist(),
            "grasp": list(grasp),
            "motion": [episode.motion for episode in episodes],
            "source": source,
            **(extra or {}),
        },
    )
    validate(log)
    return log


def validate(log: GapLog) -> None:
    """Checks a gap log; raises `GapLogError` with the field, what it is and what was expected."""
    _validate_arrays(log)
    _validate_meta(log)
    if fault := geometry_fault(log):
        raise GapLogError(fault)


def write_gap_log(path: str | os.PathLike, log: GapLog, *, overwrite: bool = False) -> pathlib.Path:
    """Writes a checked gap log, whole or not at all, and returns its path.

    Raises:
        GapLogError: the log does not follow the format.
        FileExistsError: there is such a file and `overwrite` is false.
    """
    path = pathlib.Path(path)
    if path.suffix != ".npz":
        raise GapLogError(f"A gap log is an .npz file, got {path.name!r}.")
    validate(log)
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists: choose another name, or pass overwrite=True to replace it.")
    arrays = {name: getattr(log, name) for name in _DTYPES if getattr(log, name) is not None}
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as stream:
        np.savez_compressed(stream, allow_pickle=False, meta=np.array(json.dumps(log.meta)), **arrays)
    return path


def read_gap_log(path: str | os.PathLike) -> GapLog:
    """Reads and checks a gap log; floating-point arrays come in the format's own precision.

    Raises:
        GapLogError: the file is no `.npz`, a field is missing, or a field is not what the format says.
        FileNotFoundError: there is no such file.
    """
    try:
        fields = read_npz(path, [*(name for name in _DTYPES if name != "hold"), "meta"], ["hold"])
    except NpzError as error:
        raise GapLogError(f"{error} Expected a gap log ({SCHEMA}).") from error
    try:
        meta = parse_json(str(fields["meta"]))
    except ValueError as error:
        raise GapLogError(f"{path}: field 'meta' {error}") from error
    arrays = {}
    for name, dtype in _DTYPES.items():
        if name in fields:
            if not np.can_cast(fields[name].dtype, dtype, casting="same_kind"):
                raise GapLogError(f"{path}: field '{name}' has dtype {fields[name].dtype}, expected {np.dtype(dtype)}.")
            arrays[name] = fields[name].astype(dtype)
    log = GapLog(meta=meta, **arrays)
    try:
        validate(log)
    except GapLogError as error:
        raise GapLogError(f"{path}: {error}") from error
    return log


def _validate_arrays(log: GapLog) -> None:
    for name, dtype in _DTYPES.items():
        array = getattr(log, name)
        if array is None and name == "hold":
            continue
        if not isinstance(array, np.ndarray) or array.dtype != dtype:
            found = array.dtype if isinstance(array, np.ndarray) else type(array).__name__
            raise GapLogError(f"Field '{name}' is {found}, expected an array of {np.dtype(dtype)}.")
    if log.keypoints.ndim != 4 or log.keypoints.shape[3] not in _POSE_WIDTH:
        raise GapLogError(f"Field 'keypoints' has shape {log.keypoints.shape}, expected (E, T, N, 2) or (E, T, N, 3).")
    episodes, samples, points, dimension = log.keypoints.shape
    if episodes < 1 or points < 2:
        raise GapLogError(
            f"Field 'keypoints' has shape {log.keypoints.shape}, expected at least one episode and two keypoints: the "
            "first and the last are at the grippers."
        )
    grippers = log.gripper_pose.shape[2] if log.gripper_pose.ndim == 4 else 2
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
            raise GapLogError(f"Field '{name}' has shape {array.shape}, expected {shape} for these keypoints.")
    for index, length in enumerate(log.episode_length):
        if not 1 <= length <= samples:
            raise GapLogError(f"Field 'episode_length' is {length} in episode {index}, expected 1 to {samples}.")
        time = log.time[index, :length]
        if not np.isfinite(time).all() or (np.diff(time) <= 0).any():
            raise GapLogError(f"Field 'time' does not increase, or is not finite, in episode {index}.")
        # the last command is held for no sample
        for name, end in (("gripper_pose", length), ("gripper_command", length - 1)):
            if not np.isfinite(getattr(log, name)[index, :end]).all():
                raise GapLogError(f"Field '{name}' is not finite in episode {index}; only keypoints may be NaN.")
        if np.isinf(log.keypoints[index, :length]).any():
            raise GapLogError(f"Field 'keypoints' is infinite in episode {index}; a keypoint not observed is NaN.")
        if dimension == 3:
            norm = np.linalg.norm(log.gripper_pose[index, :length, :, 3:], axis=-1)
            if np.abs(norm - 1).max() > 1e-3:
                raise GapLogError(f"Field 'gripper_pose' has quaternions not of unit length in episode {index}.")


def _validate_meta(log: GapLog) -> None:
    meta = log.meta
    if not isinstance(meta, dict):
        raise GapLogError(f"Field 'meta' is a {type(meta).__name__}, expected a JSON object.")
    if "schema" in meta and meta["schema"] != SCHEMA:
        raise GapLogError(f"Field 'meta.schema' is {meta['schema']!r}, expected {SCHEMA!r}.")
    for name in _META_FIELDS:
        if name not in meta:
            raise GapLogError(f"Field 'meta.{name}' is missing.")
    _check_numbers("cable", meta["cable"], _CABLE_POSITIVE, _CABLE_NOT_NEGATIVE)
    if meta["table"] is not None:
        _check_numbers("table", meta["table"], (), ("friction_coefficient",))
    points, grippers = log.keypoints.shape[2], log.gripper_pose.shape[2]
    for name, length in (("gravity_m_per_s2", 3), ("keypoint_arclength_m", points)):
        value = meta[name]
        if not isinstance(value, list) or len(value) != length or not all(_is_number(entry) for entry in value):
            raise GapLogError(f"Field 'meta.{name}' is {value!r}, expected {length} finite numbers.")
    marks, cable_length = np.asarray(meta["keypoint_arclength_m"], float), float(meta["cable"]["length_m"])
    if (np.diff(marks) <= 0).any():
        raise GapLogError("Field 'meta.keypoint_arclength_m' does not increase.")
    if np.abs(marks[[0, -1]] - [0.0, cable_length]).max() > _ENDS * cable_length:
        raise GapLogError(
            f"Field 'meta.keypoint_arclength_m' goes from {marks[0]:g} to {marks[-1]:g} m, expected 0 to the cable's "
            f"length of {cable_length:g} m: the first and the last keypoint are at the grippers."
        )
    for name, length in (("grasp", grippers), ("motion", len(log.episode_length))):
        value = meta[name]
        if not isinstance(value, list) or len(value) != length or not all(isinstance(entry, str) for entry in value):
            raise GapLogError(f"Field 'meta.{name}' is {value!r}, expected {length} strings.")
    if not isinstance(meta["source"], str):
        raise GapLogError(f"Field 'meta.source' is {meta['source']!r}, expected text.")


def _check_numbers(group: str, value: Any, positive: Sequence[str], not_negative: Sequence[str]) -> None:
    names = (*positive, *not_negative)
    if not isinstance(value, dict):
        raise GapLogError(f"Field 'meta.{group}' is {value!r}, expected an object with {', '.join(names)}.")
    for name in names:
        if name not in value:
            raise GapLogError(f"Field 'meta.{group}.{name}' is missing.")
        least = "> 0" if name in positive else ">= 0"
        if not _is_number(value[name]) or value[name] < 0 or (value[name] == 0 and name in positive):
            raise GapLogError(f"Field 'meta.{group}.{name}' is {value[name]!r}, expected a finite number {least}.")


def _is_number(value: Any) -> bool:
    # an integer may be larger than any float
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300
