"""Figures of a diagnosis in space: a view that can be rotated, and the remaining error by file."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from cablejax.arrays import evenly, mean_of_finite
from cablejax.diagnose.diagnosis import CableDiagnosis
from cablejax.gaplog import labels
from cablejax.report.effect_words import explained_label
from cablejax.report.style import DIAGNOSIS_STYLE, LIGHT

_FRAME = 0.04  # [s] between two pictures of the player
_SHOWN = 4
_LOST = 0.5  # [m]


def with_the_cause(diagnosis: CableDiagnosis) -> np.ndarray | None:
    """Keypoints simulated with the named effects [m], shape [E, T, N, 3]; None where none is named."""
    return diagnosis.explained if diagnosis.effects else None


def recording_ends(diagnosis: CableDiagnosis, episodes: np.ndarray) -> np.ndarray:
    """Of some episodes in order, the places of those that begin another recording than the one before."""
    names = np.array(labels(diagnosis.log, "recording", default=""))[episodes]
    return 1 + np.flatnonzero(names[1:] != names[:-1])


def files_figure(diagnosis: CableDiagnosis) -> Figure:
    """The error of every keypoint in every file, before and after."""
    parts = [("nominal simulator", diagnosis.nominal)]
    if (explained := with_the_cause(diagnosis)) is not None:
        parts.append((explained_label(diagnosis), explained))
    with matplotlib.rc_context(DIAGNOSIS_STYLE):
        figure = Figure(figsize=(11.0, 2.4 * len(parts) + 0.8), layout="constrained")
        panels = np.atleast_1d(figure.subplots(len(parts), 1, sharex=True))
        # NaN where nothing was predicted
        off = [np.abs(np.asarray(diagnosis.log.keypoints, float) - predicted) for _, predicted in parts]
        maps = [1e3 * np.sqrt(mean_of_finite(np.minimum(one, 1.0) ** 2, (1, 3))) for one in off]
        used = np.flatnonzero(np.isfinite(maps[0]).any(axis=1))
        top = float(np.nanpercentile(maps[0], 95))
        names = labels(diagnosis.log, "file", "take")
        image = None
        for ax, (label, _), error in zip(panels, parts, maps, strict=True):
            image = ax.imshow(error[used].T, aspect="auto", origin="lower", cmap="cividis", vmin=0, vmax=top)
            ax.set_title(f"Error, {label}")
            ax.set_ylabel("keypoint")
            for column in recording_ends(diagnosis, used):
                ax.axvline(column - 0.5, color="white", lw=1.5)
        every = max(1, len(used) // 20)
        panels[-1].set_xticks(range(0, len(used), every), [names[e].replace("$", r"\$") for e in used[::every]])
        panels[-1].set_xlabel("file")
        assert image is not None
        figure.colorbar(image, ax=list(panels), label="mm, root mean square", shrink=0.8)
    return figure


def cable_still(diagnosis: CableDiagnosis) -> Figure:
    """The moment of the largest gap, from the front and from the side."""
    e, t = _worst(diagnosis)
    points = {"observed": np.asarray(diagnosis.log.keypoints[e, t], float), "nominal": diagnosis.nominal[e, t]}
    if (explained := with_the_cause(diagnosis)) is not None:
        points["explained"] = explained[e, t]
    look = {
        "nominal": {"color": LIGHT.direct, "ls": "--", "label": "nominal simulator"},
        "explained": {"color": LIGHT.residual, "lw": 2.5, "label": explained_label(diagnosis)},
        "observed": {"color": LIGHT.ink, "ls": "", "marker": "o", "ms": 5, "label": "recorded"},
    }
    with matplotlib.rc_context(DIAGNOSIS_STYLE):
        figure = Figure(figsize=(11.0, 4.4), layout="constrained")
        axes = figure.subplots(1, 2, sharey=True)
        for ax, axis, name in zip(axes, (0, 1), "xy", strict=True):
            for key in ("nominal", "explained", "observed"):
                if key in points:
                    ax.plot(points[key][:, axis], points[key][:, 2], **look[key])
            ax.set_aspect("equal")
            ax.set_xlabel(f"{name} [m]")
        axes[0].set_ylabel("z [m]")
        axes[0].legend(loc="best")
    return figure


def orbit_data(diagnosis: CableDiagnosis) -> dict[str, Any]:
    """Data of the player: the files with the largest, the smallest and middling gaps, in whole millimetres."""
    log, names, explained = diagnosis.log, labels(diagnosis.log, "file", "take"), with_the_cause(diagnosis)
    size = np.asarray(diagnosis.where.per_episode_mm, float)
    used = np.flatnonzero(np.isfinite(size))
    order = used[np.argsort(-size[used])]
    chosen = order[evenly(len(order), _SHOWN)].tolist()
    interval = float(np.median(log.intervals))
    every = max(1, round(_FRAME / interval))

    def whole(points):
        rows = np.round(1e3 * np.clip(np.nan_to_num(points, nan=9.0), -9.0, 9.0)).astype(int)
        return [
            [row.tolist() if np.isfinite(p).all() else None for row, p in zip(frame, points[k], strict=True)]
            for k, frame in enumerate(rows)
        ]

    windows = []
    for e in chosen:
        # the camera may have begun later
        known = np.isfinite(log.keypoints[e]) & np.isfinite(diagnosis.nominal[e])
        first = int(known.any(axis=(1, 2)).argmax())
        count = int(min(log.episode_length[e] - first, round(5.0 / interval)))
        samples = slice(first, first + count, every)
        observed = np.asarray(log.keypoints[e, samples], float)
        entry: dict[str, Any] = {
            "name": f"{names[e]} ({size[e]:.0f} mm)",
            "observed": whole(observed),
            "nominal": whole(diagnosis.nominal[e, samples]),
            "middle": np.nanmean(observed, axis=(0, 1)).round(4).tolist(),
            "reach": float((np.nanmax(observed, axis=(0, 1)) - np.nanmin(observed, axis=(0, 1))).max()),
            "floor": round(1e3 * float(np.nanmin(observed[..., 2])) - 50),
        }
        # begins where the simulator is furthest off, but not lost: at the first sample there is nothing to see
        off = np.linalg.norm(diagnosis.nominal[e, samples] - observed, axis=-1)
        off = np.nan_to_num(off).max(axis=1)
        entry["shown"] = int(np.where(off < _LOST, off, 0.0).argmax())
        if explained is not None:
            entry["explained"] = whole(explained[e, samples])
        windows.append(entry)
    return {"interval": every * interval, "windows": windows}


def _worst(diagnosis: CableDiagnosis) -> tuple[int, int]:
    off = np.minimum(np.abs(np.asarray(diagnosis.log.keypoints, float) - diagnosis.nominal), 0.3)
    size = np.where(np.isfinite(off), off, 0.0).sum(axis=(2, 3))
    e, t = divmod(int(size.argmax()), size.shape[1])
    return e, t
