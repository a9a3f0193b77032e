"""Runs that failed, as pictures: one small panel each, with the start, the end, the target and the error in words."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cablejax.report.style import LIGHT, cable_curve
from closed_loop.trials import TrialKey
from rows import append_row, read_rows

if TYPE_CHECKING:
    from cablejax.control.run import ClosedLoopRun

_PANEL = 2.1
"""Inches, width and height of the drawn part of a panel."""


@dataclasses.dataclass(frozen=True)
class Snapshot:
    """A run as one picture.

    Attributes:
        key: the trial's `Trial.key`.
        start: keypoints before the first command [m], shape [N, 2].
        final: keypoints at the end [m], NaN where not observed, shape [N, 2].
        target: keypoints asked for [m], shape [N, 2].
        error_cm: root mean square distance at the end [cm]; NaN where the cable was lost.
        stopped: why the run ended early, or None.
    """

    key: TrialKey
    start: Float[np.ndarray, "N 2"]
    final: Float[np.ndarray, "N 2"]
    target: Float[np.ndarray, "N 2"]
    error_cm: float
    stopped: str | None = None

    @property
    def title(self) -> str:
        """Which trial it is."""
        _, method, scenario, stiffness, seed = self.key
        return f"{method}, {scenario}\nstiffness {stiffness:g}, seed {seed}"


def snapshot_of(run: ClosedLoopRun, key: TrialKey) -> Snapshot:
    """The picture of a finished run."""
    return Snapshot(
        key=key,
        start=run.keypoints[0],
        final=run.keypoints[-1],
        target=run.target.keypoints,
        error_cm=run.terminal_error_cm,
        stopped=run.stopped,
    )


def append_snapshot(path: str | os.PathLike[str], snapshot: Snapshot) -> None:
    """Adds a snapshot to a file of rows, see `rows.append_row`."""
    fields = dataclasses.asdict(snapshot)
    append_row(path, {k: np.round(v, 6).tolist() if isinstance(v, np.ndarray) else v for k, v in fields.items()})


def read_snapshots(path: str | os.PathLike[str]) -> list[Snapshot]:
    """The snapshots in a file; of two with the same key the later one counts.

    Raises:
        ValueError: a line is not a snapshot.
    """
    snapshots: dict[TrialKey, Snapshot] = {}
    for number, fields in enumerate(read_rows(path), start=1):
        try:
            table, method, scenario, stiffness, seed = fields.pop("key")
            shapes = {name: np.asarray(fields.pop(name), float) for name in ("start", "final", "target")}
            snapshot = Snapshot(
                key=(table, method, scenario, float(stiffness), int(seed)),
                error_cm=float(fields.pop("error_cm")),
                stopped=fields.pop("stopped"),
                **shapes,
            )
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{os.fspath(path)}, line {number} is not a snapshot: {error!r}.") from error
        snapshots[snapshot.key] = snapshot
    return list(snapshots.values())


def worst(snapshots: Sequence[Snapshot], count: int, above_cm: float = 0.0) -> list[Snapshot]:
    """The `count` runs with the largest error above a bound [cm], lost cables first."""
    failed = [s for s in snapshots if not s.error_cm <= above_cm]
    return sorted(failed, key=lambda s: -s.error_cm if np.isfinite(s.error_cm) else -np.inf)[:count]


def failure_figure(snapshots: Sequence[Snapshot], columns: int = 5) -> Figure:
    """Start, end and target of each run in a panel of its own, all at one scale.

    Raises:
        ValueError: there is no run to show.
    """
    if not snapshots:
        raise ValueError("There is no run to show; a figure of failures needs at least one.")
    columns = min(columns, len(snapshots))
    rows = -(-len(snapshots) // columns)
    style: dict[Any, Any] = {"font.size": 8.0, "text.color": LIGHT.ink, "svg.fonttype": "none"}
    boxes = [_box(snapshot) for snapshot in snapshots]
    half = 0.5 * max(float((high - low).max()) for low, high in boxes) + 0.03
    with matplotlib.rc_context(style):
        figure = Figure(figsize=(_PANEL * columns, (_PANEL + 0.65) * rows + 0.35), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False)
        for ax in axes.flat:
            ax.axis("off")
        for ax, snapshot, (low, high) in zip(axes.flat, snapshots, boxes, strict=False):
            centre = 0.5 * (low + high)
            ax.set(xlim=centre[0] + np.array([-half, half]), ylim=centre[1] + np.array([-half, half]), aspect="equal")
            ax.plot(*cable_curve(snapshot.start).T, color=LIGHT.faint, lw=1.6)
            ax.plot(*cable_curve(snapshot.target).T, color=LIGHT.target, lw=5, alpha=0.45, solid_capstyle="round")
            if np.isfinite(snapshot.final).any():
                ax.plot(*cable_curve(snapshot.final).T, color=LIGHT.direct, lw=1.8)
                ax.plot(*snapshot.final.T, "o", color=LIGHT.direct, ms=2.2)
            ax.set_title(snapshot.title, fontsize=7.5, loc="left")
            ax.text(0.0, 0.0, _words(snapshot), transform=ax.transAxes, va="bottom", fontsize=8, fontweight="bold")
        handles = [
            Line2D([], [], color=LIGHT.faint, lw=1.6, label="start"),
            Line2D([], [], color=LIGHT.target, lw=5, alpha=0.45, label="target"),
            Line2D([], [], color=LIGHT.direct, lw=1.8, label="end"),
        ]
        figure.legend(handles=handles, loc="outside upper left", ncols=3, frameon=False)
    return figure


def _box(snapshot: Snapshot) -> tuple[np.ndarray, np.ndarray]:
    points = np.concatenate([snapshot.start, snapshot.final, snapshot.target])
    return np.nanmin(points, axis=0), np.nanmax(points, axis=0)


def _words(snapshot: Snapshot) -> str:
    error = f"{snapshot.error_cm:.2f} cm" if np.isfinite(snapshot.error_cm) else "lost"
    return f"{error}, stopped early" if snapshot.stopped else error
