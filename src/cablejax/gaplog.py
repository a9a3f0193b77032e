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
from cablejax.gaplog_check import DTYPES, META_FIELDS, SCHEMA, GapLogError, validate
from cablejax.limits import shown
from cablejax.npz import NpzError, read_npz
from cablejax.text_file import parse_json
from cablejax.types import GapLog
from cablejax.whole_file import whole_file


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
    if taken := set(extra or {}) & set(META_FIELDS):
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
        whole = np.empty((len(arrays), max(lengths), *rest), DTYPES[name])
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


def joined(logs: Sequence[GapLog], names: Sequence[str]) -> GapLog:
    """One log of several recordings of one set-up, episodes in the order given.

    Its `meta` has the field `recordings`: the name of each and how many episodes it has, by which a diagnosis says what
    each one added. Extra fields of `meta` stay where all recordings have the same.

    Args:
        logs: at least one.
        names: of each, for example that of its file; one that was joined itself keeps its parts' names.

    Raises:
        GapLogError: recordings of different set-ups, or the same one twice; names both and what differs.
    """
    if not logs:
        raise GapLogError("Nothing to join: expected at least one gap log.")
    for i, (log, name) in enumerate(zip(logs, names, strict=True)):
        for other, other_name in zip(logs[:i], names, strict=False):
            if _same_recording(log, other):
                raise GapLogError(
                    f"{other_name} and {name} are the same recording: name it once, or it would count twice."
                )
        there_all, here_all = _set_up(logs[0]), _set_up(log)
        for field in there_all | here_all:
            if (here := here_all.get(field)) != (there := there_all.get(field)):
                raise GapLogError(
                    f"{name} is not of the set-up of {names[0]}: '{field}' is {shown(here)}, and there {shown(there)}. "
                    "Diagnose them apart, or correct the one that states it wrongly."
                )
    samples = max(log.keypoints.shape[1] for log in logs)

    def whole(name: str, fill) -> np.ndarray | None:
        arrays = [getattr(log, name) for log in logs]
        if all(array is None for array in arrays):
            return None
        rows = []
        for array, log in zip(arrays, logs, strict=True):
            array = np.zeros(log.time.shape, bool) if array is None else array
            missing = [(0, 0), (0, samples - array.shape[1]), *[(0, 0)] * (array.ndim - 2)]
            rows.append(
                np.pad(array, missing, "edge") if fill is None else np.pad(array, missing, constant_values=fill)
            )
        return np.concatenate(rows)

    extra = set.intersection(*(set(log.meta) for log in logs)) - {*META_FIELDS, "recordings"}
    log = dataclasses.replace(
        logs[0],
        time=whole("time", None),
        keypoints=whole("keypoints", np.nan),
        gripper_pose=whole("gripper_pose", None),
        gripper_command=whole("gripper_command", 0.0),
        episode_length=np.concatenate([log.episode_length for log in logs]),
        hold=whole("hold", False),
        meta={
            **{name: logs[0].meta[name] for name in META_FIELDS},
            **{name: logs[0].meta[name] for name in sorted(extra) if all(_same(name, log, logs[0]) for log in logs)},
            "motion": [motion for log in logs for motion in log.meta["motion"]],
            "source": "; ".join(dict.fromkeys(log.meta["source"] for log in logs)),
            "recordings": [part for log, name in zip(logs, names, strict=True) for part in recordings(log, name)],
        },
    )
    validate(log)
    return log


def recordings(log: GapLog, name: str = "the log") -> list[dict[str, Any]]:
    """What a log was joined of, as `{"name", "episodes"}`; of one that was not joined, itself under this name.

    Raises:
        GapLogError: the field `recordings` of its `meta` does not add up to its episodes.
    """
    parts, episodes = log.meta.get("recordings"), len(log.episode_length)
    if parts is None:
        return [{"name": name, "episodes": episodes}]
    try:
        counts = [part["episodes"] for part in parts if isinstance(part["name"], str)]
        fits = len(counts) == len(parts) and sum(counts) == episodes and all(type(n) is int and n > 0 for n in counts)
    except (TypeError, KeyError, ValueError):
        fits = False
    if not fits:
        raise GapLogError(
            f"Field 'meta.recordings' is {shown(parts)}, expected names and numbers of episodes that add up to "
            f"{episodes}, as `cablejax.gaplog.joined` writes them."
        )
    return parts


def _set_up(log: GapLog) -> dict[str, Any]:
    """What recordings of one set-up have in common, by the names of the format."""
    meta = log.meta
    return {
        "dimension of the keypoints": log.keypoints.shape[3],
        "number of keypoints": log.keypoints.shape[2],
        "number of grippers": log.gripper_pose.shape[2],
        "meta.cable.rest_curvature_per_m": 0.0,
        **{f"meta.cable.{name}": value for name, value in meta["cable"].items()},
        **{f"meta.{name}": meta[name] for name in ("table", "gravity_m_per_s2", "keypoint_arclength_m", "grasp")},
    }


def _same(name: str, log: GapLog, other: GapLog) -> bool:
    return log.meta[name] == other.meta[name]


def _same_recording(log: GapLog, other: GapLog) -> bool:
    return all(
        np.array_equal(getattr(log, name), getattr(other, name), equal_nan=True) for name in ("time", "keypoints")
    )


def write_gap_log(path: str | os.PathLike, log: GapLog, *, overwrite: bool = False) -> pathlib.Path:
    """Writes a checked gap log, whole or not at all, and returns its path.

    Raises:
        GapLogError: the log does not follow the format.
        FileExistsError: there is such a file and `overwrite` is false.
    """
    path = pathlib.Path(path)
    if path.suffix.lower() != ".npz":
        raise GapLogError(f"A gap log is an .npz file, got {path.name!r}.")
    validate(log)
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists: choose another name, or pass overwrite=True to replace it.")
    arrays = {name: getattr(log, name) for name in DTYPES if getattr(log, name) is not None}
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
        fields = read_npz(path, [*(name for name in DTYPES if name != "hold"), "meta"], ["hold"], text=["meta"])
    except NpzError as error:
        raise GapLogError(f"{error} Expected a gap log ({SCHEMA}).") from error
    try:
        meta = parse_json(str(fields["meta"]))
    except ValueError as error:
        raise GapLogError(f"{path}: field 'meta' {error}") from error
    arrays = {}
    for name, dtype in DTYPES.items():
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
