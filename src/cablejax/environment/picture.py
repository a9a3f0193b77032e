"""Pictures of an environment's cable, its grippers and its target, as Gymnasium's `render` returns them."""

from __future__ import annotations

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from cablejax.report.style import FIGURE_STYLE, LIGHT, draw_held_cable, draw_target

PIXELS = 480
"""Width and height of a picture."""
_DPI = 100
_MARGIN = 0.08
"""Space for a gripper's body beyond its pose [lengths of the cable]."""


def picture(
    keypoints: Float[np.ndarray, "N 2"],
    gripper_pose: Float[np.ndarray, "2 3"],
    target: Float[np.ndarray, "N 2"],
    length: float,
) -> UInt8[np.ndarray, "480 480 3"]:
    """Draws the table from above, the target dashed.

    Args:
        keypoints: observed [m].
        gripper_pose: (x, y, theta) [m, rad].
        target: wanted keypoints [m].
        length: of the cable [m]; the table is three lengths wide, and the origin is in the middle.
    """
    half = (1.5 + _MARGIN) * length
    with matplotlib.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(PIXELS / _DPI, PIXELS / _DPI), dpi=_DPI)
        ax = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(-half, half), ylim=(-half, half))
        ax.set_axis_off()
        draw_target(ax, target)
        draw_held_cable(ax, keypoints, gripper_pose, length, LIGHT.residual)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()
