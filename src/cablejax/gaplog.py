"""Reads and writes recorded cable runs: the `cablejax-gap-log/1` format, one `.npz` file per cable set-up.

Files are read without unpickling, checked field by field, and written whole or not at all.
"""

from __future__ import annotations

import dataclasses
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from cablejax.cable import GRAVITY, Cable
from cablejax.cable_file import NUMBERS
from cablejax.gaplog_check import DTYPES, META_FIELDS, SCHEMA, GapLogError, meta_text, validate
from cablejax.limits import LIMITS, require
from cablejax.npz import NpzError, read_npz
from cablejax.text_file import parse_json
from cablejax.types import GapLog
from cablejax.whole_file import whole_file

SIMULATED = ("nominal", "explained")
"""Simulated keypoints that a diagnosis stores with its log: with the cable as believed, and with the named effects."""
TARGETS = "target_m"
"""Field of `meta` with the keypoints of each episode's target [m], where the run had one."""


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
    extra: Mapping[str, Any] | None = None,
) -> GapLog:
    """One gap log of several episodes of the same cable, padded to the longest.

    Args:
        episodes: at least one; their number of samples may differ.
        cable: the cable and table as they are believed to be, which is what the nominal simulator uses.
        source: free text: what recorded this.
        extra: fields of `meta` beyond those of the format, which readers that do not know them leave alone.

    Raises:
        GapLogError: no episodes, episodes that do not fit each other or the format, or an extra field that it has.
    """
    if not episodes:
        raise GapLogError("A gap log needs at least one episode, got none.")
    if taken := set(extra or {}) & set(META_FIELDS):
        raise GapLogError(f"The extra fields {', '.join(sorted(taken))} are fields of the format: choose other names.")
    numbers = {key: getattr(cable, name) for key, (name, _) in NUMBERS.items()}
    table = {"friction_coefficient": numbers.pop("friction_coefficient")}
    return stack_episodes(
        episodes,
        {
            "schema": SCHEMA,
            "cable": numbers,
            # a cable in the plane lies on a table even where that is perfectly smooth
            "table": table if cable.friction_coefficient > 0 or episodes[0].keypoints.shape[-1] == 2 else None,
            "gravity_m_per_s2": [0.0, 0.0, -GRAVITY],
            "keypoint_arclength_m": cable.keypoint_arclength.tolist(),
            "grasp": list(cable.grasp),
            "motion": [episode.motion for episode in episodes],
            "source": source,
            **(extra or {}),
        },
    )


def stack_episodes(episodes: Sequence[Episode], meta: Mapping[str, Any], *, holds: bool = True) -> GapLog:
    """Stacks episodes, padded to the longest, to a checked gap log: the inverse of `episodes_of`.

    Args:
        episodes: at least one.
        meta: of the log, complete; NumPy's numbers and arrays become plain ones.
        holds: whether the log says when the grippers rest.

    Raises:
        GapLogError: episodes that do not fit each other or the format, or `meta` that JSON cannot hold.
    """
    lengths = [len(episode.time) for episode in episodes]

    def padded(name: str, fill) -> np.ndarray:
        given = [getattr(episode, name) for episode in episodes]
        if any(map(np.ma.is_masked, given)):
            raise GapLogError(
                f"An episode's {name} is a masked array, whose mask a log does not have: write NaN for keypoints that "
                "were not observed (array.filled(np.nan)), and leave out samples without the rest."
            )
        arrays = [np.asarray(array) for array in given]
        rest = arrays[0].shape[1:]
        for array, length in zip(arrays, lengths, strict=True):
            if np.iscomplexobj(array):
                raise GapLogError(f"An episode's {name} is an array of {array.dtype}, expected real numbers.")
            if not length:
                raise GapLogError("An episode has no sample, expected at least one.")
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
        hold=padded("hold", False) if holds else None,
        meta=parse_json(meta_text(meta)),
    )
    validate(log)
    return log


def episodes_of(log: GapLog) -> list[Episode]:
    """The episodes of a log without their padding; a log that does not say when the grippers rest has no holds."""
    hold = np.zeros(log.time.shape, bool) if log.hold is None else log.hold
    return [
        Episode(
            motion=motion,
            time=log.time[e, :n],
            keypoints=log.keypoints[e, :n],
            gripper_pose=log.gripper_pose[e, :n],
            gripper_command=log.gripper_command[e, :n],
            hold=hold[e, :n],
        )
        for e, (motion, n) in enumerate(zip(log.meta["motion"], log.episode_length, strict=True))
    ]


def until(log: GapLog, seconds: float) -> GapLog:
    """The first seconds of every episode, at least one sample of each.

    Raises:
        ValueError: the seconds are no positive number.
    """
    require(seconds, "positive", "seconds", "The first sample of an episode is always kept.")
    fields = ("time", "keypoints", "gripper_pose", "gripper_command", "hold")
    episodes = [
        dataclasses.replace(one, **{name: getattr(one, name)[one.time - one.time[0] < seconds] for name in fields})
        for one in episodes_of(log)
    ]
    return stack_episodes(episodes, log.meta, holds=log.hold is not None)


def write_gap_log(
    path: str | os.PathLike,
    log: GapLog,
    *,
    overwrite: bool = False,
    simulated: Mapping[str, Float[np.ndarray, "E T N D"]] | None = None,
) -> pathlib.Path:
    """Writes a checked gap log, whole or not at all, and returns its path.

    Args:
        path: an `.npz` file.
        log: to be written.
        overwrite: whether a file that is there is replaced.
        simulated: keypoints of simulators on this log [m], by the names in `SIMULATED`, for `read_simulated`.

    Raises:
        GapLogError: the log does not follow the format, or has a field that JSON cannot hold.
        FileExistsError: there is such a file and `overwrite` is false.
    """
    path = pathlib.Path(path)
    if path.suffix.lower() != ".npz":
        raise GapLogError(f"A gap log is an .npz file, got {path.name!r}.")
    validate(log)
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists: choose another name, or pass overwrite=True to replace it.")
    arrays = {name: getattr(log, name) for name in DTYPES if getattr(log, name) is not None}
    for name, points in (simulated or {}).items():
        if name not in SIMULATED or np.shape(points) != log.keypoints.shape:
            raise GapLogError(
                f"The simulated keypoints {name!r} have shape {np.shape(points)}, expected {' or '.join(SIMULATED)} "
                f"of shape {log.keypoints.shape}."
            )
        arrays[name] = np.asarray(points, np.float32)
    meta = meta_text(log.meta)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as stream:
        np.savez_compressed(stream, allow_pickle=False, meta=np.array(meta), **arrays)
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
        raise GapLogError(
            f"{error} Expected a gap log ({SCHEMA}), as `cablejax import` makes it of a recording."
        ) from error
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
            if fields[name].dtype.kind in "iu" and (arrays[name] != fields[name]).any():
                raise GapLogError(f"{path}: field '{name}' has {fields[name].max()}, too large for {np.dtype(dtype)}.")
    log = GapLog(meta=meta, **arrays)
    try:
        validate(log)
    except GapLogError as error:
        raise GapLogError(f"{path}: {error}") from error
    return log


def read_simulated(path: str | os.PathLike, log: GapLog) -> dict[str, Float[np.ndarray, "E T N D"]]:
    """The simulated keypoints [m] that a diagnosis stored in the file of its log, by the names in `SIMULATED`.

    Raises:
        GapLogError: the file cannot be read, or its keypoints are not those of this log.
        FileNotFoundError: there is no such file.
    """
    try:
        found = read_npz(path, [], SIMULATED)
    except NpzError as error:
        raise GapLogError(str(error)) from error
    for name, points in found.items():
        if points.shape != log.keypoints.shape:
            raise GapLogError(f"{path}: field '{name}' has shape {points.shape}, expected {log.keypoints.shape}.")
    return found


def targets_of(log: GapLog) -> list[Float[np.ndarray, "N D"] | None]:
    """The target of each episode [m]; None where the log states none for its cable."""
    stated = log.meta.get(TARGETS)
    if not isinstance(stated, list) or len(stated) != len(log.episode_length):
        return [None] * len(log.episode_length)
    found: list[Float[np.ndarray, "N D"] | None] = []
    for target in stated:
        try:
            points = np.array(target, float)
        except (TypeError, ValueError, OverflowError):
            points = np.empty(0)
        known = points.shape == log.keypoints.shape[2:] and bool((np.abs(points) <= LIMITS["coordinate"].high).all())
        found.append(points if known else None)
    return found


def labels(log: GapLog, *names: str, default: str | None = None) -> list[str]:
    """Labels of the episodes by the first of these extra fields that the log has; else their numbers.

    Only lists of one text or number for each episode are labels; what another program means by these names is left
    alone.
    """
    for name in names:
        value = log.meta.get(name)
        if not isinstance(value, list) or len(value) != len(log.keypoints):
            continue
        if all(isinstance(entry, (str, int, float)) for entry in value):
            return [str(entry) for entry in value]
    return [str(e) if default is None else default for e in range(len(log.keypoints))]
