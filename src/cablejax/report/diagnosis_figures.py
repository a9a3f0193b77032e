"""Pictures of the gap: the moment at which it is largest, and where it lies along the cable and in time.

Each takes a `CableDiagnosis` and gives a `matplotlib.figure.Figure` that belongs to nobody else.
"""

from __future__ import annotations

from collections.abc import Iterator

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from scipy.signal import convolve

from cablejax.arrays import stretches
from cablejax.diagnose.diagnosis import CableDiagnosis, NamedEffect
from cablejax.diagnose.judgement import effect_title
from cablejax.report.effect_words import explained_label, millimetres, short
from cablejax.report.style import DIAGNOSIS_STYLE, LIGHT, cable_curve, draw_grippers, draw_scale_bar

# Transparent where there is no gap, so that it reads on a light and on a dark page.
_HEAT = LinearSegmentedColormap.from_list(
    "gap", [(0.0, "#d55e0000"), (0.15, "#d55e0018"), (0.6, "#d55e00d0"), (1.0, "#8c1d00ff")]
)
_MAX_EPISODES = 12
# Deviations of more than about a tenth of the picture show without being enlarged.
_LARGEST_ZOOM = 0.12
_SMOOTHING_S = 1.0
# Half of the shortest section that is drawn [lengths of the cable].
_MARK = 0.01


def worst_moment(diagnosis: CableDiagnosis) -> tuple[int, int]:
    """Episode and sample at which the observed cable is furthest from the nominal one, over half a second."""
    seen = np.isfinite(diagnosis.where.heat)
    squared = np.where(seen, diagnosis.where.heat**2, 0.0).sum(axis=-1) / np.maximum(seen.sum(axis=-1), 1)
    kernels = [_mean_over(diagnosis, episode, 0.5) for episode in range(len(squared))]
    smooth = np.stack([np.convolve(row, kernel, "same") for row, kernel in zip(squared, kernels, strict=True)])
    # one that shows the whole cable, if there is any
    whole = seen.sum(axis=-1) >= seen.sum(axis=-1).max()
    episode, sample = np.unravel_index(np.argmax(np.where(whole, smooth, -1.0)), smooth.shape)
    return int(episode), int(sample)


def cable_figure(diagnosis: CableDiagnosis) -> Figure:
    """The worst moment: observed, nominal and explained cable, where the named effects sit, and an enlarged part."""
    episode, sample = worst_moment(diagnosis)
    log = diagnosis.log
    pose, observed = log.gripper_pose[episode, sample], log.keypoints[episode, sample]
    nominal = diagnosis.nominal[episode, sample]
    explained = None if diagnosis.explained is None else diagnosis.explained[episode, sample]
    drawn = [p for p in (observed, nominal, explained) if p is not None]
    arclength = np.asarray(log.meta["keypoint_arclength_m"])
    length = float(arclength[-1] - arclength[0])
    every, margin = np.concatenate(drawn), 0.09 * length
    low, high = np.nanmin(every, axis=0) - margin, np.nanmax(every, axis=0) + margin
    width, height = high - low
    distance = np.where(np.isfinite(observed), observed - nominal, 0.0)
    furthest = int(np.argmax(np.linalg.norm(distance, axis=-1)))
    reach = max(3.5 * float(np.linalg.norm(distance[furthest])), 0.02 * width)
    enlarged = reach < _LARGEST_ZOOM * width
    middle = nominal[furthest]
    with matplotlib.rc_context(DIAGNOSIS_STYLE):
        figure = Figure(
            figsize=(10.0, 0.9 + (7.2 if enlarged else 9.6) * min(max(height / width, 0.3), 0.6)), layout="constrained"
        )
        figure.suptitle(f"Episode {episode}, {log.time[episode, sample]:.1f} s", x=0.0, ha="left", fontsize=11)
        if enlarged:
            ax, zoom = figure.subplots(1, 2, width_ratios=[7.4, 2.6])
            views = [(ax, 1.0), (zoom, 1.6)]
            zoom.set(xlim=(middle[0] - reach, middle[0] + reach), ylim=(middle[1] - reach, middle[1] + reach))
        else:
            ax, zoom = figure.subplots(), None
            views = [(ax, 1.2)]
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        for axes, thick in views:
            axes.set(aspect="equal", xticks=[], yticks=[])
            axes.spines[:].set_visible(axes is zoom)
            _draw_places(axes, diagnosis, nominal if explained is None else explained)
            draw_grippers(axes, pose, length, alpha=0.8)
            if explained is not None:
                label = explained_label(diagnosis)
                axes.plot(*cable_curve(explained).T, color=LIGHT.residual, lw=3.2 * thick, label=label)
            believed, dashes = "nominal simulator", (0, (4, 2))
            axes.plot(*cable_curve(nominal).T, color=LIGHT.direct, lw=2.0 * thick, ls=dashes, label=believed)
            axes.plot(*observed.T, "o", color=LIGHT.ink, ms=4.5 * thick, label="observed keypoints")
        draw_scale_bar(ax, 0.1 * length)
        if zoom is not None:
            zoom.set_title("enlarged", fontsize=10)
            ax.add_patch(Rectangle(tuple(middle - reach), 2 * reach, 2 * reach, fill=False, ec=LIGHT.muted, lw=1))
            draw_scale_bar(zoom, 0.5 * reach)
        handles, labels = ax.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower left", ncols=len(labels))
    return figure


def where_figure(diagnosis: CableDiagnosis) -> Figure:
    """The gap along the cable, and along the cable over time in every episode, in units of the noise."""
    where, log = diagnosis.where, diagnosis.log
    arclength = np.asarray(log.meta["keypoint_arclength_m"])
    episodes = np.arange(len(where.per_episode_mm))
    if len(episodes) > _MAX_EPISODES:
        episodes = np.sort(np.argsort(-where.per_episode_mm)[:_MAX_EPISODES])
    columns = min(3, len(episodes))
    rows = -(-len(episodes) // columns)
    smooth, rows_at = [_smoothed(diagnosis, int(e)) for e in episodes], _edges(arclength)
    top = max(4.0, float(np.nanpercentile(np.concatenate([s.ravel() for s in smooth]), 99)))
    with matplotlib.rc_context(DIAGNOSIS_STYLE):
        figure = Figure(figsize=(10.0, 1.5 + 1.55 * rows), layout="constrained")
        grid = figure.add_gridspec(1 + rows, columns, height_ratios=[0.8, *[1.25] * rows])
        _strip(figure.add_subplot(grid[0, :]), diagnosis, arclength)
        image, panels = None, []
        for index, (e, values) in enumerate(zip(episodes, smooth, strict=True)):
            ax = figure.add_subplot(grid[1 + index // columns, index % columns])
            panels.append(ax)
            time = _edges(log.time[e, : log.episode_length[e]].astype(float))
            image = ax.pcolormesh(time, rows_at, values.T, cmap=_HEAT, vmin=0.0, vmax=top, rasterized=True)
            _mark_holds(ax, diagnosis, int(e), rows_at[-1])
            size = where.per_episode_mm[e]
            ax.set_title(f"Episode {e}: {millimetres(size) if np.isfinite(size) else 'not observed'}", fontsize=10)
            ax.tick_params(labelleft=index % columns == 0)
            if index % columns == 0:
                ax.set_ylabel("along\ncable [m]", fontsize=9)
            if index + columns >= len(episodes):
                ax.set_xlabel("time [s]", fontsize=9)
        if image is not None:
            colours = figure.colorbar(image, ax=panels, shrink=0.8, pad=0.01)
            colours.set_label("gap / noise", fontsize=9)
    return figure


def _edges(places: np.ndarray) -> np.ndarray:
    """Edges of cells about places that increase, halfway between them."""
    between = 0.5 * (places[1:] + places[:-1])
    first, last = (0.5 * np.diff(places)[[0, -1]]) if len(places) > 1 else (0.5, 0.5)
    return np.concatenate([[places[0] - first], between, [places[-1] + last]])


def _mean_over(diagnosis: CableDiagnosis, episode: int, seconds: float) -> np.ndarray:
    """Equal weights of the samples in so many seconds of an episode, at most all of it, for a moving mean."""
    samples = int(diagnosis.log.episode_length[episode])
    steps = np.diff(diagnosis.log.time[episode, :samples])
    width = max(1, round(seconds / float(np.median(steps)))) if len(steps) else 1
    return np.full(min(width, samples), 1.0 / min(width, samples))


def _smoothed(diagnosis: CableDiagnosis, episode: int) -> np.ndarray:
    """Gap in noise units over about one second, noise taken out, shape [T, N]; NaN where nothing was observed."""
    length = int(diagnosis.log.episode_length[episode])
    squared = diagnosis.where.heat[episode, :length] ** 2
    seen = np.isfinite(squared)
    kernel = _mean_over(diagnosis, episode, _SMOOTHING_S)[:, None]
    sums, counts = (convolve(part, kernel, "same", "direct") for part in (np.where(seen, squared, 0.0), seen))
    with np.errstate(invalid="ignore"):
        return np.sqrt(np.maximum(sums / np.where(counts > 0, counts, np.nan) - 1.0, 0.0))


def _strip(ax: Axes, diagnosis: CableDiagnosis, arclength: np.ndarray) -> None:
    """The cable laid straight, coloured by the gap, with its numbers and the places of the named effects."""
    profile = diagnosis.where.along_cable_mm
    along = np.linspace(arclength[0], arclength[-1], 400)
    seen = np.isfinite(profile)
    smooth = np.interp(along, arclength[seen], profile[seen])
    top = max(float(profile[seen].max()), float(diagnosis.noise_mm.mean()))
    ax.imshow(
        smooth[None], cmap=_HEAT, vmin=0.0, vmax=top, aspect="auto", extent=(arclength[0], arclength[-1], 0.0, 1.0)
    )
    ax.add_patch(Rectangle((arclength[0], 0), arclength[-1] - arclength[0], 1, fill=False, ec=LIGHT.muted, lw=1))
    for s, value in zip(arclength[seen], profile[seen], strict=True):
        ax.text(s, 1.12, short(value), ha="center", va="bottom", fontsize=9, color=LIGHT.muted)
    for effect in diagnosis.effects:
        for low, high in _sections(effect, arclength):
            ax.plot([low, high], [-0.22, -0.22], color=LIGHT.residual, lw=5, solid_capstyle="butt", clip_on=False)
            ax.text(
                0.5 * (low + high),
                -0.4,
                effect_title(effect.name),
                ha="center",
                va="top",
                fontsize=9,
                color=LIGHT.residual,
            )
    half = 0.5 * float(np.median(np.diff(arclength)))
    ax.set(xlim=(arclength[0] - half, arclength[-1] + half), ylim=(-1.0, 1.9), yticks=[], xticks=[])
    ax.set_xticks([])
    ax.spines[:].set_visible(False)
    ax.set_title("Gap above the noise along the cable [mm], gripper 0 on the left")


def _mark_holds(ax: Axes, diagnosis: CableDiagnosis, episode: int, top: float) -> None:
    """Bars over the time in which the grippers rest and the cable has settled."""
    length = int(diagnosis.log.episode_length[episode])
    masks = diagnosis.where.regime_masks
    rests = [masks[name] for name in ("start: at rest", "speed: hold") if name in masks]
    if not rests:
        return
    time = diagnosis.log.time[episode]
    for begin, end in stretches(np.any(rests, axis=0)[episode, :length]):
        ax.plot([time[begin], time[end - 1]], [top, top], color=LIGHT.ink, lw=3, solid_capstyle="butt", clip_on=False)


def _draw_places(ax: Axes, diagnosis: CableDiagnosis, cable: np.ndarray) -> None:
    """Broad bands and rings where the named effects sit."""
    arclength = np.asarray(diagnosis.log.meta["keypoint_arclength_m"])
    curve = cable_curve(cable, n_points=401)
    s = np.linspace(arclength[0], arclength[-1], 401)
    for effect in diagnosis.effects:
        table = effect.location.get("table_m")
        for low, high in _sections(effect, arclength):
            part = curve[(s >= low) & (s <= high)]
            ax.plot(*part.T, color=LIGHT.residual, alpha=0.22, lw=17, solid_capstyle="butt")
        if table is not None:
            radius = effect.parameters.get("radius_m")
            size = 0.02 * (arclength[-1] - arclength[0]) if radius is None else float(radius.value)
            ax.add_patch(Circle(tuple(table), size, fc=LIGHT.residual, ec=LIGHT.residual, alpha=0.3, lw=1.5))


def _sections(effect: NamedEffect, arclength: np.ndarray) -> Iterator[tuple[float, float]]:
    """Begin and end [m] of each place of an effect along the cable, wide enough to be seen on it.

    An effect that names several keypoints has a place at each.
    """
    index, along = effect.parameters.get("index"), effect.location.get("along_cable_m")
    places = [] if along is None else [along]
    if index is not None:
        places = [(arclength[i], arclength[i]) for i in np.atleast_1d(index.value)]
    for low, high in places:
        half = max(0.5 * (high - low), _MARK * (arclength[-1] - arclength[0]))
        yield float(0.5 * (low + high) - half), float(0.5 * (low + high) + half)
