"""Tables of intervals, paired differences, and success rates with their intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from scipy.stats import binomtest

from closed_loop.cells import (
    FAILED,
    UNIT,
    interval_text,
    label_of,
    markdown,
    methods_of,
    number_text,
    of_scenario,
    scenarios_of,
    trials_of_table,
)
from closed_loop.paper import LIANG
from closed_loop.statistics import FEW, Interval, mean_interval, paired_difference, summarise
from closed_loop.trials import LATE, LIANG_TABLE, Trial

RESTING_MM = 0.3
"""Peak to peak of the error over the last `LATE` seconds below which a run counts as at rest [mm]."""
SUCCESS_CM = 1.0
"""Liang et al.: a shape is reached below this root mean square error [cm]."""

INTERVAL_NOTE = (
    f"Intervals are of the mean over seeds: of fewer than {FEW} by Student's t, which may begin below zero, else by "
    "the bootstrap."
)


def interval_table(trials: Iterable[Trial], table: str) -> str:
    """What a mean hides: its 95 % interval, the median, the worst trial, and failures.

    The interval is that of the mean over seeds, since trials of one seed share their start, see `mean_interval`.

    Raises:
        ValueError: there is no trial of this table.
    """
    mine = trials_of_table(trials, table)
    rows = []
    for method in methods_of(mine):
        for scenario in scenarios_of(mine):
            cell = of_scenario([trial for trial in mine if trial.method == method], scenario)
            if not cell:
                continue
            summary = summarise([trial.terminal_error_cm for trial in cell])
            rows.append(
                [
                    label_of(method), scenario, str(summary.count), str(summary.failures),
                    str(sum(trial.stopped is not None for trial in cell)), number_text(summary.mean),
                    interval_text(_seed_interval(cell)), number_text(summary.median),
                    number_text(summary.worst),
                ]
            )  # fmt: skip
    title = [
        "method", "scenario", "trials", FAILED["terminal"], "stopped early", f"mean {UNIT['terminal']}",
        "95 % interval", "median", "worst",
    ]  # fmt: skip
    return markdown(title, rows)


def paired_table(trials: Iterable[Trial], table: str, reference: str) -> str:
    """Every method against `reference` in the same trials (stiffness and seed): negative = lower than the reference.

    Raises:
        ValueError: there is no trial of this table, or none by the reference.
    """
    mine = trials_of_table(trials, table)
    if all(trial.method != reference for trial in mine):
        raise ValueError(f"Table {table} has no trial of {reference!r}, only of {sorted({t.method for t in mine})}.")

    def values(method: str, scenario: str) -> dict[tuple[float, int], float]:
        cell = of_scenario([trial for trial in mine if trial.method == method], scenario)
        return {(trial.stiffness, trial.seed): trial.terminal_error_cm for trial in cell}

    rows = []
    for method in methods_of(mine):
        for scenario in scenarios_of(mine):
            if method == reference or not (ours := values(method, scenario)):
                continue
            result = paired_difference(ours, values(reference, scenario), cluster=lambda key: key[1])
            rows.append(
                [
                    label_of(method), scenario, str(result.pairs), str(result.unpaired), str(result.failures),
                    f"{result.mean:+.3f}" if np.isfinite(result.mean) else "none",
                    interval_text(result.interval, "+.3f"), f"{result.better} / {result.worse}",
                ]
            )  # fmt: skip
    title = [
        f"against {label_of(reference)}", "scenario", "pairs", "unpaired", "pairs with a failure",
        f"difference of {UNIT['terminal']}", "95 % interval", "better / worse",
    ]  # fmt: skip
    return markdown(title, rows)


def learning_table(trials: Iterable[Trial], table: str, bases: Mapping[str, str]) -> str:
    """What learning online changes: each method against the same model without it, by stiffness, in the same trials.

    Errors are means of the last `LATE` seconds. A cell is one letter and stiffness; p is of the one-sided sign test, by
    which all pairs are independent: those of one seed share their start. A lost cable ranks behind every other run.

    Args:
        trials: of any tables.
        table: whose rows count.
        bases: the model without it, by method. Those that were not tried are left out.

    Raises:
        ValueError: there is no trial of this table.
    """
    mine = trials_of_table(trials, table)
    late = {(t.method, t.scenario, t.stiffness, t.seed): late_error(t) for t in mine}
    ratios, letters = sorted({t.stiffness for t in mine}), scenarios_of(mine)
    rows = []
    for method, base in bases.items():
        pairs = [
            (key, (value, late[base, *key[1:]]))
            for key, value in late.items()
            if key[0] == method and (base, *key[1:]) in late
        ]
        if not pairs:
            continue
        counts = []
        for at, wanted in [(2, ratio) for ratio in ratios] + [(1, letter) for letter in letters]:
            cell = [pair for key, pair in pairs if key[at] == wanted]
            wins, losses = sum(ours < other for ours, other in cell), sum(ours > other for ours, other in cell)
            p = binomtest(wins, wins + losses, alternative="greater").pvalue if wins + losses else 1.0
            counts.append(f"{wins} / {losses}" + (f", p = {p:.2g}" if at == 1 else ""))
        change = {}
        for letter in letters:
            for ratio in ratios:
                cell = np.array([pair for key, pair in pairs if key[1:3] == (letter, ratio)])
                ours, other = cell.mean(axis=0) if len(cell) else (np.nan, np.nan)
                if np.isfinite(other):
                    change[f"{letter} at {ratio:g}"] = ours / other - 1
        worse = [f"{name} {100 * part:+.0f} %" for name, part in change.items() if part > 0]
        text = f"{len(worse)} of {len(change)}" + (f": {', '.join(worse)}" if worse else "")
        rows.append([label_of(method), label_of(base), *counts, text])
    title = ["method", "against", *(f"at {ratio:g}" for ratio in ratios), *letters, "cells where its mean is worse"]
    return markdown(title, rows)


def reached_table(trials: Iterable[Trial], table: str, margin_cm: float) -> str:
    """How many runs end within a margin of the best that a cable at rest can do, by scenario.

    A run ends where the mean of its last ten seconds is; `Trial.reachable_cm` is the best.

    Raises:
        ValueError: there is no trial of this table.
    """
    mine, rows = trials_of_table(trials, table), []
    for method in methods_of(mine):
        of_method = [trial for trial in mine if trial.method == method]
        scenarios = sorted({trial.scenario for trial in of_method})
        for scenario in [*scenarios, "all"] if len(scenarios) > 1 else scenarios:
            cell = of_method if scenario == "all" else of_scenario(of_method, scenario)
            over = np.array([late_error(trial) - trial.reachable_cm for trial in cell])
            reached = int((over <= margin_cm).sum())
            between = "linear" if np.isfinite(over).all() else "higher"
            rows.append(
                [
                    label_of(method), scenario, f"{reached}/{len(cell)}", _rate_text(reached, len(cell)),
                    number_text(float(np.median(over))), number_text(float(np.quantile(over, 0.9, method=between))),
                    str(sum(trial.stopped is not None for trial in cell)),
                ]
            )  # fmt: skip
    head = [
        "method", "task", f"within {10 * margin_cm:g} mm", "95 % interval", "median over the best [cm]", "90 %",
        "stopped",
    ]  # fmt: skip
    return markdown(head, rows)


def success_table(trials: Iterable[Trial]) -> str:
    """How often a random target was reached from a random start, compared with Liang et al.

    A success is an error below 10 mm at the end of the run. That is stricter than below 10 mm at some time within the
    run, which has a column of its own.

    Raises:
        ValueError: there is no trial of this table.
    """
    mine = trials_of_table(trials, LIANG_TABLE)
    rows = []
    for method in methods_of(mine):
        of_method = [trial for trial in mine if trial.method == method]
        for scenario in sorted({trial.scenario for trial in of_method}, reverse=True):
            cell = of_scenario(of_method, scenario)
            reached = [trial for trial in cell if trial.terminal_error_cm < SUCCESS_CM]
            once = sum(trial.best_error_cm < SUCCESS_CM for trial in cell)
            every = summarise([10 * trial.terminal_error_cm for trial in cell])
            lost = f" ({every.failures} lost)" if every.failures else ""
            rows.append(
                [
                    label_of(method), scenario, f"{len(reached)}/{len(cell)}",
                    _rate_text(len(reached), len(cell)), f"{once}/{len(cell)}",
                    number_text(summarise([10 * t.terminal_error_cm for t in reached]).mean if reached else np.nan),
                    f"{number_text(every.mean)}{lost}", number_text(every.median),
                    str(max(trial.steps for trial in cell)),
                ]
            )  # fmt: skip
    for entry in LIANG:
        rows.append(
            [
                f"*{entry.label}*", f"*{entry.scenario}*", f"*{entry.successes}/{entry.trials}*",
                f"*{_rate_text(entry.successes, entry.trials)}*", "", "",
                "" if entry.error_mm is None else f"*{entry.error_mm}*", "", "*250*",
            ]
        )  # fmt: skip
    title = [
        "method", "start", "success", "95 % interval", "below 10 mm at some time", "mean error of successes [mm]",
        "mean error of all [mm]", "median [mm]", "steps at most",
    ]  # fmt: skip
    return markdown(title, rows)


def end_table(trials: Iterable[Trial], table: str) -> str:
    """How runs end: the error over the last `LATE` seconds, whether it still moves, and what the grippers still do.

    Raises:
        ValueError: there is no trial of this table.
    """
    mine = trials_of_table(trials, table)
    rows = []
    for method in methods_of(mine):
        for scenario in scenarios_of(mine):
            cell = of_scenario([trial for trial in mine if trial.method == method], scenario)
            if not cell:
                continue
            late = [trial.late_errors_cm for trial in cell]
            swing = 10 * np.array([np.ptp(errors) for errors in late])
            travel = [trial.late_travel_m for trial in cell]
            rows.append(
                [
                    label_of(method), scenario, str(len(cell)),
                    number_text(float(np.mean([late_error(trial) for trial in cell]))),
                    number_text(float(np.max(np.nan_to_num(late, nan=np.inf)))),
                    number_text(float(np.median(swing))), f"{np.sum(swing <= RESTING_MM)}/{len(cell)}",
                    f"{sum(trial.worse_than_best for trial in cell)}/{len(cell)}",
                    number_text(100 * float(np.mean(travel))) if np.isfinite(travel).all() else "",
                ]
            )  # fmt: skip
    title = [
        "method", "scenario", "trials", f"mean of the last {LATE} s [cm]", "worst [cm]", "median swing [mm]",
        f"swing of at most {RESTING_MM} mm", "50 % above own best", "travel of the grippers there [cm]",
    ]  # fmt: skip
    return markdown(title, rows)


def nearby_table(trials: Iterable[Trial], table: str) -> str:
    """Best, median and worst of runs that differ by next to nothing, in the mean of the last `LATE` seconds.

    Raises:
        ValueError: there is no trial of this table.
    """
    mine, rows = trials_of_table(trials, table), []
    for method in methods_of(mine):
        late = [late_error(trial) for trial in mine if trial.method == method]
        numbers = min(late), float(np.median(late)), max(late), max(late) / min(late)
        rows.append([label_of(method), str(len(late)), *map(number_text, numbers)])
    return markdown(["method", "plants", "best [cm]", "median [cm]", "worst [cm]", "worst over best"], rows)


def late_error(trial: Trial) -> float:
    """Mean error of the last `LATE` seconds [cm]; infinite where the cable was lost."""
    error = float(trial.late_errors_cm.mean())
    return error if np.isfinite(error) else np.inf


def _seed_interval(cell: Sequence[Trial]) -> Interval:
    """Interval of the mean of the trials that did not fail, by the seeds' means."""
    by_seed: dict[int, list[float]] = {}
    for trial in cell:
        if np.isfinite(value := trial.terminal_error_cm):
            by_seed.setdefault(trial.seed, []).append(value)
    means = [float(np.mean(values)) for values in by_seed.values()]
    return mean_interval(means) if means else Interval(np.nan, np.nan)


def _rate_text(successes: int, trials: int) -> str:
    """Exact (Clopper-Pearson) 95 % interval of a success probability."""
    interval = binomtest(successes, trials).proportion_ci()
    return interval_text(Interval(interval.low, interval.high))
