"""Writes runs and diagnoses as Rerun recordings (`.rrd`), with the library rerun-sdk.

Each episode is an entity of its own, on one timeline "time" in seconds from its start:

    EPISODE/keypoints, EPISODE/cable         what was observed, as points and as a line
    EPISODE/gripper_0, EPISODE/gripper_1     poses, with an arrow along the cable's tangent
    EPISODE/target                           where the log states one
    EPISODE/nominal, EPISODE/explained       simulated cables, where a diagnosis stored them
    EPISODE/error_cm/...                     distance to the target, and of each simulated cable to the observed one

A planar cable lies at z = 0. Needs the extra: `pip install 'cablejax[rerun]'`.
"""

from __future__ import annotations

import os
import pathlib
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from cablejax.control.run import shape_error_cm
from cablejax.extras import from_extra
from cablejax.gaplog import Episode, episodes_of, targets_of
from cablejax.report.style import LIGHT
from cablejax.simulate.pose import points_in_space, pose_in_space
from cablejax.types import GapLog
from cablejax.whole_file import whole_file

TIMELINE = "time"
"""Name of the timeline."""

# Length of an arrow and radius of a keypoint [lengths of the cable].
_ARROW, _RADIUS = 0.06, 0.004
_MOST_PANES = 9
_COLOURS = {"nominal": LIGHT.direct, "explained": LIGHT.residual}


def write_rerun(
    path: str | os.PathLike[str],
    log: GapLog,
    *,
    simulated: Mapping[str, Float[np.ndarray, "E T N D"]] | None = None,
    about: str = "",
) -> pathlib.Path:
    """Writes a gap log as a Rerun recording, whole or not at all, over what was there, and returns its path.

    Args:
        path: the file, by custom `*.rrd`.
        log: to be written.
        simulated: keypoints of simulators on this log [m], NaN = not simulated, by their names.
        about: Markdown to be shown with it.

    Raises:
        ValueError: the library rerun-sdk is not installed.
    """
    rr, path = from_extra("rerun", "rerun", "Rerun recordings need the library rerun-sdk"), pathlib.Path(path)
    recording = rr.RecordingStream("cablejax", make_default=False)
    content = recording.binary_stream()
    names = [f"{e}_{re.sub(r'[^A-Za-z0-9_]+', '_', motion)[:40]}" for e, motion in enumerate(log.meta["motion"])]
    episodes = dict(zip(names, episodes_of(log), strict=True))
    for (name, episode), target in zip(episodes.items(), targets_of(log), strict=True):
        _write_observed(rr, recording, name, episode, log.meta["cable"]["length_m"])
        if target is not None:
            line = rr.LineStrips3D([points_in_space(target)], colors=_rgb(LIGHT.target))
            recording.log(f"{name}/target", line, static=True)
            _write_error(rr, recording, f"{name}/error_cm/target", episode, target)
    for kind, points in (simulated or {}).items():
        for e, (name, episode) in enumerate(episodes.items()):
            moved = points[e, : len(episode.time)]
            _write_lines(rr, recording, f"{name}/{kind}", episode.time, moved, _COLOURS.get(kind, LIGHT.muted))
            _write_error(rr, recording, f"{name}/error_cm/{kind}", episode, moved)
    recording.log("about", rr.TextDocument(about, media_type="text/markdown"), static=True)
    recording.send_blueprint(_blueprint(list(episodes)))
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as stream:
        stream.write(content.read() or b"")
    recording.disconnect()
    return path


def _write_observed(rr: Any, recording: Any, name: str, episode: Episode, length: float) -> None:
    """Keypoints and grippers, drawn in proportion to the cable's length [m]."""
    clock = _clock(rr, episode.time)
    points = points_in_space(episode.keypoints)
    seen = np.isfinite(points).all(axis=-1)
    recording.send_columns(
        f"{name}/keypoints", [clock], rr.Points3D.columns(positions=points[seen]).partition(seen.sum(axis=1).tolist())
    )
    dots = rr.Points3D.from_fields(colors=_rgb(LIGHT.ink), radii=_RADIUS * length)
    recording.log(f"{name}/keypoints", dots, static=True)
    _write_lines(rr, recording, f"{name}/cable", episode.time, episode.keypoints, LIGHT.ink)
    pose = pose_in_space(episode.gripper_pose)
    for q in range(pose.shape[1]):
        columns = rr.Transform3D.columns(translation=pose[:, q, :3], quaternion=np.roll(pose[:, q, 3:], -1, axis=-1))
        recording.send_columns(f"{name}/gripper_{q}", [clock], columns)
        arrow = rr.Arrows3D(vectors=[[_ARROW * length, 0.0, 0.0]], colors=_rgb(LIGHT.gripper))
        recording.log(f"{name}/gripper_{q}", arrow, static=True)


def _write_lines(rr: Any, recording: Any, entity: str, time: np.ndarray, points: np.ndarray, colour: str) -> None:
    """A line through the known points of each sample."""
    strips = [row[np.isfinite(row).all(axis=-1)] for row in points_in_space(np.asarray(points, np.float32))]
    recording.send_columns(entity, [_clock(rr, time)], rr.LineStrips3D.columns(strips=strips))
    recording.log(entity, rr.LineStrips3D.from_fields(colors=_rgb(colour)), static=True)


def _write_error(rr: Any, recording: Any, entity: str, episode: Episode, points: np.ndarray) -> None:
    """Root mean square distance of the observed keypoints to others [cm], where there are any."""
    error = shape_error_cm(episode.keypoints, points)
    known = np.isfinite(error)
    if known.any():
        clock = _clock(rr, episode.time[known])
        recording.send_columns(entity, [clock], rr.Scalars.columns(scalars=error[known]))


def _clock(rr: Any, time: np.ndarray) -> Any:
    return rr.TimeColumn(TIMELINE, duration=time)


def _rgb(colour: str) -> tuple[int, ...]:
    return tuple(bytes.fromhex(colour.removeprefix("#")))


def _blueprint(names: list[str]) -> Any:
    """A view of each episode over the errors of all."""
    import rerun.blueprint as rrb

    views = [rrb.Spatial3DView(origin=f"/{name}", name=name) for name in names]
    layout = rrb.Grid(*views) if len(views) <= _MOST_PANES else rrb.Tabs(*views)
    errors = rrb.TimeSeriesView(origin="/", name="error [cm]", contents=[f"+ /{name}/error_cm/**" for name in names])
    below = rrb.Horizontal(errors, rrb.TextDocumentView(origin="/about", name="about"), column_shares=[3, 1])
    return rrb.Blueprint(rrb.Vertical(layout, below, row_shares=[2, 1]))
