"""The pages of data sets, trained weights and verdicts."""

from __future__ import annotations

import contextlib
import csv
import math
import os
import pathlib
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import matplotlib
import numpy as np
from matplotlib.figure import Figure

from cablejax.dataset.schema import Block
from cablejax.dataset.store import MissingShardError, Store
from cablejax.diagnose.diagnosis import Diagnosis
from cablejax.diagnose.judgement import effect_title, listed, share
from cablejax.dynamics.card import network_words
from cablejax.dynamics.weights import cable_of_weights, load_info, load_weights, weights_path
from cablejax.report.diagnosis_charts import ranking_figure
from cablejax.report.diagnosis_sections import named_effects
from cablejax.report.effect_words import between
from cablejax.report.sheet import LETTERS_CAPTION, Sheet, cable_cards, cable_facts, letters_figure, span
from cablejax.report.style import DIAGNOSIS_STYLE, LIGHT, cable_curve
from cablejax.text_file import read_text

_SHOWN = 24


def store_sheet(store: Store, name: str) -> Sheet:
    """The page of a data set, from its configuration and its first complete shard.

    Raises:
        ValueError: its first complete shard is damaged.
    """
    config, info = store.config, store.info()
    block = _first_shard(store)
    seconds = config.n_steps * config.interval
    missing = "complete" if info.complete else f"{config.n_trajectories - info.n_complete} are missing"
    effects = ", ".join(config.effects_shown) or "none"
    return Sheet(
        kind="data set",
        title=f"{info.n_complete} simulated motions of a cable of {config.cable.length:g} m, {seconds:g} s each",
        lead=f"{name}: random motions of two grippers, simulated without noise; {missing}.",
        cards=[
            ("Trajectories", f"{info.n_complete} of {config.n_trajectories}", f"seed {config.seed}"),
            ("Commands each", f"{config.n_steps}", f"held for {config.interval:g} s"),
            ("Simulator", config.engine, f"{config.discretisation.n_links} links"),
            ("Effects", effects, ""),
            *cable_cards(config.cable),
        ],
        figures=[] if block is None else [(_store_figure(block), _STORE_CAPTION)],
        tables=[] if block is None else [_store_ranges(block)],
        following=(
            *([] if info.complete else ["Run the same command again: it resumes where it stopped."]),
            *(
                [f"Train a model on it: cablejax train --data {shlex.quote(name)}"]
                if info.complete and config.trainable
                else []
            ),
            f"Write its cable to a file: cablejax cable --from {shlex.quote(name)} --out cable.toml",
        ),
        facts={
            **cable_facts(config.cable),
            "motions drawn and rejected": f"{info.attempts}",
            "digest": info.digest or "none until all trajectories are complete",
            "versions": ", ".join(f"{package} {version}" for package, version in store.versions.items()),
        },
    )


_STORE_CAPTION = (
    f"Left: the cable at the end of up to {_SHOWN} motions. Right: how far a keypoint moves in one command, over all "
    "keypoints of the first shard."
)


def weights_sheet(source: str | os.PathLike[str], name: str) -> Sheet:
    """The page of trained weights: network, training data, and training curves if the folder has them.

    Args:
        source: as in `cablejax.dynamics.weights.load_weights`.
        name: to be shown.

    Raises:
        ValueError: they cannot be used, see `load_weights`.
    """
    config, _, weights = load_weights(source)
    path, info, cable = weights_path(source), load_info(source), cable_of_weights(source)
    count = sum(np.size(leaf) for leaf in jax.tree.leaves(weights))
    card = next((file for file in (path.parent / "card.md", path.with_suffix(".md")) if file.is_file()), None)
    data = _data_sets(info)
    metrics = path.parent / "metrics.csv"
    curve = _training_figure(metrics) if metrics.is_file() else None
    return Sheet(
        kind="weights",
        title=f"A learned model of a cable of {cable.length:g} m: {count} weights",
        lead=f"{name}: {network_words(config).removesuffix(',')}, one step of {config.interval:g} s, {config.history} "
        "samples of history.",
        cards=[
            ("Data", listed([f"{row[1]} motions" for row in data]) or "not stated", "by set, held out ones included"),
            ("Corrects", "no prior" if config.prior == "none" else f"the {config.prior} prior", ""),
            ("Uses the cable's stiffness", "yes" if config.conditioned else "no", "as an input"),
            ("Mirrored cables move alike", "yes" if config.symmetric else "not exactly", ""),
            *cable_cards(cable),
        ],
        figures=[(letters_figure(cable), LETTERS_CAPTION) if curve is None else (curve, _TRAINING_CAPTION)],
        tables=[("Data sets", ("data set", "motions", "held out", "digest"), data)] if data else [],
        following=(f"Shape a cable with it: cablejax shape --weights {shlex.quote(str(source))}",),
        facts={
            **cable_facts(cable),
            **{key: str(value) for key, value in info.items() if isinstance(value, (str, int, float))},
            "effects in the data": str(info.get("effects") or "none"),
        },
        text="" if card is None else read_text(card),
    )


_TRAINING_CAPTION = "Loss over the training, and the open-loop error on held-out motions where it was measured."


def verdict_sheet(diagnosis: Diagnosis, name: str, *, addable: bool) -> Sheet:
    """The page of a verdict; the diagnosis' own page, next to it, has more.

    Args:
        diagnosis: as read from its file.
        name: of the file.
        addable: whether the named effects are those of a cable on a table, which can be simulated.
    """
    gap = diagnosis.gap
    unit = "mm" if gap.unit == "m" else f"thousandths of {gap.unit}"
    shrinks = "not known" if gap.shrinkage is None else share(gap.shrinkage)
    interval = "" if gap.shrinkage_ci90 is None else f"90 % interval {between(*gap.shrinkage_ci90)}"
    ranking = ranking_figure(diagnosis)
    return Sheet(
        kind="verdict",
        title=diagnosis.sentence,
        lead=f"{name}: what the simulator lacks to explain a recording.",
        cards=[
            ("Cause", ", ".join(effect_title(e.name) for e in diagnosis.effects) or "none named", diagnosis.verdict),
            ("Error", f"{gap.before_rmse_mm:.3g} {unit}", f"with the explanation {gap.after_rmse_mm:.3g} {unit}"),
            ("Noise", f"{gap.noise_floor_mm:.3g} {unit}", ""),
            ("The gap shrinks by", shrinks, interval),
        ],
        figures=[] if ranking is None else [(ranking, "The effects that were tried.")],
        tables=[
            (
                f"{effect_title(effect.name).capitalize()}: {meaning}",
                ("parameter", "estimate (90 % interval)"),
                estimates,
            )
            for effect, meaning, estimates in named_effects(diagnosis)
        ],
        following=(
            *([f"Simulate with the named effects: cablejax simulate --with {shlex.quote(name)}"] if addable else []),
            *diagnosis.caveats,
        ),
        facts={
            "indistinguishable": "; ".join(", ".join(group) for group in diagnosis.equivalent) or "none",
            "horizon": f"{gap.horizon_s:g} s",
            "run time": f"{diagnosis.seconds:.0f} s",
        },
    )


def _data_sets(info: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Name, number of motions, held-out motions and digest of each data set that the weights record."""
    recorded = info.get("data")
    entries = [entry for entry in recorded if isinstance(entry, dict)] if isinstance(recorded, list) else []
    rows = []
    for entry in entries:
        config = entry.get("config")
        count = config.get("n_trajectories") if isinstance(config, dict) else None
        rows.append(tuple(str(v) for v in (entry.get("name"), count, entry.get("held_out"), entry.get("digest"))))
    return rows


def _first_shard(store: Store) -> Block | None:
    """The first complete shard; None where there is none yet."""
    for shard in range(store.config.n_shards):
        with contextlib.suppress(MissingShardError):
            return store.read_shard(shard)
    return None


def _store_figure(block: Block) -> Figure:
    moved = 100 * np.linalg.norm(np.diff(block.keypoints, axis=1), axis=-1).ravel()
    with matplotlib.rc_context(DIAGNOSIS_STYLE):
        figure = Figure(figsize=(10.5, 4.0), layout="constrained")
        table, histogram = figure.subplots(1, 2, width_ratios=[1.4, 1.0])
        colours = matplotlib.colormaps["cividis"](np.linspace(0.35, 0.9, min(len(block), _SHOWN)))
        for colour, points, pose in zip(colours, block.keypoints[:, -1], block.gripper_pose[:, -1], strict=False):
            table.plot(*cable_curve(points, pose).T, color=colour, lw=1.2)
        table.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
        histogram.hist(moved[np.isfinite(moved)], bins=40, color=LIGHT.residual)
        histogram.set(xlabel="motion in one command [cm]", ylabel="keypoints", yscale="log")
    return figure


def _store_ranges(block: Block):
    quantities = {
        "x of the keypoints [m]": block.keypoints[..., 0],
        "y of the keypoints [m]": block.keypoints[..., 1],
        "speed of a gripper [cm/s]": 100 * np.linalg.norm(block.gripper_twist[..., :2], axis=-1),
        "turning speed of a gripper [deg/s]": np.degrees(np.abs(block.gripper_twist[..., 2])),
        **dict(zip(("stiffness ratio", "friction coefficient", "damping time [s]"), block.parameters.T, strict=True)),
    }
    rows = [(name, span(values)) for name, values in quantities.items()]
    return f"Ranges in the first shard, {len(block)} trajectories", ("quantity", "least to largest"), rows


def _training_figure(metrics: pathlib.Path) -> Figure | None:
    """Loss and open-loop errors of a training; None where nothing was recorded."""
    rows = list(csv.DictReader(read_text(metrics).splitlines()))
    columns = [name for name in (rows[0] if rows else {}) if str(name).startswith("open_loop_")]
    panels = {"loss": ["loss"], "open-loop error [cm]": columns}
    curves = {title: {name: _curve(rows, name) for name in names} for title, names in panels.items()}
    curves = {title: {n: xy for n, xy in lines.items() if len(xy[0])} for title, lines in curves.items()}
    shown = {title: lines for title, lines in curves.items() if lines}
    if not shown:
        return None
    with matplotlib.rc_context(DIAGNOSIS_STYLE):
        figure = Figure(figsize=(10.5, 3.2), layout="constrained")
        for ax, (title, lines) in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown.items(), strict=True):
            colours = matplotlib.colormaps["cividis"](np.linspace(0.35, 0.9, len(lines)))
            for colour, (name, (x, y)) in zip(colours, lines.items(), strict=True):
                label = name.removeprefix("open_loop_").removesuffix("_cm")
                ax.plot(x, y, color=colour, lw=1.8, marker="o", ms=3, label=f"after {label} steps")
            ax.set(yscale="log", xlabel="step", title=title)
            if len(lines) > 1:
                ax.legend()
    return figure


def _curve(rows: Sequence[Mapping[str, Any]], column: str) -> tuple[list[float], list[float]]:
    points = []
    for row in rows:
        try:
            step, value = float(row["step"]), float(row[column])
        except (KeyError, TypeError, ValueError):
            continue
        if math.isfinite(value):
            points.append((step, value))
    return [step for step, _ in points], [value for _, value in points]
