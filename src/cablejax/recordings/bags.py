"""ROS 2 bags and MCAP files: keypoints as `geometry_msgs/PoseArray`, grippers as `geometry_msgs/PoseStamped`.

Read through the library rosbags, which needs no ROS: `pip install 'cablejax[recordings]'`.
"""

from __future__ import annotations

import os
import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from cablejax.extras import from_extra
from cablejax.limits import counted, require
from cablejax.poses import poses_at, without_misreadings
from cablejax.recordings.layout import Fields, Layout, read_layout
from cablejax.recordings.mcap_log import MAGIC
from cablejax.recordings.table import unit_quaternions
from cablejax.recordings.take import Take, require_increasing
from cablejax.types import GapLog

POSE_ARRAY, POSE_STAMPED = "geometry_msgs/msg/PoseArray", "geometry_msgs/msg/PoseStamped"
"""ROS types of the keypoints and of a gripper."""

SLOWEST = 0.075
"""Time between a gripper's poses [s] from which on too little is known of its motion in between."""


_MEND = (
    "If it was cut off, copy it again, or mend it with `mcap recover CUT.mcap -o WHOLE.mcap`, with `sqlite3 CUT.db3 "
    "'.recover' | sqlite3 WHOLE.db3`, or, where metadata.yaml is missing or damaged, with `ros2 bag reindex FOLDER`."
)


class BagError(ValueError):
    """A bag that cannot be read, or that lacks the topics of the layout."""


def import_mcap(path: str | os.PathLike[str], layout: str | os.PathLike[str]) -> tuple[GapLog, list[str]]:
    """Reads, checks and repairs a recording in a ROS 2 bag (a folder), an .mcap or a .db3 file.

    Times are those in the headers. Gripper poses are interpolated to the times of the keypoints.

    Args:
        path: of the bag.
        layout: TOML file that names the topics, see `docs/how_to/own_recording.md`.

    Returns:
        A gap log, in space or on the table of the layout, and a sentence on each repair.

    Raises:
        ValueError: rosbags is not installed, a file or topic is missing or of another type, or the recording cannot be
            used without guessing.
    """
    path = pathlib.Path(path)
    _require_bag(path)
    how = read_layout(layout, "topics")
    take, misread = _take(path, how)
    return how.log_of((take,), misread)


def _take(path: pathlib.Path, how: Layout) -> tuple[Take, list[str]]:
    """The take of a bag, and sentences on frames that differ and on topics with poses that jump away and back."""
    fields: Fields = how.place
    keypoints_topic = fields.take("keypoints", str, "the topic of the keypoints")
    gripper_topics = fields.names("grippers", (2,), "the topics of gripper 0 and gripper 1", None)
    motion = fields.take("motion", str, "what the grippers did", "recorded")
    fields.nothing_left()
    wanted = {keypoints_topic: POSE_ARRAY, **{topic: POSE_STAMPED for topic in gripper_topics or []}}
    messages, frames = _messages(path, wanted)
    time, rows = _in_order(path, keypoints_topic, messages)
    count = [len(row) for row in rows]
    if len(set(count)) > 1:
        other = next(row for row, poses in enumerate(count) if poses != count[0])
        raise ValueError(
            f"{path}, message {other} on {keypoints_topic}, has {counted(count[other], 'pose')}, and the first "
            f"{count[0]}, expected the same number in each, NaN where a keypoint was not observed."
        )
    if not count[0]:
        raise ValueError(f"{path}: the messages on {keypoints_topic} have no poses, expected one for each keypoint.")
    poses, misread = None, []
    if len(frames) > 1:
        misread.append(
            f"The headers name the frames {', '.join(sorted(frames))}: all positions are assumed to be in one frame."
        )
    if gripper_topics is not None:
        tracks = []
        for topic in gripper_topics:
            stamps, gripper_rows = _in_order(path, topic, messages)
            if stamps[0] > time[-1] or stamps[-1] < time[0]:
                raise ValueError(
                    f"{path}: {topic} has time stamps from {stamps[0]:.3f} to {stamps[-1]:.3f} s and {keypoints_topic} "
                    f"from {time[0]:.3f} to {time[-1]:.3f} s, which do not overlap: expected the times of one clock in "
                    "the headers."
                )
            if (apart := float(np.median(np.diff(stamps)))) > SLOWEST:
                raise ValueError(
                    f"{path}: the poses on {topic} are {apart:.3g} s apart, expected {SLOWEST:g} s at most, since the "
                    "gripper's motion in between is unknown. Record them at a higher rate."
                )
            quaternions = unit_quaternions(np.array(gripper_rows), _place(path, topic))
            track, jumps = without_misreadings(stamps, quaternions)
            misread += [f"{topic} {words}" for words in jumps.values()]
            tracks.append(_at(time, stamps, track[:, 0]))
        poses = np.stack(tracks, axis=1)
    return Take(path.stem, time - time[0], np.array(rows)[..., :3], poses, labels={"motion": motion}), misread


def _messages(path: pathlib.Path, wanted: dict[str, str]) -> tuple[dict[str, list[tuple[float, np.ndarray]]], set[str]]:
    """Time [s] and poses (x, y, z, qw, qx, qy, qz) of every message on the wanted topics, and the frames they name."""
    what = "Reading bags needs the library rosbags"
    reading, types = (from_extra(f"rosbags.{part}", "recordings", what) for part in ("highlevel", "typesys"))
    found: dict[str, list[tuple[float, np.ndarray]]] = {topic: [] for topic in wanted}
    frames, size = set(), 0
    try:
        # Bags of older releases hold no message definitions; these messages have been the same in all of them.
        with reading.AnyReader([path], default_typestore=types.get_typestore(types.Stores.ROS2_HUMBLE)) as bag:
            _require_topics(path, {c.topic: c.msgtype for c in bag.connections}, wanted)
            connections = [c for c in bag.connections if c.topic in wanted]
            for connection, _, data in bag.messages(connections=connections):
                size += len(data)
                require(size, "array_bytes", f"The size of the messages on {', '.join(wanted)}", "Cut the recording.")
                message: Any = bag.deserialize(data, connection.msgtype)
                stamp = message.header.stamp
                frames.add(message.header.frame_id)
                poses = message.poses if wanted[connection.topic] == POSE_ARRAY else [message.pose]
                found[connection.topic].append(
                    (stamp.sec + 1e-9 * stamp.nanosec, np.array([_numbers(p) for p in poses]))
                )
    except BagError:
        raise
    except Exception as error:  # on a damaged file rosbags raises what its parts raise
        said = next(iter(str(error).splitlines()), type(error).__name__).rstrip(".")
        raise BagError(f"{path} could not be read as a bag: {said}. {_MEND}") from error
    for topic, messages in found.items():
        if len(messages) < 2:
            raise ValueError(f"{path} has {counted(len(messages), 'message')} on {topic}, expected at least two.")
        if len({stamp for stamp, _ in messages}) == 1:
            raise ValueError(
                f"{path}: all messages on {topic} are stamped {messages[0][0]:g} s, expected the time of each in its "
                "header: let the node that publishes them set header.stamp."
            )
    return found, frames - {""}


def _require_bag(path: pathlib.Path) -> None:
    """Looks at the bag before its layout is asked for: a layout does not help a file that is no bag."""
    expected = "expected a bag: a folder with metadata.yaml, an .mcap or a .db3 file."
    if not path.exists():
        raise ValueError(f"{path} does not exist, {expected}")
    files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
    size = sum(file.stat().st_size for file in files)
    if not size:
        raise BagError(f"{path} is empty, {expected}")
    if path.suffix == ".mcap" and path.is_file():
        with path.open("rb") as stream:
            head = stream.read(len(MAGIC))
        if head != MAGIC:
            raise BagError(f"{path} is no MCAP file: it begins with {head!r}, {expected}")
    require(size, "bag_bytes", f"The size of {path}", "Cut the recording.")


def _require_topics(path: pathlib.Path, types: dict[str, str], wanted: dict[str, str]) -> None:
    for topic, kind in wanted.items():
        if topic not in types:
            listed = ", ".join(f"{name} ({of})" for name, of in sorted(types.items()))
            raise BagError(f"{path} has no topic {topic}; it has {listed}. Correct the name in the layout.")
        if types[topic] != kind:
            raise BagError(f"{path}: {topic} has messages of type {types[topic]}, expected {kind}.")


def _numbers(pose: Any) -> list[float]:
    p, q = pose.position, pose.orientation
    return [p.x, p.y, p.z, q.w, q.x, q.y, q.z]


def _in_order(
    path: pathlib.Path, topic: str, messages: dict[str, list[tuple[float, np.ndarray]]]
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Times [s] and poses of a topic; raises ValueError where the times do not increase from message to message."""
    time = np.array([stamp for stamp, _ in messages[topic]])
    advice = (
        "Either two nodes publish on the topic, or messages were recorded twice, or a clock was set back: sorted by "
        "time they may show a motion that never was. Keep the messages of one node, in the order of their headers."
    )
    require_increasing(time, _place(path, topic), advice)
    return time, [poses for _, poses in messages[topic]]


def _place(path: pathlib.Path, topic: str) -> Callable[[int], str]:
    """Says where a message is, counted from 0 in the order of recording."""
    return lambda row: f"{path}, message {row} on {topic}"


def _at(time: np.ndarray, stamps: np.ndarray, poses: Float[np.ndarray, "S 7"]) -> Float[np.ndarray, "T 7"]:
    """Poses at other times, shape [T, 7], see `poses_at`; NaN in gaps, before the first and after the last."""
    track = poses_at(time, stamps, poses)
    after = np.clip(np.searchsorted(stamps, time), 1, len(stamps) - 1)
    far = stamps[after] - stamps[after - 1] > SLOWEST
    outside = (time < stamps[0]) | (time > stamps[-1])
    track[outside | (far & ~np.isin(time, stamps))] = np.nan
    return track
