"""Writes gap logs as LeRobot data sets of version 3.0, and reads them back.

    meta/info.json, meta/stats.json, meta/tasks.parquet, meta/episodes/chunk-000/file-000.parquet
    data/chunk-000/file-000.parquet    one row per sample
    meta/cablejax.json                 the log's own `meta`, which LeRobot leaves alone

`observation.state` has the grippers' poses, `observation.environment_state` the keypoints (NaN = not observed),
`action` the commands, `task` what the grippers did, `timestamp` the log's own times, in float32; `time` has them in
float64. Needs the library pyarrow: `pip install 'cablejax[recordings]'`.
"""

from __future__ import annotations

import functools
import json
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cablejax.extras import from_extra
from cablejax.gaplog import Episode, episodes_of, labels, stack_episodes
from cablejax.gaplog_check import SCHEMA, GapLogError, meta_text, reading_export
from cablejax.limits import require
from cablejax.text_file import read_json, write_json
from cablejax.types import GapLog
from cablejax.whole_file import draft_folder, whole_file

VERSION = "v3.0"
"""Version of the data sets' layout."""

_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_FIRST = _FILE.format(chunk_index=0, file_index=0)
_LOG = "meta/cablejax.json"
_QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
_POSES = {3: ("x", "y", "theta"), 7: ("x", "y", "z", "qw", "qx", "qy", "qz")}
_TWISTS = {3: ("vx", "vy", "omega"), 6: ("vx", "vy", "vz", "wx", "wy", "wz")}
_ARRAYS = {
    "observation.environment_state": "keypoints",
    "observation.state": "gripper_pose",
    "action": "gripper_command",
}
"""Field of an episode in each column of several numbers."""

_pyarrow = functools.partial(from_extra, extra="recordings", what="LeRobot data sets need the library pyarrow")


def write_lerobot(folder: str | os.PathLike[str], log: GapLog) -> pathlib.Path:
    """Writes a gap log as a LeRobot data set into a new folder, whole or not at all, and returns its path.

    The log's times are kept as they are. LeRobot's frame rate is that of the usual time between samples; where the
    clock is uneven, its windows of several samples are by count, not by time.

    Raises:
        FileExistsError: there is such a folder or file.
        GapLogError: `meta` has a field that JSON cannot hold.
        ValueError: the library pyarrow is not installed.
    """
    arrow, folder = _pyarrow("pyarrow"), pathlib.Path(folder)
    if folder.exists():
        raise FileExistsError(f"{folder} exists: give the data set another folder.")
    episodes = episodes_of(log)
    tasks = list(dict.fromkeys(log.meta["motion"]))
    columns = _columns(episodes, tasks, holds=log.hold is not None)
    with draft_folder(folder) as draft:
        for place in ("meta/episodes/chunk-000", "data/chunk-000"):
            (draft / place).mkdir(parents=True)
        _write_table(arrow, draft / "data" / _FIRST, columns)
        rows = _episode_rows(columns, [len(episode.time) for episode in episodes], log.meta["motion"])
        _write_table(arrow, draft / "meta/episodes" / _FIRST, rows)
        _write_tasks(arrow, draft / "meta/tasks.parquet", tasks)
        write_json(draft / "meta/info.json", _info(log, _features(columns, log), len(columns["index"]), len(tasks)))
        write_json(draft / "meta/stats.json", {name: _statistics(column) for name, column in columns.items()})
        (draft / _LOG).write_text(f"{meta_text(log.meta, indent=2)}\n", encoding="utf-8")
        draft.rename(folder)
    return folder


def read_lerobot(folder: str | os.PathLike[str]) -> GapLog:
    """Reads the gap log in a data set of `write_lerobot`: the same to the last bit.

    Raises:
        GapLogError: the folder is no such data set, damaged, or its log does not follow the format.
        ValueError: the library pyarrow is not installed, or a file is too large.
    """
    arrow, folder = _pyarrow("pyarrow"), pathlib.Path(folder)
    if not (folder / "meta/info.json").is_file():
        raise GapLogError(f"{folder} is no LeRobot data set (no meta/info.json): give its folder.")
    info = read_json(folder / "meta/info.json")
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if version != VERSION:
        raise GapLogError(f"{folder} has version {version!r}, expected {VERSION!r}. LeRobot converts older data sets.")
    if not (folder / _LOG).is_file():
        raise GapLogError(
            f"{folder} was not written by `cablejax export lerobot` (no {_LOG}): a data set says neither which cable "
            "it shows nor where its keypoints are. Import its recording as a csv or a bag, with a layout."
        )
    meta = read_json(folder / _LOG)
    if not isinstance(meta, dict) or not isinstance(meta.get("motion"), list):
        raise GapLogError(f"{folder / _LOG} is damaged: it is no `meta` of a gap log ({SCHEMA}). Export the log again.")
    with reading_export(folder):
        table = _read_table(arrow, sorted((folder / "data").glob("chunk-*/file-*.parquet")))
        if missing := sorted(set(info["features"]) - set(table)):
            raise GapLogError(
                f"The data lacks {', '.join(missing)}, which meta/info.json states. Export the log again."
            )
        if (rows := len(table["index"])) != info["total_frames"]:
            raise GapLogError(
                f"The data has {rows} rows, but meta/info.json states {info['total_frames']}: rows were lost or added. "
                "Export the log again."
            )
        return stack_episodes(_episodes(table, info["features"], meta["motion"]), meta, holds="hold" in table)


def _features(columns: Mapping[str, np.ndarray], log: GapLog) -> dict[str, dict[str, Any]]:
    """Type, shape and names of every column, as LeRobot describes them."""
    points, dimension = log.keypoints.shape[2:]
    grippers = range(log.gripper_pose.shape[2])
    names = {
        "observation.environment_state": [f"keypoint_{i}.{axis}" for i in range(points) for axis in "xyz"[:dimension]],
        "observation.state": [f"gripper_{q}.{name}" for q in grippers for name in _POSES[log.gripper_pose.shape[3]]],
        "action": [f"gripper_{q}.{name}" for q in grippers for name in _TWISTS[log.gripper_command.shape[3]]],
    }
    return {
        name: {"dtype": column.dtype.name, "shape": [*column.shape[1:]] or [1], "names": names.get(name)}
        for name, column in columns.items()
    }


def _columns(episodes: Sequence[Episode], tasks: Sequence[str], *, holds: bool) -> dict[str, np.ndarray]:
    """Every column of the data, with a row for each sample of each episode."""
    lengths = [len(episode.time) for episode in episodes]

    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(episode, name) for episode in episodes])

    columns = {name: joined(field).reshape(sum(lengths), -1) for name, field in _ARRAYS.items()}
    columns["time"] = joined("time")
    if holds:
        columns["hold"] = joined("hold")
    return {
        **columns,
        "timestamp": columns["time"].astype(np.float32),
        "frame_index": np.concatenate([np.arange(n) for n in lengths]),
        "episode_index": np.repeat(np.arange(len(lengths)), lengths),
        "index": np.arange(sum(lengths)),
        "task_index": np.repeat([tasks.index(episode.motion) for episode in episodes], lengths),
    }


def _episode_rows(columns: Mapping[str, np.ndarray], lengths: Sequence[int], tasks: Sequence[str]) -> dict[str, Any]:
    """The table of episodes: where each is, what it does, and its statistics."""
    ends = np.cumsum(lengths)
    statistics = [
        {name: _statistics(column[end - n : end]) for name, column in columns.items()}
        for n, end in zip(lengths, ends, strict=True)
    ]
    places = ("data/chunk_index", "data/file_index", "meta/episodes/chunk_index", "meta/episodes/file_index")
    return {
        "episode_index": np.arange(len(lengths)),
        "tasks": [[task] for task in tasks],
        "length": np.array(lengths),
        "dataset_from_index": ends - lengths,
        "dataset_to_index": ends,
        **{place: np.zeros(len(lengths), int) for place in places},
        **{
            f"stats/{name}/{kind}": [of[name][kind] for of in statistics]
            for name, kinds in statistics[0].items()
            for kind in kinds
        },
    }


def _statistics(column: np.ndarray) -> dict[str, list[float]]:
    """Least, largest, mean, spread and quantiles of each number over what was observed; 0 of what never was."""
    rows = column.reshape(len(column), -1).astype(float)
    rows = np.where(np.isfinite(rows).any(axis=0), rows, 0.0)
    rows = np.where(np.isfinite(rows), rows, np.nan)
    found = {"min": np.nanmin, "max": np.nanmax, "mean": np.nanmean, "std": np.nanstd}
    return {
        **{name: of(rows, axis=0).tolist() for name, of in found.items()},
        "count": [len(rows)],
        **{f"q{round(100 * q):02d}": np.nanquantile(rows, q, axis=0).tolist() for q in _QUANTILES},
    }


def _info(log: GapLog, features: Mapping[str, Any], frames: int, tasks: int) -> dict[str, Any]:
    steps, episodes = log.intervals, len(log.episode_length)
    rate = 1.0 / float(np.median(steps)) if len(steps) else 1.0
    return {
        "codebase_version": VERSION,
        "robot_type": "two grippers that hold a cable",
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": tasks,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": round(rate) if abs(rate - round(rate)) < 1e-3 * rate else rate,
        "splits": _splits(labels(log, "split", default="train")),
        "data_path": f"data/{_FILE}",
        "video_path": None,
        "features": features,
    }


def _splits(split: Sequence[str]) -> dict[str, str]:
    """First episode and the one after the last of each split, by its name; what has none is for training.

    Where the episodes of a split do not follow one another, which the format cannot state, all are one split, "all".
    """
    names = [name or "train" for name in split]
    begins = [e for e, name in enumerate(names) if e == 0 or name != names[e - 1]]
    if len(begins) > len(set(names)):
        return {"all": f"0:{len(names)}"}
    ends = [*begins[1:], len(names)]
    return {names[begin]: f"{begin}:{end}" for begin, end in zip(begins, ends, strict=True)}


def _write_table(arrow: Any, path: pathlib.Path, columns: Mapping[str, Any]) -> None:
    """Writes columns of numbers, rows of numbers or lists as a parquet file."""
    arrays = {
        name: arrow.FixedSizeListArray.from_arrays(arrow.array(column.ravel()), column.shape[1])
        if isinstance(column, np.ndarray) and column.ndim == 2
        else arrow.array(column)
        for name, column in columns.items()
    }
    _write(path, arrow.table(arrays))


def _write_tasks(arrow: Any, path: pathlib.Path, tasks: Sequence[str]) -> None:
    """The table of tasks, whose names are the index of a pandas table: LeRobot reads it with pandas."""
    index = "__index_level_0__"

    def described(name: str | None, field: str, pandas: str, numpy: str) -> dict[str, Any]:
        return {"name": name, "field_name": field, "pandas_type": pandas, "numpy_type": numpy, "metadata": None}

    pandas = {
        "index_columns": [index],
        "column_indexes": [],
        "columns": [
            described("task_index", "task_index", "int64", "int64"),
            described(None, index, "unicode", "object"),
        ],
        "pandas_version": "2.0.0",
    }
    table = arrow.table({"task_index": arrow.array(range(len(tasks)), arrow.int64()), index: arrow.array(list(tasks))})
    _write(path, table.replace_schema_metadata({"pandas": json.dumps(pandas)}))


def _write(path: pathlib.Path, table: Any) -> None:
    parquet = _pyarrow("pyarrow.parquet")
    with whole_file(path) as stream:
        parquet.write_table(table, stream, compression="snappy", write_page_checksum=True)


def _read_table(arrow: Any, paths: Sequence[pathlib.Path]) -> dict[str, np.ndarray]:
    """The columns of several parquet files, one after the other."""
    if not paths:
        raise GapLogError("The data set has no file data/chunk-000/file-000.parquet. Export the log again.")
    parquet = _pyarrow("pyarrow.parquet")
    tables = []
    for path in paths:
        with parquet.ParquetFile(path, pre_buffer=False, page_checksum_verification=True) as file:
            groups = [file.metadata.row_group(k) for k in range(file.metadata.num_row_groups)]
            require(sum(group.total_byte_size for group in groups), "array_bytes", f"The size of {path}")
            tables.append(file.read())
    table = arrow.concat_tables(tables)
    return {
        name: np.stack(table[name].to_numpy()) if name in _ARRAYS else table[name].to_numpy()
        for name in table.column_names
    }


def _episodes(table: Mapping[str, np.ndarray], features: Mapping[str, Any], motions: Sequence[str]) -> list[Episode]:
    grippers = len({name.partition(".")[0] for name in features["action"]["names"]})
    dimension = 2 if table["observation.state"].shape[1] == 3 * grippers else 3
    shapes = {"keypoints": (-1, dimension), "gripper_pose": (grippers, -1), "gripper_command": (grippers, -1)}
    hold = table.get("hold", np.zeros(len(table["time"]), bool))
    if hold.dtype != bool:
        raise GapLogError(f"The column hold has {hold.dtype}, expected true or false. Export the log again.")
    if extra := sorted(set(table["episode_index"].tolist()) - set(range(len(motions)))):
        raise GapLogError(
            f"The data has rows of episode {extra[0]}, but {_LOG} names the motions of {len(motions)} episodes, "
            "counted from 0. Export the log again."
        )
    episodes = []
    for index, motion in enumerate(motions):
        rows = np.flatnonzero(table["episode_index"] == index)
        if not len(rows):
            raise GapLogError(f"The data has no row of episode {index}. Export the log again.")
        arrays = {field: table[name][rows].reshape(len(rows), *shapes[field]) for name, field in _ARRAYS.items()}
        episodes.append(Episode(motion=motion, time=table["time"][rows], hold=hold[rows], **arrays))
    return episodes
