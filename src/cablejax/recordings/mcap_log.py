"""Writes gap logs as MCAP files with JSON messages, which Foxglove shows, and reads them back.

    /cable/keypoints   foxglove.PointCloud      keypoints in float32, NaN = not observed; a planar cable has z = 0
    /grippers/pose     foxglove.PosesInFrame    the grippers, for viewers; not read back
    /grippers/sample   cablejax.Sample          episode, time, poses and commands in the gap log's own form

Episodes follow each other a second apart. The log's `meta` is a metadata record named after the gap log's schema. Needs
the library mcap: `pip install 'cablejax[recordings]'`.
"""

from __future__ import annotations

import base64
import collections
import functools
import json
import os
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any, BinaryIO

import numpy as np

from cablejax import __version__
from cablejax.extras import from_extra
from cablejax.gaplog import Episode, episodes_of, stack_episodes
from cablejax.gaplog_check import SCHEMA, GapLogError, meta_text, reading_export
from cablejax.limits import require
from cablejax.simulate.pose import points_in_space, pose_in_space
from cablejax.types import GapLog
from cablejax.whole_file import whole_file

MAGIC = b"\x89MCAP0\r\n"
"""First bytes of an MCAP file."""
KEYPOINTS, POSES, SAMPLES = "/cable/keypoints", "/grippers/pose", "/grippers/sample"
"""Topics of the file."""

_LIBRARY = "cablejax "
_PAUSE = 1_000_000_000
_FLOAT32 = 7  # in Foxglove's list of numeric types

_mcap = functools.partial(from_extra, extra="recordings", what="MCAP files need the library mcap")


def write_mcap(path: str | os.PathLike[str], log: GapLog) -> pathlib.Path:
    """Writes a gap log as an MCAP file, whole or not at all, over what was there, and returns its path.

    Raises:
        GapLogError: `meta` has a field that JSON cannot hold.
        ValueError: the library mcap is not installed.
    """
    library, path = _mcap("mcap.writer"), pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as stream:
        writer = library.Writer(stream, enable_data_crcs=True)
        writer.start(profile="", library=_LIBRARY + __version__)
        writer.add_metadata(SCHEMA, {"meta": meta_text(log.meta)})
        channels = {}
        for topic, (name, fields) in _SCHEMAS.items():
            schema = writer.register_schema(name, "jsonschema", json.dumps({"title": name, **fields}).encode())
            channels[topic] = writer.register_channel(topic, "json", schema)
        begin = 0
        for index, episode in enumerate(episodes_of(log)):
            stamps = begin + np.round(1e9 * (episode.time - episode.time[0])).astype(np.int64)
            for t, stamp in enumerate(stamps.tolist()):
                for topic, message in _messages(episode, t, stamp, index, holds=log.hold is not None):
                    data = json.dumps(message, separators=(",", ":"), allow_nan=False).encode()
                    writer.add_message(channels[topic], log_time=stamp, data=data, publish_time=stamp, sequence=t)
            begin = int(stamps[-1]) + _PAUSE
        writer.finish()
    return path


def written_here(path: str | os.PathLike[str]) -> bool:
    """Whether a file is an MCAP file of `write_mcap`, as its first bytes say."""
    path = pathlib.Path(path)
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        head = stream.read(64)
    return head.startswith(MAGIC) and _LIBRARY.encode() in head


def read_mcap(path: str | os.PathLike[str]) -> GapLog:
    """Reads the gap log in an MCAP file of `write_mcap`: the same to the last bit.

    Raises:
        GapLogError: the file is no such file, damaged, or its log does not follow the format.
        ValueError: the library mcap is not installed, or the file is too large.
        FileNotFoundError: there is no such file.
    """
    library, path = _mcap("mcap.reader"), pathlib.Path(path)
    if not path.exists():
        raise FileNotFoundError(f"There is no file {path}.")
    if not written_here(path):
        raise GapLogError(
            f"{path} was not written by `cablejax export mcap`. A bag of other messages is imported with a layout: "
            "cablejax import mcap BAG --layout layout.toml."
        )
    require(path.stat().st_size, "array_bytes", f"The size of {path}")
    with reading_export(path):
        with path.open("rb") as stream:
            # a reader by topics checks the messages only, not the log's `meta`
            for _ in library.StreamReader(stream, emit_chunks=True, validate_crcs=True).records:
                pass
            stream.seek(0)
            meta, clouds, samples = _content(library, stream)
        return stack_episodes(_episodes(meta, clouds, samples), meta, holds="hold" in samples[0])


def _content(library: Any, stream: BinaryIO) -> tuple[dict[str, Any], list[Any], list[Any]]:
    """The log's `meta` and the messages on both topics that are read."""
    reader = library.make_reader(stream, validate_crcs=True)
    summary = reader.get_summary()
    size = sum(index.uncompressed_size for index in summary.chunk_indexes)
    require(size, "array_bytes", "The size of its messages")
    meta = next(json.loads(record.metadata["meta"]) for record in reader.iter_metadata() if record.name == SCHEMA)
    found: dict[str, list[Any]] = {KEYPOINTS: [], SAMPLES: []}
    for _, channel, message in reader.iter_messages(topics=list(found)):
        found[channel.topic].append({"stamp": message.log_time, **json.loads(message.data)})
    return meta, found[KEYPOINTS], found[SAMPLES]


def _episodes(meta: Mapping[str, Any], clouds: list[Any], samples: list[Any]) -> list[Episode]:
    if not samples or [cloud["stamp"] for cloud in clouds] != [sample["stamp"] for sample in samples]:
        raise GapLogError(
            f"The messages on {KEYPOINTS} and {SAMPLES} have different time stamps. Export the log again."
        )
    dimension = 2 if np.shape(samples[0]["pose"])[-1] == 3 else 3
    groups = collections.defaultdict(list)
    for cloud, sample in zip(clouds, samples, strict=True):
        points = np.frombuffer(base64.b64decode(cloud["data"], validate=True), "<f4").reshape(-1, 3)
        groups[sample["episode"]].append((points[:, :dimension], sample))
    return [
        Episode(
            motion=meta["motion"][index],
            time=np.array([sample["time"] for _, sample in rows], float),
            keypoints=np.stack([points for points, _ in rows]),
            gripper_pose=np.array([sample["pose"] for _, sample in rows], float),
            gripper_command=np.array([sample["command"] for _, sample in rows], float),
            hold=np.array([sample.get("hold", False) for _, sample in rows], bool),
        )
        for index, rows in sorted(groups.items())
    ]


def _messages(
    episode: Episode, t: int, stamp: int, index: int, *, holds: bool
) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """The messages of one sample by their topics."""
    header = {"timestamp": dict(zip(("sec", "nsec"), divmod(stamp, 1_000_000_000), strict=True)), "frame_id": "world"}
    points, pose = episode.keypoints[t], episode.gripper_pose[t]
    yield (
        KEYPOINTS,
        {
            **header,
            "pose": _pose(np.eye(7)[3]),
            "point_stride": 12,
            "fields": [{"name": name, "offset": 4 * k, "type": _FLOAT32} for k, name in enumerate("xyz")],
            "data": base64.b64encode(points_in_space(points).astype("<f4").tobytes()).decode(),
        },
    )
    yield POSES, {**header, "poses": [_pose(row) for row in pose_in_space(pose)]}
    # a command that is held for no sample need not be a number, for which JSON has no word
    command = [[v if np.isfinite(v) else None for v in row] for row in episode.gripper_command[t].tolist()]
    sample = {"episode": index, "time": float(episode.time[t]), "pose": pose.tolist(), "command": command}
    yield SAMPLES, {**sample, "hold": bool(episode.hold[t])} if holds else sample


def _pose(pose: np.ndarray) -> dict[str, dict[str, float]]:
    """A pose (x, y, z, qw, qx, qy, qz) as Foxglove has it."""
    numbers = pose.tolist()
    return {
        "position": dict(zip("xyz", numbers[:3], strict=True)),
        "orientation": dict(zip("wxyz", numbers[3:], strict=True)),
    }


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


_NUMBER, _INTEGER, _TEXT = {"type": "number"}, {"type": "integer"}, {"type": "string"}
_ROWS = {"type": "array", "items": {"type": "array", "items": {"type": ["number", "null"]}}}
_POSE = _object(
    position=_object(x=_NUMBER, y=_NUMBER, z=_NUMBER), orientation=_object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
)
_HEADER = {"timestamp": _object(sec=_INTEGER, nsec=_INTEGER), "frame_id": _TEXT}
_SCHEMAS: Mapping[str, tuple[str, dict[str, Any]]] = {
    KEYPOINTS: (
        "foxglove.PointCloud",
        _object(
            **_HEADER,
            pose=_POSE,
            point_stride=_INTEGER,
            fields={"type": "array", "items": _object(name=_TEXT, offset=_INTEGER, type=_INTEGER)},
            data={"type": "string", "contentEncoding": "base64"},
        ),
    ),
    POSES: ("foxglove.PosesInFrame", _object(**_HEADER, poses={"type": "array", "items": _POSE})),
    SAMPLES: (
        "cablejax.Sample",
        _object(episode=_INTEGER, time=_NUMBER, pose=_ROWS, command=_ROWS, hold={"type": "boolean"}),
    ),
}
