"""Writes the results of the closed-loop commands: a summary, a gap log, a page and an animation."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from cablejax.cable import Cable
from cablejax.control.shaping import Runs
from cablejax.gaplog import TARGETS, gap_log_from_episodes, write_gap_log
from cablejax.provenance import machine, versions
from cablejax.report.animation import write_gif
from cablejax.report.page import write_page


def numbers_of(runs: Runs) -> dict[str, dict[str, float | None]]:
    """The numbers of each shape's runs, as the summary has them; those that are undefined are None.

    Settling and planning times are those of the run with the residual, where there is one.
    """
    found: dict[str, dict[str, float | None]] = {}
    for shape in dict.fromkeys(shape for shape, _ in runs):
        with_residual, direct = runs.get((shape, "residual")), runs.get((shape, "direct"))
        main = with_residual or direct
        assert main is not None
        calls = main.mpc_ms[np.isfinite(main.mpc_ms)]
        p50, p95 = np.percentile(calls, [50, 95]) if len(calls) else (np.nan, np.nan)
        found[shape] = {
            "initial_error_cm": _number(main.initial_error_cm),
            "terminal_error_cm": _number(with_residual.terminal_error_cm if with_residual else np.nan),
            "terminal_error_without_residual_cm": _number(direct.terminal_error_cm if direct else np.nan),
            "settling_time_s": _number(main.settling_time_s),
            "mpc_ms_p50": _number(p50),
            "mpc_ms_p95": _number(p95),
        }
    return found


def table_of(summary: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """The summary as header and rows for a terminal."""
    columns = (
        ("initial_error_cm", "start [cm]", ".2f"),
        ("terminal_error_cm", "end, with residual [cm]", ".2f"),
        ("terminal_error_without_residual_cm", "without [cm]", ".2f"),
        ("settling_time_s", "settled [s]", ".0f"),
        ("mpc_ms_p50", "MPC p50 [ms]", ".0f"),
        ("mpc_ms_p95", "p95 [ms]", ".0f"),
    )
    rows = [
        [shape, *("-" if values[key] is None else format(values[key], form) for key, _, form in columns)]
        for shape, values in summary["shapes"].items()
    ]
    return ["shape", *(title for _, title, _ in columns)], rows


def write_results(
    out: pathlib.Path,
    runs: Runs,
    numbers: Mapping[str, Mapping[str, Any]],
    *,
    believed: Cable,
    about: str,
    facts: Mapping[str, str],
) -> None:
    """Writes `log.npz`, `demo.gif` and `report.html` into a folder, replacing files of these names.

    Args:
        out: the folder.
        runs: the runs, by shape and method.
        numbers: of these runs, see `numbers_of`.
        believed: the cable that the model was trained on, which is what the gap log states.
        about: what plant and model these runs had.
        facts: settings to print on the page, with versions and machine.
    """
    episodes = [
        dataclasses.replace(run.episode, motion=f"{run.episode.motion}_{method}") for (_, method), run in runs.items()
    ]
    targets = {TARGETS: [run.target.keypoints.tolist() for run in runs.values()]}
    log = gap_log_from_episodes(episodes, believed, source=about, extra=targets)
    write_gap_log(out / "log.npz", log, overwrite=True)
    write_gif(out / "demo.gif", runs)
    write_page(
        out / "report.html",
        runs,
        numbers,
        about=about,
        facts={**facts, "versions": versions(), "machine": machine()},
        gif=out / "demo.gif",
    )


def _number(value: float) -> float | None:
    return round(float(value), 6) if np.isfinite(value) else None
