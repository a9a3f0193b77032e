"""The model card of trained weights as Markdown: data, accuracy, limits."""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.error_report import ErrorReport
from cablejax.text_file import differences, markdown_table

_POINTS = 12
_CURVE = ("step", "phase", "learning_rate", "loss")


def network_words(config: ModelConfig) -> str:
    """Words for the size of the network, to begin a sentence."""
    return f"A graph network of {config.message_passing} message-passing steps, latent size {config.latent},"


def write_card(
    path: str | os.PathLike[str],
    *,
    name: str,
    config: ModelConfig,
    info: Mapping[str, Any],
    metrics: Path,
    report: ErrorReport,
    commands: Sequence[str],
) -> None:
    """Writes a model card.

    Args:
        path: the Markdown file.
        name: of the model.
        config: of the network.
        info: what the weights file says of their origin: "data", "training", "versions", "machine".
        metrics: the training's `metrics.csv`.
        report: accuracy on held-out trajectories.
        commands: command lines that make the data and train the model again.
    """
    snapped = ", ".join(
        f"{100 * share:.1f} % within {h}"
        for h, share in zip(report.errors["all windows"]["network"].horizons, report.snapping_fraction(), strict=True)
    )
    changes = differences(*(d["config"] for d in info["data"]))
    data = [["data set", "trajectories", "held out", "commands each", "seed", "SHA-256"]]
    for d in info["data"]:
        one = {**d["config"], **d, "digest": f"`{d['digest']}`"}
        data.append([str(one[key]) for key in ("name", "n_trajectories", "held_out", "n_steps", "seed", "digest")])
    lines = [
        f"# {name}",
        "",
        f"{network_words(config)} of the dynamics of a cable of {config.length:g} m held at both ends: "
        f"{config.n_keypoints} keypoints, one step of {config.interval:g} s, {config.history} samples of history. It "
        f"corrects {'no' if config.prior == 'none' else f'the {config.prior}'} prior"
        + (", commutes with mirroring and with reversing the cable" if config.symmetric else "")
        + (" and has the cable's stiffness and friction as inputs." if config.conditioned else "."),
        "",
        "## Data",
        "",
        *markdown_table(data),
        "",
        f"Effects in the data: {', '.join(f'`{effect}`' for effect in info.get('effects', ())) or 'none'}. The weights "
        "file has the whole configuration of each data set: its cable, its effects with their draws, and the ranges of "
        "its parameters.",
        "",
        "Held out are the last trajectories of each. Differences between the data sets' configurations: "
        + (", ".join(f"{name} ({', '.join(map(str, values))})" for name, values in changes.items()) or "none")
        + ".",
        "",
        "## Training",
        "",
        f"Seed {info['training']['seed']}. Phases:",
        "",
        *(f"- {', '.join(f'{key} {value}' for key, value in phase.items())}" for phase in info["training"]["phases"]),
        "",
        "The loss is a mean over the steps of one compiled call; open-loop errors are medians on held-out "
        "trajectories [cm] of the averaged weights, after the steps named.",
        "",
        *_curve(metrics),
        "",
        "## Accuracy on held-out trajectories",
        "",
        f"Windows in which the true cable snaps through count apart: {snapped} steps.",
        "",
        *report.markdown(),
        "",
        "## Made with",
        "",
        f"{info['versions']}; {info['machine']}.",
        "",
        "```sh",
        *commands,
        "```",
        "",
    ]
    Path(path).write_text("\n".join(lines), encoding="utf-8", errors="replace")


def _curve(metrics: Path) -> list[str]:
    """A dozen rows of the training's metrics, from those with an open-loop evaluation where there are any."""
    with metrics.open(newline="") as file:
        rows = list(csv.DictReader(file))
    if not rows:
        return ["No metrics were recorded."]
    scores = [column for column in rows[0] if column.startswith("open_loop_")]
    scored = [row for row in rows if any(row[column] for column in scores)] or rows
    pick = np.unique(np.linspace(0, len(scored) - 1, min(_POINTS, len(scored))).round().astype(int))
    columns = [*_CURVE, *scores]
    header = [column.replace("open_loop_", "after ").replace("_cm", "").replace("_", " ") for column in columns]
    return markdown_table([header, *([scored[i][column] for column in columns] for i in pick)])
