"""Figures of a diagnosis: the worst moment, where the gap lies, what causes it, how far it shrinks, what to do next.

Each takes a `Diagnosis` and gives a `matplotlib.figure.Figure` that belongs to nobody else.
"""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from cablejax.diagnose.diagnosis import Diagnosis, NamedEffect
from cablejax.diagnose.safe_motions import INTERVAL, safe_motions
from cablejax.report.effect_words import effect_title
from cablejax.report.style import LIGHT, cable_curve, gripper_outline
from cablejax.simulate.config import CableConfig
from cablejax.simulate.equilibrium import arch_angles, chain_nodes, find_equilibrium
from cablejax.simulate.replay import config_of_log

_STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 11.0,
    "axes.edgecolor": LIGHT.muted,
    "axes.labelcolor": LIGHT.ink,
    "axes.titlelocation": "left",
    "axes.titlesize": 11.0,
    "axes.titlecolor": LIGHT.ink,
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
# Transparent where there is no gap, so that it reads on a light and on a dark page.
_HEAT = LinearSegmentedColormap.from_list(
    "gap", [(0.0, "#d55e0000"), (0.15, "#d55e0018"), (0.6, "#d55e00d0"), (1.0, "#8c1d00ff")]
)
_MAX_EPISODES = 12
_MAX_RANKED = 8
_MAX_FRAMES = 5
# Deviations of more than about a tenth of the picture show without being enlarged.
_LARGEST_ZOOM = 0.12
_SMOOTHING_S = 1.0
_SPLIT = (
    ("noise", "noise of the recording", LIGHT.faint),
    ("named", "named effects", LIGHT.residual),
    ("learnable", "learnable, unnamed", "#56b4e9"),
    ("unexplained", "unexplained", LIGHT.direct),
)


def worst_moment(diagnosis: Diagnosis) -> tuple[int, int]:
    """Episode and sample at which the observed cable is furthest from the nominal one, over half a second."""
    seen = np.isfinite(diagnosis.where.heat)
    squared = np.where(seen, diagnosis.where.heat**2, 0.0).sum(axis=-1) / np.maximum(seen.sum(axis=-1), 1)
    width = max(1, round(0.5 / _interval(diagnosis)))
    smooth = np.stack([np.convolve(row, np.ones(width) / width, mode="same") for row in squared])
    # one that shows the whole cable, if there is any
    whole = seen.sum(axis=-1) >= seen.sum(axis=-1).max()
    episode, sample = np.unravel_index(np.argmax(np.where(whole, smooth, -1.0)), smooth.shape)
    return int(episode), int(sample)


def cable_figure(diagnosis: Diagnosis) -> Figure:
    """The worst moment: observed, nominal and explained cable, where the named effects sit, and an enlarged part."""
    episode, sample = worst_moment(diagnosis)
    log = diagnosis.log
    pose, observed = log.gripper_pose[episode, sample], log.keypoints[episode, sample]
    nominal = diagnosis.nominal[episode, sample]
    explained = None if diagnosis.explained is None else diagnosis.explained[episode, sample]
    drawn = [p for p in (observed, nominal, explained) if p is not None]
    low, high = np.nanmin(np.concatenate(drawn), axis=0) - 0.09, np.nanmax(np.concatenate(drawn), axis=0) + 0.09
    width, height = high - low
    distance = np.where(np.isfinite(observed), observed - nominal, 0.0)
    furthest = int(np.argmax(np.linalg.norm(distance, axis=-1)))
    reach = max(3.5 * float(np.linalg.norm(distance[furthest])), 0.02 * width)
    enlarged = reach < _LARGEST_ZOOM * width
    middle = nominal[furthest]
    with matplotlib.rc_context(_STYLE):
        figure = Figure(
            figsize=(10.0, 0.9 + (7.2 if enlarged else 9.6) * min(max(height / width, 0.3), 0.6)), layout="constrained"
        )
        figure.suptitle(f"Episode {episode + 1}, {log.time[episode, sample]:.1f} s", x=0.0, ha="left", fontsize=11)
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
            for end in range(2):
                for polygon in gripper_outline(pose[end], end):
                    axes.fill(*polygon.T, color=LIGHT.gripper, alpha=0.8, lw=0)
            if explained is not None:
                label = _explained_label(diagnosis)
                axes.plot(*cable_curve(explained).T, color=LIGHT.residual, lw=3.2 * thick, label=label)
            believed, dashes = "simulator as believed", (0, (4, 2))
            axes.plot(*cable_curve(nominal).T, color=LIGHT.direct, lw=2.0 * thick, ls=dashes, label=believed)
            axes.plot(*observed.T, "o", color=LIGHT.ink, ms=4.5 * thick, label="observed keypoints")
        _bar(ax, 0.1, "10 cm")
        if zoom is not None:
            zoom.set_title("enlarged", fontsize=10)
            ax.add_patch(Rectangle(tuple(middle - reach), 2 * reach, 2 * reach, fill=False, ec=LIGHT.muted, lw=1))
            size = 10.0 ** np.floor(np.log10(reach))
            _bar(zoom, size, f"{1e3 * size:g} mm")
        handles, labels = ax.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower left", ncols=len(labels))
    return figure


def where_figure(diagnosis: Diagnosis) -> Figure:
    """The gap along the cable, and along the cable over time in every episode, in units of the noise."""
    where, log = diagnosis.where, diagnosis.log
    arclength = np.asarray(log.meta["keypoint_arclength_m"])
    episodes = np.arange(len(where.per_episode_mm))
    if len(episodes) > _MAX_EPISODES:
        episodes = np.sort(np.argsort(-where.per_episode_mm)[:_MAX_EPISODES])
    columns = min(3, len(episodes))
    rows = -(-len(episodes) // columns)
    smooth = [_smoothed(diagnosis, int(e)) for e in episodes]
    top = max(4.0, float(np.nanpercentile(np.concatenate([s.ravel() for s in smooth]), 99)))
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(10.0, 1.5 + 1.55 * rows), layout="constrained")
        grid = figure.add_gridspec(1 + rows, columns, height_ratios=[0.8, *[1.25] * rows])
        _strip(figure.add_subplot(grid[0, :]), diagnosis, arclength)
        image, panels = None, []
        for index, (e, values) in enumerate(zip(episodes, smooth, strict=True)):
            ax = figure.add_subplot(grid[1 + index // columns, index % columns])
            panels.append(ax)
            end = float(log.time[e, log.episode_length[e] - 1])
            half = 0.5 * float(np.median(np.diff(arclength)))
            extent = (0.0, end, arclength[0] - half, arclength[-1] + half)
            image = ax.imshow(
                values.T, cmap=_HEAT, vmin=0.0, vmax=top, aspect="auto", origin="lower", extent=extent,
                interpolation="nearest",
            )  # fmt: skip
            _mark_holds(ax, diagnosis, int(e), arclength[-1] + half)
            ax.set_title(f"Episode {e + 1}: {where.per_episode_mm[e]:.1f} mm", fontsize=10)
            ax.tick_params(labelleft=index % columns == 0)
            if index % columns == 0:
                ax.set_ylabel("along\ncable [m]", fontsize=9)
            if index + columns >= len(episodes):
                ax.set_xlabel("time [s]", fontsize=9)
        if image is not None:
            colours = figure.colorbar(image, ax=panels, shrink=0.8, pad=0.01)
            colours.set_label("gap / noise", fontsize=9)
    return figure


def ranking_figure(diagnosis: Diagnosis) -> Figure | None:
    """Effects that were tried alone: how probable each is, and how much of the gap it takes away; None without any."""
    ranked = [r for r in diagnosis.ranking if max(r.probability, r.held_out_shrinkage) >= 5e-3]
    ranked = (ranked if len(ranked) >= 3 else list(diagnosis.ranking))[:_MAX_RANKED]
    if not ranked:
        return None
    named = {effect.name for effect in diagnosis.effects}
    alike = {name for group in diagnosis.equivalent for name in group} - named
    colours = [LIGHT.residual if r.name in named else "#56b4e9" if r.name in alike else LIGHT.target for r in ranked]
    # few bars are not blown up
    rows = max(len(ranked), 3)
    y = rows - 1 - np.arange(len(ranked))
    # were there no other causes than those of the library
    chance = "probability [%]" if diagnosis.effects else "probability, were it in the library [%]"
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(10.0, 0.9 + 0.36 * rows), layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        for ax, values, title in (
            (left, [100 * r.probability for r in ranked], chance),
            (right, [100 * max(r.held_out_shrinkage, 0.0) for r in ranked], "share of the gap that it takes away [%]"),
        ):
            ax.barh(y, values, color=colours, height=0.62)
            for row, value in zip(y, values, strict=True):
                ax.text(value + 1.5, row, _percent(value), va="center", fontsize=10)
            ax.set(xlim=(0, 112), ylim=(-0.6, rows - 0.4), xticks=[])
            ax.spines[["bottom"]].set_visible(False)
            ax.set_title(title)
        left.set_yticks(y, [effect_title(r.name) for r in ranked])
        left.tick_params(length=0, labelcolor=LIGHT.ink)
        right.tick_params(length=0)
    return figure


def shrinkage_figure(diagnosis: Diagnosis) -> Figure:
    """Error before and after by horizon over the noise floor, five seconds ahead beside a correction that knows no
    cause, and what the error before consists of."""
    gap = diagnosis.gap
    explained = diagnosis.explained is not None
    believed = LIGHT.target if diagnosis.verdict == "none" else LIGHT.direct
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(10.0, 4.0), layout="constrained")
        grid = figure.add_gridspec(2, 2, height_ratios=[3.4, 0.5], width_ratios=[2.4, 1.0])
        ax = figure.add_subplot(grid[0, 0] if gap.ahead_mm else grid[0, :])
        horizons = sorted(gap.horizons_mm.items())
        x = np.arange(len(horizons))
        before, after = np.array([values for _, values in horizons]).reshape(-1, 2).T
        wide = 0.38 if explained else 0.5
        _bars(ax, x - (wide / 2 if explained else 0), before, wide, believed, "simulator as believed")
        if explained:
            _bars(ax, x + wide / 2, after, wide, LIGHT.residual, _explained_label(diagnosis))
        noise = f"noise of the recording, {gap.noise_floor_mm:.1f} mm"
        ax.axhline(gap.noise_floor_mm, color=LIGHT.ink, lw=1.2, ls=(0, (5, 3)), label=noise)
        longest = max((seconds for seconds, _ in horizons), default=0.0)
        ax.set_xticks(x, [f"first {seconds:g} s" if seconds < longest else "all" for seconds, _ in horizons])
        ax.set_ylim(0, 1.15 * max(before.max(initial=0), after.max(initial=0), gap.noise_floor_mm))
        ax.set_ylabel("RMS error [mm]")
        ax.tick_params(axis="x", length=0)
        ax.set_title("Simulated from the start of each episode")
        if gap.ahead_mm:
            _ahead(figure.add_subplot(grid[0, 1]), gap.ahead_mm, believed, explained)
        _split_bar(figure.add_subplot(grid[1, :]), gap.split)
        figure.legend(*ax.get_legend_handles_labels(), loc="outside upper left", ncols=3)
    return figure


def motion_figure(diagnosis: Diagnosis) -> Figure | None:
    """The motion to record next, and how well each motion of the library tells the explanations apart."""
    following = diagnosis.next_motion
    if following is None:
        return None
    config = config_of_log(diagnosis.log)
    poses = safe_motions(config, diagnosis.log.gripper_pose[0, 0]).get(following.motion)
    names = sorted(following.alternatives, key=lambda n: following.alternatives[n])
    values = [following.alternatives[n] for n in names]
    colours = [LIGHT.residual if n == following.motion else LIGHT.target for n in names]
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(10.0, 4.2), layout="constrained")
        halves: Any = figure.subfigures(2, 1, height_ratios=[1.0, 1.15])
        frames, bars = halves
        if poses is not None:
            _film(frames, config, poses)
        ax = bars.subplots()
        ax.barh(range(len(names)), values, color=colours, height=0.62)
        for row, value in enumerate(values):
            ax.text(value + 0.01 * max(values), row, f"{value:.2g}", va="center", fontsize=10)
        ax.set_yticks(range(len(names)), [effect_title(n) for n in names])
        ax.set(xticks=[], xlim=(0, 1.08 * max(values) or 1.0))
        ax.spines[["bottom"]].set_visible(False)
        ax.tick_params(length=0, labelcolor=LIGHT.ink)
        what = "Difference of the two explanations" if following.separates else "Change of the prediction"
        ax.set_title(f"{what} on each safe motion, in units of the noise")
    return figure


def _interval(diagnosis: Diagnosis) -> float:
    steps = np.diff(diagnosis.log.time[0, : diagnosis.log.episode_length[0]])
    return float(np.median(steps)) if len(steps) else 1.0


def _smoothed(diagnosis: Diagnosis, episode: int) -> np.ndarray:
    """Gap in noise units over about one second, noise taken out, shape [T, N]; NaN where nothing was observed."""
    length = int(diagnosis.log.episode_length[episode])
    squared = diagnosis.where.heat[episode, :length] ** 2
    width = max(1, round(_SMOOTHING_S / _interval(diagnosis)))
    seen = np.isfinite(squared)
    kernel = np.ones(min(width, length))
    sums = np.stack(
        [np.convolve(np.where(seen, squared, 0.0)[:, n], kernel, mode="same") for n in range(squared.shape[1])]
    )
    counts = np.stack([np.convolve(seen[:, n].astype(float), kernel, mode="same") for n in range(squared.shape[1])])
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.sqrt(np.maximum(sums / np.where(counts > 0, counts, np.nan) - 1.0, 0.0)).T


def _strip(ax: Axes, diagnosis: Diagnosis, arclength: np.ndarray) -> None:
    """The cable laid straight, coloured by the gap, with its numbers and the places of the named effects."""
    profile = diagnosis.where.along_cable_mm
    along = np.linspace(arclength[0], arclength[-1], 400)
    smooth = np.interp(along, arclength, profile)
    top = max(float(profile.max()), float(diagnosis.noise_mm.mean()))
    ax.imshow(
        smooth[None], cmap=_HEAT, vmin=0.0, vmax=top, aspect="auto", extent=(arclength[0], arclength[-1], 0.0, 1.0)
    )
    ax.add_patch(Rectangle((arclength[0], 0), arclength[-1] - arclength[0], 1, fill=False, ec=LIGHT.muted, lw=1))
    for s, value in zip(arclength, profile, strict=True):
        ax.text(s, 1.12, f"{value:.1f}", ha="center", va="bottom", fontsize=9, color=LIGHT.muted)
    for effect in diagnosis.effects:
        for low, high in _sections(effect, arclength):
            low, high = (low - 0.008, high + 0.008) if high - low < 0.016 else (low, high)
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


def _mark_holds(ax: Axes, diagnosis: Diagnosis, episode: int, top: float) -> None:
    """Bars over the time in which the grippers rest and the cable has settled."""
    length = int(diagnosis.log.episode_length[episode])
    hold = diagnosis.where.regime_masks.get("speed: hold")
    if hold is None:
        return
    edges = np.flatnonzero(np.diff(np.concatenate([[0], hold[episode, :length].astype(int), [0]])))
    time = diagnosis.log.time[episode]
    for begin, end in edges.reshape(-1, 2):
        ax.plot([time[begin], time[end - 1]], [top, top], color=LIGHT.ink, lw=3, solid_capstyle="butt", clip_on=False)


def _draw_places(ax: Axes, diagnosis: Diagnosis, cable: np.ndarray) -> None:
    """Broad bands and rings where the named effects sit."""
    arclength = np.asarray(diagnosis.log.meta["keypoint_arclength_m"])
    curve = cable_curve(cable, n_points=401)
    s = np.linspace(arclength[0], arclength[-1], 401)
    for effect in diagnosis.effects:
        table = effect.location.get("table_m")
        for low, high in _sections(effect, arclength):
            margin = max(0.0, 0.012 - 0.5 * (high - low))
            part = curve[(s >= low - margin) & (s <= high + margin)]
            ax.plot(*part.T, color=LIGHT.residual, alpha=0.22, lw=17, solid_capstyle="butt")
        if table is not None:
            radius = effect.parameters.get("radius_m")
            size = 0.02 if radius is None else float(radius.value)
            ax.add_patch(Circle(tuple(table), size, fc=LIGHT.residual, ec=LIGHT.residual, alpha=0.3, lw=1.5))


def _sections(effect: NamedEffect, arclength: np.ndarray) -> list[tuple[float, float]]:
    """Where along the cable an effect sits; one that names several keypoints sits at each of them."""
    index = effect.parameters.get("index")
    if index is not None:
        return [(float(arclength[i]), float(arclength[i])) for i in np.atleast_1d(index.value)]
    along = effect.location.get("along_cable_m")
    return [] if along is None else [(float(along[0]), float(along[1]))]


def _explained_label(diagnosis: Diagnosis) -> str:
    if not diagnosis.effects:
        return "with the best explanation found, not named"
    names = [effect_title(effect.name) for effect in diagnosis.effects]
    return f"with {names[0]}" if len(names) == 1 else "with the named effects"


def _bar(ax: Axes, length: float, label: str) -> None:
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    x, y = x1 - 0.04 * (x1 - x0), y0 + 0.05 * (y1 - y0)
    ax.plot([x - length, x], [y, y], color=LIGHT.muted, lw=1.8, solid_capstyle="butt")
    ax.text(x, y + 0.02 * (y1 - y0), label, ha="right", va="bottom", color=LIGHT.muted, fontsize=9)


def _bars(ax: Axes, x: np.ndarray, heights: np.ndarray, width: float, colour: Any, label: str | None = None) -> None:
    """Bars with their heights written on top."""
    ax.bar(x, heights, width, color=colour, label=label)
    for at, height in zip(x, heights, strict=True):
        ax.text(at, height, f"{height:.1f}", ha="center", va="bottom", fontsize=9.5)


def _ahead(ax: Axes, errors: dict[str, float], believed: str, explained: bool) -> None:
    """Predictions five seconds ahead of the last observation: the ridge residual is what a cause-blind correction is."""
    kinds = {"nominal": ("as\nbelieved", believed), "ridge": ("online\nresidual", LIGHT.target)}
    if explained:
        kinds["named"] = ("cause\nadded", LIGHT.residual)
    shown = [kind for kind in kinds if np.isfinite(errors.get(kind, np.nan))]
    heights = np.array([errors[kind] for kind in shown])
    _bars(ax, np.arange(len(shown)), heights, 0.6, [kinds[kind][1] for kind in shown])
    ax.set_xticks(range(len(shown)), [kinds[kind][0] for kind in shown])
    ax.set_ylim(0, 1.15 * heights.max(initial=0.1))
    ax.tick_params(axis="x", length=0)
    ax.set_title("5 s ahead, from an observation")


def _split_bar(ax: Axes, split: dict[str, float]) -> None:
    """What the squared error before consists of."""
    begin = 0.0
    for key, label, colour in _SPLIT:
        share = split.get(key, 0.0)
        if share >= 5e-3:
            ax.barh(0, share, left=begin, color=colour, height=0.6, label=f"{label} {100 * share:.0f} %")
            begin += share
    ax.set(xlim=(0, 1), ylim=(-0.4, 0.4), yticks=[], xticks=[])
    ax.spines[:].set_visible(False)
    ax.set_title("The squared error before consists of")
    if begin:
        ax.legend(loc="upper left", bbox_to_anchor=(0.0, 0.05), ncols=4, fontsize=9.5, handlelength=1.0, borderpad=0.0)


def _film(figure: Any, config: CableConfig, poses: np.ndarray) -> None:
    """The motion as a few frames: where it begins, and where the grippers turn or stop."""
    speed = np.diff(poses, axis=0).reshape(len(poses) - 1, -1)
    turns = 1 + np.flatnonzero(np.abs(np.diff(speed, axis=0)).max(axis=1) > 1e-3)
    moving = np.flatnonzero(np.abs(speed).max(axis=1) > 1e-9)
    stops = sorted({int(t) for t in turns if np.abs(speed[t - 1]).max() > 1e-9} | {int(m) + 1 for m in moving[-1:]})
    apart = [0]
    for sample in stops:
        if np.abs(poses[sample] - poses[apart[-1]]).max() > 0.02:
            apart.append(sample)
    chosen = apart[:_MAX_FRAMES]
    nodes, angles = [], arch_angles(config, poses[0])
    for sample in chosen:
        try:
            angles = find_equilibrium(config, poses[sample], angles).angles
            nodes.append(np.concatenate([chain_nodes(config, poses[sample], angles), poses[sample, 1:, :2]]))
        except ValueError:
            # a picture without its cable is better than none
            nodes.append(np.full((1, 2), np.nan))
    every = np.concatenate([poses[chosen, :, :2].reshape(-1, 2), *nodes])
    low, high = np.nanmin(every, axis=0) - 0.1, np.nanmax(every, axis=0) + 0.1
    for ax, sample, line in zip(figure.subplots(1, len(chosen), squeeze=False)[0], chosen, nodes, strict=True):
        for gripper in range(2):
            ax.plot(*poses[:, gripper, :2].T, color=LIGHT.faint, lw=1.5)
            for polygon in gripper_outline(poses[sample, gripper], gripper):
                ax.fill(*polygon.T, color=LIGHT.gripper, alpha=0.85, lw=0)
        ax.plot(*line.T, color=LIGHT.residual, lw=2.2)
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[])
        ax.spines[:].set_visible(False)
        ax.set_title(f"{INTERVAL * sample:.0f} s", fontsize=10)


def _percent(value: float) -> str:
    if value >= 99.5:
        return "> 99"
    return f"{value:.0f}" if value >= 0.5 or value == 0 else "< 1"
