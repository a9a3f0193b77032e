"""The animation as a GIF: every shape side by side, with and without the residual overlaid, drawn with Pillow.

Frames are drawn at several times their size and scaled down, which gives smooth lines without a plotting library, and
share one palette, which keeps the file small.
"""

from __future__ import annotations

import os
import pathlib
from collections.abc import Sequence
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from PIL import Image, ImageColor, ImageDraw, ImageFont

from cablejax.report.style import (
    LIGHT,
    METHOD_LABEL,
    METHOD_ORDER,
    by_shape,
    cable_curve,
    common_window,
    gripper_outline,
)

if TYPE_CHECKING:
    from cablejax.control.run import ClosedLoopRun
    from cablejax.control.shaping import Method, Runs

OVERSAMPLING = 3
"""Pixels drawn for each one of the picture."""
_SPEED = 5.0
"""Seconds of the run per second of the animation."""
_HOLD_S = 2.5
"""How long the last frame stands [s]."""
_SHADES = 7
_DASH, _GAP = 7.0, 5.0
_HEADER = 44
_TITLE = 34
_FOOTER = 48


def write_gif(path: str | os.PathLike[str], runs: Runs, *, width: int = 960, frames_per_second: float = 12.0) -> int:
    """Writes the animation and returns its size in bytes.

    Args:
        path: the file to write.
        runs: the runs; those of one shape share a panel.
        width: of the picture [pixels].
        frames_per_second: of the file.

    Raises:
        ValueError: if there is no run.
    """
    pairs = by_shape(runs)
    end = max(float(r.times[-1]) for r in runs.values())
    # The cable moves most at the start, so time runs slower there: frame times grow with the square.
    n_frames = max(2, round(end / _SPEED * frames_per_second))
    instants = end * np.linspace(0.0, 1.0, n_frames) ** 2
    scene = _Scene(pairs, common_window(runs, margin=0.1), width)
    frames = [scene.draw(t) for t in instants]
    drawn = (LIGHT.ink, LIGHT.muted, LIGHT.gripper, LIGHT.target, LIGHT.residual, LIGHT.direct)
    return save_frames(path, frames, drawn, frames_per_second=frames_per_second, hold_s=_HOLD_S)


def save_frames(
    path: str | os.PathLike[str],
    frames: list[Image.Image],
    drawn: Sequence[str],
    *,
    frames_per_second: float,
    hold_s: float,
) -> int:
    """Writes pictures as a GIF and returns its size in bytes.

    Args:
        path: the file to write.
        frames: in order.
        drawn: their colours.
        frames_per_second: of the file.
        hold_s: how long the last frame stands [s].
    """
    palette = _palette(drawn)
    indexed = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = [round(1000.0 / frames_per_second)] * (len(frames) - 1) + [round(1000.0 * hold_s)]
    path = pathlib.Path(path)
    indexed[0].save(
        path, format="GIF", save_all=True, append_images=indexed[1:], duration=durations, loop=0, optimize=False
    )
    return path.stat().st_size


def _palette(drawn: Sequence[str]) -> Image.Image:
    """Every colour drawn, in steps towards the background as its smoothed edges have them."""
    background = np.array(ImageColor.getrgb(LIGHT.background))
    colours = [background]
    for colour in drawn:
        for share in np.linspace(1.0 / _SHADES, 1.0, _SHADES):
            colours.append((1.0 - share) * background + share * np.array(ImageColor.getrgb(colour)))
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.round(np.array(colours)).astype(np.uint8).ravel().tolist())
    return palette


class _Scene:
    """The constant part of all frames: the layout, the targets, the words."""

    def __init__(self, pairs: dict[str, dict[Method, ClosedLoopRun]], views: dict, width: int):
        self.pairs = pairs
        self.views = views
        x0, x1, y0, y1 = next(iter(views.values()))
        self.panel_width = width // len(pairs)
        self.pixels_per_metre = self.panel_width / (x1 - x0)
        self.panel_height = round((y1 - y0) * self.pixels_per_metre)
        self.size = (self.panel_width * len(pairs), _HEADER + _TITLE + self.panel_height + _FOOTER)
        self.background = self._static()

    def draw(self, time: float) -> Image.Image:
        """The frame at one instant [s]; between samples the cable is interpolated."""
        image = self.background.copy()
        canvas = Canvas(image)
        canvas.text((self.size[0] - 16, 12), f"{time:.0f} s", LIGHT.ink, 18, anchor="ra", bold=True)
        for index, (shape, runs) in enumerate(self.pairs.items()):
            row = 0
            for method in METHOD_ORDER:
                if method not in runs:
                    continue
                run = runs[method]
                strong = method == "residual" or len(runs) == 1
                pose = _at(run.times, run.gripper_pose, time)
                keypoints = _at(run.times, run.keypoints, time)
                for end in range(2):
                    for polygon in gripper_outline(pose[end], end):
                        canvas.polygon(self._pixels(index, shape, polygon), LIGHT.gripper if strong else "#c3c9cf")
                canvas.line(self._pixels(index, shape, cable_curve(keypoints, pose)), LIGHT.method(method), 3.0)
                canvas.dots(self._pixels(index, shape, keypoints), LIGHT.method(method), 2.4)
            for method in METHOD_ORDER[::-1]:
                if method in runs:
                    error = float(_at(runs[method].times, runs[method].error_cm, time))
                    x, y = index * self.panel_width + 62, _HEADER + _TITLE + self.panel_height + 20 * row
                    canvas.text((x, y), f"{error:.2f}", LIGHT.method(method), 14, anchor="ra", bold=True)
                    canvas.text((x + 6, y), f"cm {METHOD_LABEL[method]}", LIGHT.method(method), 14)
                    row += 1
        return image.resize(self.size, Image.Resampling.BOX)

    def _static(self) -> Image.Image:
        image = Image.new("RGB", (OVERSAMPLING * self.size[0], OVERSAMPLING * self.size[1]), LIGHT.background)
        canvas = Canvas(image)
        canvas.text((16, 12), "Two grippers shape a cable", LIGHT.ink, 18, bold=True)
        canvas.dashes(np.array([(318.0, 24.0), (352.0, 24.0)]), LIGHT.target, 3.0)
        canvas.text((360, 15), "target", LIGHT.muted, 14)
        for index, (shape, runs) in enumerate(self.pairs.items()):
            canvas.text((index * self.panel_width + 16, _HEADER), shape, LIGHT.ink, 20, bold=True)
            target = next(iter(runs.values())).target.keypoints
            canvas.dashes(self._pixels(index, shape, cable_curve(target, n_points=400)), LIGHT.target, 3.0)
        right, bottom = self.size[0] - 16, _HEADER + _TITLE + self.panel_height - 6
        bar = 0.2 * self.pixels_per_metre
        canvas.line(np.array([(right - bar, bottom), (right, bottom)]), LIGHT.muted, 2.0)
        canvas.text((right - bar / 2, bottom - 4), "20 cm", LIGHT.muted, 12, anchor="ms")
        return image

    def _pixels(self, index: int, shape: str, points: np.ndarray) -> np.ndarray:
        x0, _, _, y1 = self.views[shape]
        x = index * self.panel_width + (points[:, 0] - x0) * self.pixels_per_metre
        y = _HEADER + _TITLE + (y1 - points[:, 1]) * self.pixels_per_metre
        return np.stack([x, y], axis=1)


class Canvas:
    """Drawing in final pixels on an oversampled image."""

    def __init__(self, image: Image.Image):
        self.pen = ImageDraw.Draw(image)

    def line(self, points: np.ndarray, colour: str, width: float) -> None:
        """A line [pixels]."""
        scaled = [tuple(p) for p in points * OVERSAMPLING]
        self.pen.line(scaled, fill=colour, width=round(width * OVERSAMPLING), joint="curve")
        self.dots(points[[0, -1]], colour, width / 2)

    def dots(self, points: np.ndarray, colour: str, radius: float) -> None:
        """Dots of a radius [pixels], where points are finite."""
        for x, y in points[np.isfinite(points).all(axis=1)] * OVERSAMPLING:
            r = radius * OVERSAMPLING
            self.pen.ellipse((x - r, y - r, x + r, y + r), fill=colour)

    def polygon(self, points: np.ndarray, colour: str) -> None:
        """A filled polygon [pixels]."""
        self.pen.polygon([tuple(p) for p in points * OVERSAMPLING], fill=colour)

    def dashes(self, points: np.ndarray, colour: str, width: float) -> None:
        """A dashed line [pixels]."""
        distance = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
        for start in np.arange(0.0, distance[-1], _DASH + _GAP):
            along = np.linspace(start, min(start + _DASH, distance[-1]), 6)
            piece = np.stack([np.interp(along, distance, points[:, k]) for k in range(2)], axis=1)
            scaled = [tuple(p) for p in piece * OVERSAMPLING]
            self.pen.line(scaled, fill=colour, width=round(width * OVERSAMPLING), joint="curve")

    def text(self, place, words: str, colour: str, size: float, *, anchor: str = "la", bold: bool = False) -> None:
        """Words at a place [pixels]."""
        name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
        file = pathlib.Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name
        font = ImageFont.truetype(str(file), round(size * OVERSAMPLING))
        x, y = place
        self.pen.text((x * OVERSAMPLING, y * OVERSAMPLING), words, fill=colour, font=font, anchor=anchor)


def _at(times: np.ndarray, values: np.ndarray, time: float) -> np.ndarray:
    """`values` at one instant, linear between samples and constant past the last."""
    position = float(np.interp(time, times, np.arange(len(times))))
    low = min(int(position), len(times) - 1)
    high = min(low + 1, len(times) - 1)
    part = position - low
    return (1.0 - part) * np.asarray(values[low]) + part * np.asarray(values[high])
