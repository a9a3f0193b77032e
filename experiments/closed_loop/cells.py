"""Cells of the tables: selects their trials, and formats mean, spread and failures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import get_args

import numpy as np

from closed_loop.methods import LABEL
from closed_loop.paper import METHOD_LABEL, Measure
from closed_loop.statistics import Interval, summarise
from closed_loop.trials import Trial
from pages import markdown_table

SHAPES = ("U", "S", "Z")
MEASURES: tuple[Measure, ...] = get_args(Measure)
UNIT: dict[Measure, str] = {"terminal": "terminal error [cm]", "settling": "settling time [s]"}
FAILED: dict[Measure, str] = {"terminal": "lost", "settling": "did not settle"}


def trials_of_table(trials: Iterable[Trial], table: str) -> list[Trial]:
    trials = list(trials)
    mine = [trial for trial in trials if trial.table == table]
    if not mine:
        raise ValueError(f"No trial of table {table!r}, only of {sorted({trial.table for trial in trials})}.")
    return mine


def scenarios_of(trials: Sequence[Trial]) -> list[str]:
    """The letters in the paper's order, then the others as they appear."""
    present = dict.fromkeys(trial.scenario for trial in trials)
    return [s for s in SHAPES if s in present] + [s for s in present if s not in SHAPES]


def methods_of(trials: Sequence[Trial]) -> list[str]:
    """The paper's in its order, then the others as they appear."""
    present = dict.fromkeys(trial.method for trial in trials)
    return [method for method in {**METHOD_LABEL, **present} if method in present]


def of_scenario(trials: Iterable[Trial], scenario: str) -> list[Trial]:
    return [trial for trial in trials if trial.scenario == scenario]


def value_of(trial: Trial, measure: Measure) -> float:
    return trial.terminal_error_cm if measure == "terminal" else trial.settling_time_s


def cell_text(trials: Sequence[Trial], measure: Measure) -> str:
    return failing_text([value_of(trial, measure) for trial in trials], measure) if trials else ""


def failing_text(values: Sequence[float], measure: Measure) -> str:
    """Mean ± standard deviation, and how many failed."""
    summary = summarise(values)
    spread = spread_text(summary.mean, summary.std) if summary.failures < summary.count else "none"
    if not summary.failures:
        return spread
    return f"{spread} ({summary.failures} of {summary.count} {FAILED[measure]})"


def spread_text(mean: float, std: float) -> str:
    return f"{mean:.2f} ± {std:.2f}"


def number_text(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else ("failed" if np.isinf(value) else "none")


def interval_text(interval: Interval, form: str = ".2f") -> str:
    return f"{interval.low:{form}} to {interval.high:{form}}" if np.isfinite(interval.low) else "none"


def trial_count(trials: Sequence[Trial]) -> str:
    """Trials per scenario: one number, or the least and the most."""
    counts = {sum(trial.scenario == s for trial in trials) for s in {trial.scenario for trial in trials}}
    return str(counts.pop()) if len(counts) == 1 else f"{min(counts)} to {max(counts)}"


def label_of(method: str) -> str:
    return LABEL.get(method, method)


def markdown(title: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join(markdown_table([title, *rows])) + "\n"
