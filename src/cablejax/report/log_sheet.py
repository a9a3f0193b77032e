"""The page of a gap log: its cable, episodes and noise, and how the cable moved."""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from cablejax.arrays import evenly
from cablejax.cable_file import config_of_log
from cablejax.control.run import shape_error_cm
from cablejax.diagnose.noise import noise_floor
from cablejax.gaplog import Episode, episodes_of, targets_of
from cablejax.gaplog_check import META_FIELDS
from cablejax.limits import counted
from cablejax.report.effect_words import millimetres
from cablejax.report.sheet import Sheet, cable_cards, cable_facts, span
from cablejax.report.style import DIAGNOSIS_STYLE, LIGHT, cable_curve
from cablejax.types import GapLog

_SHOWN = 6
_LISTED = 40
_MOMENTS = 5


def log_sheet(log: GapLog, name: str, exported: str = "") -> Sheet:
    """What a gap log holds; `exported` is the format of one that has to be imported first, as the command has it."""
    episodes, targets, planar = episodes_of(log), targets_of(log), not log.in_space
    cable = dataclasses.replace(config_of_log(log).cable, diameter=log.meta["cable"]["diameter_m"])
    points = log.keypoints[log.valid]
    seen = np.asarray(np.isfinite(points).all(axis=-1))
    noise, how = _noise(log)
    file = shlex.quote(name)
    # a few episodes, evenly over the log
    chosen = evenly(len(episodes), _SHOWN)
    drawn = [(dataclasses.replace(episodes[e], motion=f"{e}: {episodes[e].motion}"), targets[e]) for e in chosen]
    stated = any(target is not None for target in targets)
    which = "" if len(chosen) == len(episodes) else f" {len(chosen)} of {len(episodes)} episodes."
    ranges = ", ".join(f"{axis} {span(points[..., k])}" for k, axis in enumerate("xyz"[: points.shape[-1]]))
    return Sheet(
        kind="gap log",
        title=f"{counted(len(episodes), 'episode')} of a cable of {cable.length:g} m "
        f"{'on a table' if planar else 'in space'}, {log.intervals.sum():.0f} s in all",
        lead=f"{name}: {log.meta['source']}",
        cards=[
            ("Samples", f"{len(seen)}", f"{log.rate} per second" if log.rate else "one per episode"),
            ("Noise of a coordinate", noise, how),
            ("Observed", f"{100 * seen.mean():.4g} %", f"of {seen.shape[1]} keypoints in all samples"),
            ("Range of the keypoints [m]", ranges, ""),
            *cable_cards(cable, on_table=planar),
        ],
        figures=[
            (_shapes_figure(drawn), _SHAPES + (_TARGET if stated else "") + which),
            (_time_figure(drawn), (_COURSE_TO_TARGET if stated else _COURSE) + which),
        ],
        tables=[_table(episodes, targets)],
        following=(
            *([f"Convert it back to a gap log: cablejax import {exported} {file} --out log.npz"] if exported else []),
            f"Find out what the simulator lacks: cablejax diagnose {'log.npz' if exported else file}"
            if seen.any()
            else f"Play it on a simulated plant: cablejax shape --motion {'log.npz' if exported else file}",
            f"View it in motion: cablejax export rerun {'log.npz' if exported else file} --out run.rrd",
        ),
        facts={
            **cable_facts(cable),
            "grasp": ", ".join(log.meta["grasp"]),
            "gravity": f"{log.meta['gravity_m_per_s2']} m/s^2",
            **{key: _short(value) for key, value in log.meta.items() if key not in META_FIELDS},
        },
    )


_SHAPES = "The cable at the start (light), in between, and at the end (blue); dots are keypoints."
_TARGET = " The broad grey line is the target where the log states one."
_COURSE = "Speed of the faster gripper."
_COURSE_TO_TARGET = "Speed of the faster gripper, and distance of the keypoints to the target where the log states one."


def _noise(log: GapLog) -> tuple[str, str]:
    """The noise of one coordinate in words, and what it was estimated from."""
    points = np.where(log.valid[..., None, None], log.keypoints.astype(float), np.nan)
    try:
        floor = noise_floor(points, None, order=4) if log.in_space else noise_floor(points, log.hold, order=3)
    except ValueError:
        return "not known", "the log is too short to separate noise from motion"
    source = "scatter while the grippers rest" if floor.from_holds else "scatter between neighbouring samples"
    return millimetres(1e3 * float(np.sqrt(np.mean(floor.std**2)))), source


def _table(episodes: Sequence[Episode], targets: Sequence[np.ndarray | None]):
    """A row for each episode."""
    rows = []
    for index, (episode, target) in enumerate(zip(episodes, targets, strict=True)):
        seen = np.isfinite(episode.keypoints).all(axis=-1)
        error = None if target is None else shape_error_cm(episode.keypoints, target)
        rows.append(
            (
                f"{index}: {episode.motion}",
                f"{episode.time[-1] - episode.time[0]:.3g}",
                f"{len(episode.time)}",
                f"{100 * seen.mean():.4g} %",
                f"{_speed(episode).max(initial=0.0):.3g}",
                "" if error is None else f"{_centimetres(error[0])} to {_centimetres(error[-1])}",
            )
        )
    heading = "Episodes" if len(rows) <= _LISTED else f"The first {_LISTED} of {len(rows)} episodes"
    head = ("episode", "seconds", "samples", "observed", "fastest gripper [cm/s]", "distance to the target [cm]")
    stated = any(target is not None for target in targets)
    return heading, head[: None if stated else -1], [row[: None if stated else -1] for row in rows[:_LISTED]]


def _centimetres(error: float) -> str:
    return f"{error:.2f}" if np.isfinite(error) else "not seen"


def _speed(episode: Episode) -> np.ndarray:
    """Speed of the faster gripper after each sample but the last [cm/s]; as measured where no command was logged."""
    linear, place = (a[..., : episode.keypoints.shape[-1]] for a in (episode.gripper_command, episode.gripper_pose))
    linear = linear[:-1] if linear.any() else np.diff(place, axis=0) / np.diff(episode.time)[:, None, None]
    return 100 * np.linalg.norm(linear, axis=-1).max(axis=-1, initial=0.0)


def _shapes_figure(episodes: Sequence[tuple[Episode, np.ndarray | None]]) -> Figure:
    """The cable at some moments of each episode, from above; in space from the side on which it extends farther."""
    columns = min(len(episodes), 3)
    rows = -(-len(episodes) // columns)
    with matplotlib.rc_context(DIAGNOSIS_STYLE):
        figure = Figure(figsize=(10.5, 0.6 + 3.0 * rows), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
        for ax in axes[len(episodes) :]:
            ax.set_visible(False)
        for ax, (episode, target) in zip(axes, episodes, strict=False):
            points = episode.keypoints.astype(float)
            view = _view(points)
            seen = np.flatnonzero(np.isfinite(points).all(axis=-1).sum(axis=1) >= 2)
            moments = seen[evenly(len(seen), _MOMENTS)]
            if target is not None:
                ax.plot(*cable_curve(target[:, view]).T, color=LIGHT.target, lw=7, alpha=0.45, solid_capstyle="round")
            for k, t in enumerate(moments[:-1]):
                ax.plot(*cable_curve(points[t][:, view]).T, color=LIGHT.muted, alpha=0.35 + 0.1 * k)
            for t in moments[-1:]:
                ax.plot(*cable_curve(points[t][:, view]).T, color=LIGHT.residual, lw=2.2)
                ax.plot(*points[t][:, view].T, "o", color=LIGHT.residual, ms=3)
            across, up = (f"{'xyz'[k]} [m]" for k in view)
            ax.set(aspect="equal", title=_plain(episode.motion), xlabel=across, ylabel=up)
            ax.label_outer()
    return figure


def _view(points: np.ndarray) -> list[int]:
    """The axes to look along: both of the plane; in space the horizontal one with more motion, and the vertical."""
    if points.shape[-1] == 2:
        return [0, 1]
    known = points[np.isfinite(points).all(axis=-1)]
    return [int(np.argmax(np.ptp(known, axis=0)[:2])) if len(known) else 0, 2]


def _time_figure(episodes: Sequence[tuple[Episode, np.ndarray | None]]) -> Figure:
    """Speed of the grippers and error over time, a line for each episode."""
    stated = any(target is not None for _, target in episodes)
    colours = matplotlib.colormaps["cividis"](np.linspace(0.35, 0.9, len(episodes)))
    with matplotlib.rc_context(DIAGNOSIS_STYLE):
        figure = Figure(figsize=(10.5, 4.6 if stated else 2.6), layout="constrained")
        axes = figure.subplots(1 + stated, 1, squeeze=False, sharex=True)[:, 0]
        for colour, (episode, target) in zip(colours, episodes, strict=True):
            axes[0].step(
                episode.time[:-1], _speed(episode), where="post", color=colour, lw=1.2, label=_plain(episode.motion)
            )
            if target is not None:
                axes[-1].plot(episode.time, shape_error_cm(episode.keypoints, target), color=colour, lw=1.6)
        axes[0].set_ylabel("gripper [cm/s]")
        axes[0].set_ylim(bottom=0.0)
        if stated:
            drawn = np.concatenate([line.get_ydata() for line in axes[1].lines])
            axes[1].set(ylabel="to the target [cm]", yscale="log" if (drawn > 0).any() else "linear")
        axes[-1].set_xlabel("time [s]")
        figure.legend(loc="outside upper left", ncols=3, handlelength=1.6)
    return figure


def _plain(motion: str) -> str:
    """A motion's name for a figure, in which dollar signs enclose no formula."""
    return motion[:30].replace("$", r"\$")


def _short(value: object) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 300 else f"{text[:297]}..."
