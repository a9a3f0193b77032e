"""The page of `accelerator.py`: tables of its records, and how far they are from the goals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pages import markdown_table

Record = dict[str, Any]

EPISODE = 60
"""Commands of one closed-loop episode, as in the stiffness table."""

_TRANSITIONS, _EPISODES, _LINKS = 2_000_000, 100_000, 33


def page(records: Sequence[Record], setting: dict[str, str]) -> str:
    """The Markdown page of all measurements of one setting."""
    dates = sorted({record["date"] for record in records})
    lines = [
        "# One accelerator",
        "",
        f"Made by `python benchmarks/accelerator.py {'--small ' if setting['sizes'] == 'small' else ''}"
        "--out docs/results/accelerator.md`"
        + (f", {dates[0]}" if dates[:1] == dates[-1:] else f", {dates[0]} to {dates[-1]}" if dates else "")
        + ".",
        f"Device: {setting['device']}. Host: {setting['machine']}. {setting['versions']}.",
        "",
        "A rate is the median of the timed calls; in brackets are the slowest call, the fastest and their number. The",
        "first call of each program warms up and does not count. Memory is that of the compiled program: arguments,",
        "results and everything in between. Energy is read from the card's own counter, for the whole card. MuJoCo",
        "Warp and Newton are not among the engines of this script.",
        "",
        "## Goals",
        "",
        *markdown_table([["what", "asked", "goal", "measured", "asked is reached"], *_goals(records)]),
        "",
        "A transition is one command of 1 s: for the chain, 20 steps of 50 ms at 33 links. An episode has 60 commands.",
    ]
    for section, (title, about, titles, row) in _TABLES.items():
        found = [record for record in records if record["section"] == section]
        if found:
            cells = [row(record) if "failure" not in record else _failed(record, titles) for record in found]
            lines += ["", f"## {title}", "", about, "", *markdown_table([titles, *cells])]
    missing = [title for section, (title, *_) in _TABLES.items() if section not in {r["section"] for r in records}]
    if missing:
        lines += ["", f"Not measured: {', '.join(missing).lower()}."]
    return "\n".join(lines) + "\n"


def _rates(record: Record) -> np.ndarray:
    return record["work"] / np.asarray(record["seconds"])


def _median(record: Record) -> float:
    return float(np.median(_rates(record)))


def _number(x: float) -> str:
    return f"{x / 1e6:.3g} million" if x >= 999_500 else f"{float(f'{x:.3g}'):,.10g}"


def _rate(record: Record) -> str:
    rates = _rates(record)
    return f"{_number(np.median(rates))} ({_number(rates.min())} to {_number(rates.max())}; {len(rates)})"


def _memory(record: Record) -> str:
    return "" if record["bytes"] is None else f"{_number(record['bytes'] / 2**20)} MiB"


def _energy(record: Record, unit: float) -> str:
    return "" if record["joules"] is None else f"{record['joules'] / record['work'] * unit:.3g} J"


def _failed(record: Record, titles: Sequence[str]) -> list[str]:
    """The labels of a measurement that could not be made, and why."""
    cells = [f"{record[title]}" if title in record else "" for title in titles]
    cells[cells.index("")] = record["failure"]
    return cells


def _goals(records: Sequence[Record]) -> list[list[str]]:
    """What was asked, and what was measured of it."""
    rows = []
    found = [r for r in records if r["section"] == "rollout" and r["links"] == _LINKS and "failure" not in r]
    rollouts = [r for r in found if r["bytes"] is not None]
    for engine in dict.fromkeys(r["engine"] for r in rollouts):
        best = max((r for r in rollouts if r["engine"] == engine), key=_median)
        speed = _median(best)
        name = f"environment-steps per second, {_LINKS} links, {engine}"
        rows.append(
            [name, "1 million", "5 million", f"{_number(speed)}, batch {best['batch']:,}", _reached(speed, 1e6)]
        )
    for record in records:
        if record["section"] == "data" and "failure" not in record:
            seconds = _TRANSITIONS / _median(record)
            name = f"2 million transitions drawn, simulated and written, {record['engine']}, compiled before"
            rows.append([name, "60 s", "20 s", f"{_number(seconds)} s", _reached(60, seconds)])
    loops = [record for record in records if record["section"] == "loop" and "failure" not in record]
    if not loops:
        rows.append([f"{_EPISODES:,} closed-loop episodes", "1 h", "20 min", "not measured", ""])
    for record in loops:
        hours = _EPISODES * EPISODE / _median(record) / 3600
        name = f"{_EPISODES:,} closed-loop episodes, matrix products {record['products']}, extrapolated"
        rows.append([name, "1 h", "20 min", f"{hours:.2f} h", _reached(1.0, hours)])
    return rows


def _reached(much: float, little: float) -> str:
    return "yes" if much >= little else f"no, {little / much:.3g} times short"


def _simulated(record: Record) -> list[str]:
    return [
        record["engine"],
        f"{record['links']}",
        f"{record['batch']:,}",
        _rate(record),
        _memory(record),
        "" if record["bytes"] is None else _energy(record, 1e6),  # the host's work has no share in the card's energy
        f"{record['prepare_s']:.0f}",
    ]


def _stored(record: Record) -> list[str]:
    whole, draw, both = float(np.median(record["seconds"])), record["draw_s"], record["both_s"]
    parts = [f"{seconds:.1f}" for seconds in (whole, draw, both - draw, max(whole - both, 0.0))]
    return [record["engine"], f"{record['trajectories']:,}", _rate(record), *parts]


_ROLLOUT = [
    "engine",
    "links",
    "batch",
    "environment-steps per second",
    "memory",
    "per million steps",
    "compiled in [s]",
]

_TABLES: dict[str, tuple[str, str, list[str], Callable[[Record], list[str]]]] = {
    "rollout": (
        "Simulation",
        "One simulated second of slowly moved arches on the table, time step 20 ms. `chain` is the closed-form chain "
        "of the\ndiagnosis without its obstacle; its 20 steps of settling count. Programs are compiled side by side, "
        "so their\ncompile times overlap.",
        _ROLLOUT,
        _simulated,
    ),
    "gradient": (
        "Simulation and gradient",
        "The same, and the gradient of a sum over the final keypoints in the grippers' motion, reverse mode. MJX "
        "recomputes each\ninterval of 0.2 s; the chain keeps everything.",
        _ROLLOUT,
        _simulated,
    ),
    "precision": (
        "Precision",
        "Largest distance of any keypoint after 3 s in single precision from the same program in double precision on "
        "the same\ndevice, and from C MuJoCo on the processor, which is another integration of the same model.",
        ["engine", "from double precision", "from C MuJoCo"],
        lambda r: [r["engine"], f"{r['double_mm']:.2g} mm", f"{r['c_mm']:.2g} mm"],
    ),
    "data": (
        "Transitions to disk",
        "Random motions into a store on the local disk, by one call of `generate` that finds its program compiled. "
        "Motions are\ndrawn on all cores of the host. The store's share is what the whole takes beyond the others.",
        ["engine", "trajectories", "transitions per second", "whole [s]", "drawing [s]", "simulation [s]", "store [s]"],
        _stored,
    ),
    "training": (
        "Training",
        "The released network: a training step sees a batch of windows and rolls the model out for some steps. The "
        "released\ntraining is 30,000 steps of batch 32, rollout 1, and 12,000 of batch 16, rollout 4.",
        ["batch", "rollout", "windows per second", "optimiser steps per second", "memory", "per million windows"],
        lambda r: [
            f"{r['batch']:,}",
            f"{r['rollout']}",
            _rate(r),
            f"{_median(r) / r['batch']:.1f}",
            _memory(r),
            _energy(r, 1e6),
        ],
    ),
    "control": (
        "Batched control calls",
        "One compiled controller for many cables: residual fit, plan of horizon 5 by the default solver, command.",
        ["cables", "plans per second", "ms per call", "memory", "per thousand plans"],
        lambda r: [
            f"{r['cables']:,}",
            _rate(r),
            f"{1e3 * float(np.median(r['seconds'])):.1f}",
            _memory(r),
            _energy(r, 1e3),
        ],
    ),
    "loop": (
        "Closed loops",
        "Whole closed loops as one program: MJX as plant, observation, residual, plan and command, from a straight "
        "start to an S,\ncables half to twice as stiff as nominal. Matrix products of network and planner are "
        "`default`, JAX's default on the\ndevice (TF32 on an H100), or `highest`, full single precision. The error is "
        "the median over the cables after the\ncommands named.",
        ["cables", "commands", "products", "commands per second", "episodes per hour", "error [cm]", "per episode"],
        lambda r: [
            f"{r['cables']:,}",
            f"{r['commands']}",
            r["products"],
            _rate(r),
            _number(_median(r) * 3600 / EPISODE),
            f"{r['error_cm']:.3f}",
            _energy(r, EPISODE),
        ],
    ),
}
