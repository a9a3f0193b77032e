"""Colours, names and curves that all pictures of the report share.

The colours are those of Okabe and Ito, which stay apart for colour-blind readers and in grey.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

if TYPE_CHECKING:
    from cablejax.control.run import ClosedLoopRun
    from cablejax.control.shaping import Method, Runs

METHOD_ORDER: tuple[Method, ...] = ("direct", "residual")
"""Drawing order: the corrected model lies on top."""

METHOD_LABEL: dict[Method, str] = {
    "residual": "with online residual",
    "direct": "without residual",
}
"""Labels of the methods in figures."""


def by_shape(runs: Runs) -> dict[str, dict[Method, ClosedLoopRun]]:
    """The runs grouped as `{shape: {method: run}}`: shapes as they first appear, methods in drawing order.

    Raises:
        ValueError: there is no run.
    """
    if not runs:
        raise ValueError("A report needs at least one run, got none.")
    shapes = dict.fromkeys(shape for shape, _ in runs)
    return {shape: {one: runs[shape, one] for one in METHOD_ORDER if (shape, one) in runs} for shape in shapes}


@dataclasses.dataclass(frozen=True)
class Colours:
    """The colours on white, as hexadecimal strings; the pages have their own for dark screens.

    Attributes:
        ink, muted, faint: of the text, the captions and the lines.
        gripper, target, residual, direct: of the grippers, the target, and the cable by each method.
    """

    ink: str = "#1c2228"
    muted: str = "#5c6670"
    faint: str = "#d9dee3"
    gripper: str = "#3c4650"
    target: str = "#8b949d"
    residual: str = "#0072b2"
    direct: str = "#d55e00"

    def method(self, method: Method) -> str:
        """The colour of one method's lines."""
        return self.residual if method == "residual" else self.direct


LIGHT = Colours()
"""The colours of every picture."""

FIGURE_STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "axes.edgecolor": LIGHT.muted,
    "axes.labelcolor": LIGHT.ink,
    "axes.titlecolor": LIGHT.ink,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "text.color": LIGHT.ink,
    "xtick.color": LIGHT.muted,
    "ytick.color": LIGHT.muted,
    "grid.color": LIGHT.faint,
    "legend.frameon": False,
    "svg.fonttype": "none",
}
"""Settings for `matplotlib.rc_context`, of every figure."""
DIAGNOSIS_STYLE: dict[Any, Any] = FIGURE_STYLE | {"font.size": 11.0, "axes.titlesize": 11.0}
"""The same for the smaller figures of diagnoses and of what `cablejax view` shows."""


def cable_curve(
    keypoints: Float[np.ndarray, "N 2"], gripper_pose: Float[np.ndarray, "2 3"] | None = None, n_points: int = 61
) -> Float[np.ndarray, "P 2"]:
    """A smooth curve through the keypoints [m], for drawing: a cubic spline in chord length, shape [n_points, 2].

    With `gripper_pose` its end tangents are those of the grippers, as a clamped cable's are. Missing (NaN) keypoints
    are left out.
    """
    points = np.asarray(keypoints, dtype=float)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return np.full((n_points, 2), np.nan)
    distance = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    keep = np.concatenate([[True], np.diff(distance) > 1e-9])
    points, distance = points[keep], distance[keep]
    if len(points) < 2:
        return np.repeat(points, n_points, axis=0)
    ends: Any = "not-a-knot"
    if gripper_pose is not None:
        theta = np.asarray(gripper_pose)[:, 2]
        tangent = np.stack([np.cos(theta), np.sin(theta)], axis=1)
        ends = ((1, tangent[0]), (1, tangent[1]))
    return CubicSpline(distance, points, bc_type=ends)(np.linspace(0.0, distance[-1], n_points))


def drawn_size(length: float) -> float:
    """A cable's length [m] to two digits: what grippers, margins and scale bars go by."""
    return float(f"{length:.2g}")


def size_of(runs: Runs) -> float:
    """`drawn_size` of the longest cable of the runs [m]."""
    return drawn_size(max(run.target.length for run in runs.values()))


def common_window(
    runs: Runs, margin: float = 0.12, *, final_only: bool = False
) -> dict[str, tuple[float, float, float, float]]:
    """For each shape a view (x0, x1, y0, y1) [m] of the table that holds all its runs; every view has the same size.

    Args:
        runs: the runs.
        margin: free space around the cable, where the grippers' bodies are drawn [lengths of the cable].
        final_only: whether only the last sample has to be in view.
    """
    boxes: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for (shape, _), run in runs.items():
        drawn = run.keypoints[-1:] if final_only else run.keypoints
        points = np.concatenate([drawn.reshape(-1, 2), run.target.keypoints])
        low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
        if shape in boxes:
            low, high = np.minimum(low, boxes[shape][0]), np.maximum(high, boxes[shape][1])
        boxes[shape] = low, high
    width, height = np.max([high - low for low, high in boxes.values()], axis=0) + 2 * margin * size_of(runs)
    half = 0.5 * np.array([width, height])
    views = {}
    for shape, (low, high) in boxes.items():
        centre = 0.5 * (low + high)
        (x0, y0), (x1, y1) = centre - half, centre + half
        views[shape] = float(x0), float(x1), float(y0), float(y1)
    return views


def gripper_outline(pose: Float[np.ndarray, "3"], end: int, length: float) -> list[Float[np.ndarray, "K 2"]]:
    """Polygons [m] of a parallel-jaw gripper seen from above: two jaws along the cable, a palm and a wrist behind them.

    Args:
        pose: (x, y, theta), theta the direction of the cable's tangent.
        end: 0 where the cable leaves the gripper along theta, 1 where it comes in along theta.
        length: of the cable [m]; a gripper is drawn about a tenth as long.
    """
    x, y, theta = np.asarray(pose, dtype=float)
    back = -1.0 if end == 0 else 1.0
    rotation = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])

    def box(along: tuple[float, float], across: tuple[float, float]) -> np.ndarray:
        corners = [(along[0], across[0]), (along[1], across[0]), (along[1], across[1]), (along[0], across[1])]
        local = np.array([(back * a, c) for a, c in corners])
        return length * local @ rotation.T + [x, y]

    return [
        box((-0.022, 0.030), (0.008, 0.020)),
        box((-0.022, 0.030), (-0.020, -0.008)),
        box((0.030, 0.048), (-0.032, 0.032)),
        box((0.048, 0.078), (-0.014, 0.014)),
    ]


def draw_grippers(ax: Any, pose: Float[np.ndarray, "2 3"], length: float, **look: Any) -> list[Any]:
    """Draws both grippers of a cable of this length at their poses [m, rad] and returns the patches."""
    outlines = [polygon for end in range(2) for polygon in gripper_outline(pose[end], end, length)]
    return [patch for polygon in outlines for patch in ax.fill(*polygon.T, lw=0, **{"color": LIGHT.gripper, **look})]


def draw_target(ax: Any, keypoints: Float[np.ndarray, "N 2"], n_points: int = 61) -> None:
    """A target [m], dashed."""
    ax.plot(*cable_curve(keypoints, n_points=n_points).T, color=LIGHT.target, lw=2.2, ls=(0, (2.4, 1.7)))


def draw_held_cable(
    ax: Any,
    keypoints: Float[np.ndarray, "N 2"],
    pose: Float[np.ndarray, "2 3"],
    length: float,
    colour: str,
    gripper: str = LIGHT.gripper,
) -> list[Any]:
    """Both grippers and the cable between them [m], with its keypoints; returns the artists."""
    artists = draw_grippers(ax, pose, length, color=gripper)
    artists += ax.plot(*cable_curve(keypoints, pose).T, color=colour, lw=2.2, solid_capstyle="round")
    return artists + ax.plot(*keypoints.T, color=colour, ls="", marker="o", ms=3.4)


def bar_of(length: float) -> tuple[float, str]:
    """Length [m] and label of a scale bar: of 1, 2 and 5 times powers of ten, the one that is nearest to `length`."""
    bars = (digit * 10.0**power for power in range(-6, 4) for digit in (1, 2, 5))
    bar = min(bars, key=lambda bar: abs(np.log(bar / length)))
    factor, unit = (1.0, "m") if bar >= 1.0 else (100.0, "cm") if bar >= 0.01 else (1000.0, "mm")
    return bar, f"{factor * bar:g} {unit}"


def draw_scale_bar(ax: Any, about: float) -> None:
    """A bar of about this length [m] in the lower right corner of axes whose limits are set."""
    bar, label = bar_of(about)
    x, y = ax.get_xlim()[1] - 0.1 * about, ax.get_ylim()[0] + 0.1 * about
    ax.plot([x - bar, x], [y, y], color=LIGHT.muted, lw=1.5, solid_capstyle="butt")
    ax.text(x - bar / 2, y + 0.06 * about, label, ha="center", va="bottom", color=LIGHT.muted, fontsize=9)


def draw_bars(
    ax: Any, names: Sequence[str], values: Sequence[float], words: Sequence[str], colours: Any, longest: float
) -> None:
    """Horizontal bars with a name on the left and words at the end of each, the first one on top.

    Args:
        ax: empty axes.
        names: of the bars.
        values: their lengths; one that is negative or NaN has no bar.
        words: at their ends.
        colours: one, or one for each.
        longest: the value at which a bar reaches almost across the axes.
    """
    lengths = np.fmax(values, 0.0)
    ax.barh(range(len(names)), lengths, color=colours, height=0.62)
    for row, (length, word) in enumerate(zip(lengths, words, strict=True)):
        ax.text(length + 0.015 * longest, row, word, va="center", fontsize=10)
    # few bars are not blown up
    ax.set(xlim=(0, 1.12 * longest), ylim=(max(len(names), 3) - 0.4, -0.6), xticks=[])
    ax.set_yticks(range(len(names)), names)
    ax.spines[["bottom"]].set_visible(False)
    ax.tick_params(length=0, labelcolor=LIGHT.ink)
