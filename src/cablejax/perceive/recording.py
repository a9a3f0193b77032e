"""Recorded cloud sequences: one `.npz` file, or a folder of PCD files with the grippers' poses."""

from __future__ import annotations

import dataclasses
import os
import pathlib
import re

import numpy as np
from jaxtyping import Float

from cablejax.limits import require, shown
from cablejax.npz import read_npz
from cablejax.text_file import read_bytes, read_text

POSES_FILE = "poses.csv"
"""Name of the file with the gripper poses in a folder of PCD files."""
POSES_HEADER = ("time", "x0", "y0", "theta0", "x1", "y1", "theta1")
"""Its columns [s, m, rad]."""
_KINDS = {"F": "f", "I": "i", "U": "u"}


@dataclasses.dataclass(frozen=True)
class CloudSequence:
    """Clouds over time, with the grippers' poses of the same instants, all in one frame.

    Attributes:
        time: [s], increasing, shape [T].
        clouds: T arrays [m], shape [S, 2 or 3]; S varies and may be 0, NaN or infinite = no measurement.
        gripper_pose: (x, y, theta) [m, rad], shape [T, Q, 3].
    """

    time: Float[np.ndarray, " T"]
    clouds: list[Float[np.ndarray, "S D"]]
    gripper_pose: Float[np.ndarray, "T Q 3"]

    def __post_init__(self):
        count = len(self.clouds)
        if count == 0:
            raise ValueError("A cloud sequence has no frame, expected at least one.")
        if self.time.shape != (count,) or self.gripper_pose.shape != (count, 2, 3):
            raise ValueError(
                f"A cloud sequence of {count} frames has times of shape {self.time.shape} and gripper poses of shape "
                f"{self.gripper_pose.shape}, expected ({count},) and ({count}, 2, 3)."
            )
        if not (np.isfinite(self.time).all() and (np.diff(self.time) > 0).all()):
            raise ValueError("The times of a cloud sequence are not finite and increasing: sort and check its frames.")
        if not np.isfinite(self.gripper_pose).all():
            frame = int(np.argwhere(~np.isfinite(self.gripper_pose))[0, 0])
            raise ValueError(f"The gripper pose of frame {frame} is not finite, expected (x, y, theta) in every frame.")
        for frame, cloud in enumerate(self.clouds):
            if cloud.ndim != 2 or cloud.shape[1] not in (2, 3) or not np.issubdtype(cloud.dtype, np.floating):
                raise ValueError(
                    f"The cloud of frame {frame} has shape {cloud.shape} and type {cloud.dtype}, expected floating "
                    "point numbers of shape [S, 2] or [S, 3]."
                )
            farthest = float(np.abs(cloud[np.isfinite(cloud)]).max(initial=0.0))
            require(farthest, "coordinate", f"The farthest point of frame {frame}")
        require(float(np.abs(self.gripper_pose).max()), "coordinate", "The largest entry of the gripper poses")
        require(float(np.abs(self.time).max()), "finite", "The largest time")
        if not any(np.isfinite(cloud).all(axis=1).any() for cloud in self.clouds):
            raise ValueError("No cloud of the sequence has a point with finite coordinates: there is nothing to see.")


def read_clouds(path: str | os.PathLike[str]) -> CloudSequence:
    """Reads a recorded sequence. Nothing is unpickled.

    An `.npz` file has `time` [T] in seconds, `gripper_pose` [T, 2, 3], and `points`: either [T, S, D], padded with NaN,
    or the points of all frames in a row, [M, D], with `count` [T], how many belong to each frame.

    A folder has PCD files, one per frame in the order of their names, and `poses.csv` with the header
    `time,x0,y0,theta0,x1,y1,theta1` and one row per frame.

    Raises:
        ValueError: there is no such sequence, or something in it is missing or does not fit together.
    """
    path = pathlib.Path(path)
    if path.is_dir():
        return _read_folder(path)
    if not path.is_file() or path.suffix.lower() != ".npz":
        found = "is another kind of file" if path.is_file() else "does not exist"
        raise ValueError(f"{path} {found}, expected an .npz file or a folder of PCD files.")
    arrays = read_npz(path, ["time", "gripper_pose", "points"], ["count"])
    for name in ("time", "gripper_pose", "points"):
        if not np.issubdtype(arrays[name].dtype, np.floating):
            raise ValueError(f"{path}: {name} is of type {arrays[name].dtype}, expected floating point numbers.")
    points = arrays["points"]
    if "count" in arrays:
        count = arrays["count"]
        if count.ndim != 1 or not np.issubdtype(count.dtype, np.integer) or (count < 0).any():
            raise ValueError(
                f"{path}: count has shape {count.shape} and type {count.dtype}, expected whole numbers >= 0, one for "
                "each frame."
            )
        if points.ndim != 2 or sum(count.tolist()) != len(points):
            raise ValueError(
                f"{path}: count sums up to {sum(count.tolist())}, but points has shape {points.shape}: expected as "
                "many rows."
            )
        clouds = np.split(points, np.cumsum(count)[:-1]) if len(count) else []
    elif points.ndim == 3:
        clouds = [frame[~np.isnan(frame).all(axis=1)] for frame in points]
    else:
        raise ValueError(f"{path}: points has shape {points.shape}, expected [T, S, D], or [M, D] with count [T].")
    return CloudSequence(np.asarray(arrays["time"], float), clouds, np.asarray(arrays["gripper_pose"], float))


def _by_number(path: pathlib.Path) -> list[tuple[str, int]]:
    """Orders names by the numbers in them: 9.pcd before 10.pcd."""
    return [(word, int(number or 0)) for word, number in re.findall(r"(\D*)(\d*)", path.name)]


def _read_folder(folder: pathlib.Path) -> CloudSequence:
    files = sorted((path for path in folder.iterdir() if path.suffix.lower() == ".pcd"), key=_by_number)
    poses = folder / POSES_FILE
    if not files or not poses.is_file():
        raise ValueError(
            f"{folder} has {len(files)} PCD files and {'a' if poses.is_file() else 'no'} {POSES_FILE}, expected at "
            f"least one, and the grippers' poses with the header {','.join(POSES_HEADER)}."
        )
    first, *lines = [line for line in read_text(poses).splitlines() if line.strip()] or [""]
    if tuple(name.strip() for name in first.split(",")) != POSES_HEADER:
        raise ValueError(f"{poses} begins with {shown(first)}, expected {','.join(POSES_HEADER)!r}.")
    if len(lines) != len(files):
        raise ValueError(f"{poses} has {len(lines)} rows, expected {len(files)} rows: one for each file.")
    rows = np.empty((len(files), len(POSES_HEADER)))
    for row, line in zip(rows, lines, strict=True):
        try:
            row[:] = np.array(line.split(","), float).reshape(row.shape)
        except ValueError:
            raise ValueError(
                f"{poses} has a row {shown(line)}, expected {len(POSES_HEADER)} numbers separated by commas."
            ) from None
    return CloudSequence(rows[:, 0], [read_pcd(file) for file in files], rows[:, 1:].reshape(-1, 2, 3))


def read_pcd(path: pathlib.Path) -> Float[np.ndarray, "S 3"]:
    """Positions x, y, z from a file of the Point Cloud Library, version 0.7, ascii or binary, in the file's order.

    They are float32, NaN where the file has none, shape [S, 3]. Other fields are passed over, and so is the viewpoint:
    the positions are taken as they stand.

    Raises:
        ValueError: the file is not a PCD file, is compressed, cut short, or has no x, y and z.
    """
    content = read_bytes(path)
    header, start = _header(path, content)
    try:
        names = header["FIELDS"]
        counts = [int(value) for value in header.get("COUNT", ["1"] * len(names))]
        sizes = [int(value) for value in header["SIZE"]]
        kinds = [_KINDS[value] for value in header["TYPE"]]
        points = int(header["POINTS"][0])
        if points < 0 or min(counts) < 1:
            raise ValueError(f"{points} points of {min(counts)} values")
        encoding = header["DATA"][0].lower()
        columns = [
            (f"{index}", f"<{kind}{size}", (count,))
            for index, (kind, size, count) in enumerate(zip(kinds, sizes, counts, strict=True))
        ]
        layout = np.dtype(columns)
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise ValueError(f"{path} has a PCD header that is incomplete or contradicts itself: {error}.") from None
    if len(columns) != len(names) or not {"x", "y", "z"} <= set(names):
        raise ValueError(
            f"{path} has the fields {' '.join(names)}, expected x, y and z among them, each with its type."
        )
    if encoding == "binary":
        size = points * layout.itemsize
        if len(content) - start < size:
            raise ValueError(f"{path} is cut short: {len(content) - start} bytes of points, expected {size}.")
        table = np.frombuffer(content, layout, count=points, offset=start)
        return np.stack([table[str(names.index(axis))][:, 0] for axis in "xyz"], axis=1).astype(np.float32)
    if encoding == "ascii":
        column = np.cumsum([0, *counts])
        rows = [line.split() for line in content[start:].decode("ascii", "replace").splitlines() if line.strip()]
        if len(rows) < points or any(len(row) < column[-1] for row in rows[:points]):
            raise ValueError(f"{path} is cut short: expected {points} rows of {column[-1]} values.")
        try:
            values = [[float(row[column[names.index(axis)]]) for axis in "xyz"] for row in rows[:points]]
        except ValueError as error:
            raise ValueError(f"{path} has a point that is not a number: {shown(str(error))}") from None
        return np.array(values).reshape(points, 3).astype(np.float32)
    raise ValueError(
        f"{path} has DATA {encoding}, expected ascii or binary: convert it with pcl_convert_pcd_ascii_binary."
    )


def _header(path: pathlib.Path, content: bytes) -> tuple[dict[str, list[str]], int]:
    """Entries of the header, and where the points begin."""
    entries: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in entries:
        end = content.find(b"\n", start)
        if end < 0 or start > 4096:
            raise ValueError(f"{path} is not a PCD file: it has no line that begins with DATA.")
        words = content[start:end].decode("ascii", "replace").split()
        start = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0]] = words[1:]
    return entries, start
