"""Trials as Markdown tables in the layout of Wang et al., RA-L 2022, the paper's own figures beside ours.

No table drops a trial: a cell that holds failures says so after its mean, and every table's first column says over how
many trials each method was run.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import cast, get_args

import numpy as np

from cablejax.evaluation.paper import LIANG, METHOD_LABEL, PAPER, Measure, PaperTable, best_in_paper
from cablejax.evaluation.statistics import (
    Interval,
    bootstrap_interval,
    clopper_pearson,
    paired_difference,
    summarise,
)
from cablejax.evaluation.trials import LIANG_TABLE, Trial

SUCCESS_CM = 1.0
"""Liang et al.: a shape is reached below this root mean square error [cm]."""

STEP_BANDS = (0.05, 0.02)
"""Bands of the settling time of a step response, as fractions of the way that the error went."""

_SHAPES = ("U", "S", "Z")
_MEASURES: tuple[Measure, ...] = get_args(Measure)
_UNIT: dict[Measure, str] = {"terminal": "terminal error [cm]", "settling": "settling time [s]"}
_FAILED: dict[Measure, str] = {"terminal": "lost", "settling": "did not settle"}


def comparison_table(
    trials: Iterable[Trial],
    table: str,
    *,
    methods: Sequence[str] | None = None,
    labels: Mapping[str, str] = METHOD_LABEL,
) -> str:
    """Terminal error and settling time as mean ± standard deviation over all stiffnesses and seeds.

    One row per method, under it the paper's row where it has one, and at the end the paper's best of each column.

    Args:
        trials: of any table; only those of `table` count.
        table: "III", "IV", "V", or another name, which then has no published rows.
        methods: rows and their order; by default the paper's order, then others as they appear.
        labels: names of methods for readers.

    Raises:
        ValueError: there is no trial of this table.
    """
    mine = _of_table(trials, table)
    scenarios = _scenarios(mine)
    published = PAPER.get(cast(PaperTable, table), {})
    rows = []
    for method in _methods(mine, methods):
        of_method = [trial for trial in mine if trial.method == method]
        rows.append([_label(method, labels), _trial_count(of_method)])
        rows[-1] += [_cell(_at(of_method, s), measure) for s in scenarios for measure in _MEASURES]
        if method in published:
            rows.append(["*in the paper*", "*5*"])
            for scenario in scenarios:
                cell = published[method].get(scenario)
                rows[-1] += ["" if cell is None else f"*{_spread(*getattr(cell, m))}*" for m in _MEASURES]
    if published:
        rows.append(["*best in the paper*", ""])
        known = {scenario for row in published.values() for scenario in row}
        rows[-1] += [
            f"*{best_in_paper(cast(PaperTable, table), s, m):.2f}*" if s in known else ""
            for s in scenarios
            for m in _MEASURES
        ]
    return _markdown(["method", "trials", *(f"{s}: {_UNIT[m]}" for s in scenarios for m in _MEASURES)], rows)


def stiffness_table(
    trials: Iterable[Trial],
    table: str,
    *,
    methods: Sequence[str] | None = None,
    labels: Mapping[str, str] = METHOD_LABEL,
) -> str:
    """As `comparison_table`, one row for each method and stiffness.

    Raises:
        ValueError: there is no trial of this table.
    """
    mine = _of_table(trials, table)
    scenarios = _scenarios(mine)
    rows = []
    for method in _methods(mine, methods):
        for stiffness in sorted({trial.stiffness for trial in mine if trial.method == method}):
            cell = [trial for trial in mine if trial.method == method and trial.stiffness == stiffness]
            rows.append([_label(method, labels), f"{stiffness:g}", _trial_count(cell)])
            rows[-1] += [_cell(_at(cell, s), measure) for s in scenarios for measure in _MEASURES]
    return _markdown(
        ["method", "stiffness", "trials", *(f"{s}: {_UNIT[m]}" for s in scenarios for m in _MEASURES)], rows
    )


def interval_table(
    trials: Iterable[Trial],
    table: str,
    measure: Measure = "terminal",
    *,
    methods: Sequence[str] | None = None,
    labels: Mapping[str, str] = METHOD_LABEL,
) -> str:
    """What a mean hides: its 95 % bootstrap interval, the median, the worst trial, and failures.

    The interval resamples seeds, since trials of one seed share their start.

    Raises:
        ValueError: there is no trial of this table.
    """
    mine = _of_table(trials, table)
    rows = []
    for method in _methods(mine, methods):
        for scenario in _scenarios(mine):
            cell = _at([trial for trial in mine if trial.method == method], scenario)
            if not cell:
                continue
            summary = summarise([_value(trial, measure) for trial in cell])
            rows.append(
                [
                    _label(method, labels), scenario, str(summary.count), str(summary.failures),
                    str(sum(trial.stopped is not None for trial in cell)), _number(summary.mean),
                    _interval(_seed_interval(cell, measure)), _number(summary.median), _number(summary.worst),
                ]
            )  # fmt: skip
    title = [
        "method", "scenario", "trials", _FAILED[measure], "stopped early", f"mean {_UNIT[measure]}", "95 % interval",
        "median", "worst",
    ]  # fmt: skip
    return _markdown(title, rows)


def settling_table(
    trials: Iterable[Trial],
    table: str,
    *,
    methods: Sequence[str] | None = None,
    labels: Mapping[str, str] = METHOD_LABEL,
) -> str:
    """Settling times by the textbook's two bands, beside the stricter one of the other tables and the paper's own.

    Raises:
        ValueError: there is no trial of this table.
    """
    mine = _of_table(trials, table)
    published = PAPER.get(cast(PaperTable, table), {})
    rows = []
    for method in _methods(mine, methods):
        for scenario in _scenarios(mine):
            cell = _at([trial for trial in mine if trial.method == method], scenario)
            if not cell:
                continue
            paper = published.get(method, {}).get(scenario)
            rows.append(
                [
                    _label(method, labels), scenario, str(len(cell)), _cell(cell, "settling"),
                    *(_failing_cell([t.step_settling_time_s(band) for t in cell], "settling") for band in STEP_BANDS),
                    "" if paper is None else _spread(*paper.settling),
                ]
            )  # fmt: skip
    bands = [f"within {100 * band:g} % of the way [s]" for band in STEP_BANDS]
    return _markdown(["method", "scenario", "trials", "strict [s]", *bands, "in the paper [s]"], rows)


def paired_table(
    trials: Iterable[Trial],
    table: str,
    reference: str,
    measure: Measure = "terminal",
    *,
    methods: Sequence[str] | None = None,
    labels: Mapping[str, str] = METHOD_LABEL,
) -> str:
    """Every method against `reference` in the same trials (stiffness and seed): negative = lower than the reference.

    Raises:
        ValueError: there is no trial of this table, or none by the reference.
    """
    mine = _of_table(trials, table)
    if all(trial.method != reference for trial in mine):
        raise ValueError(f"Table {table} has no trial of {reference!r}, only of {sorted({t.method for t in mine})}.")

    def values(method: str, scenario: str) -> dict[tuple[float, int], float]:
        cell = _at([trial for trial in mine if trial.method == method], scenario)
        return {(trial.stiffness, trial.seed): _value(trial, measure) for trial in cell}

    rows = []
    for method in _methods(mine, methods):
        for scenario in _scenarios(mine):
            if method == reference or not (ours := values(method, scenario)):
                continue
            result = paired_difference(ours, values(reference, scenario), cluster=lambda key: key[1])
            rows.append(
                [
                    _label(method, labels), scenario, str(result.pairs), str(result.unpaired), str(result.failures),
                    f"{result.mean:+.3f}" if np.isfinite(result.mean) else "none", _interval(result.interval, "+.3f"),
                    f"{result.better} / {result.worse}",
                ]
            )  # fmt: skip
    title = [
        f"against {_label(reference, labels)}", "scenario", "pairs", "unpaired", "pairs with a failure",
        f"difference of {_UNIT[measure]}", "95 % interval", "better / worse",
    ]  # fmt: skip
    return _markdown(title, rows)


def success_table(
    trials: Iterable[Trial],
    *,
    table: str = LIANG_TABLE,
    methods: Sequence[str] | None = None,
    labels: Mapping[str, str] = METHOD_LABEL,
) -> str:
    """How often a random target was reached from a random start, beside what Liang et al. published.

    A success is an error below 10 mm at the end of the run. That is stricter than below 10 mm at some time within the
    run, which has a column of its own.

    Raises:
        ValueError: there is no trial of this table.
    """
    mine = _of_table(trials, table)
    rows = []
    for method in _methods(mine, methods):
        of_method = [trial for trial in mine if trial.method == method]
        for scenario in sorted({trial.scenario for trial in of_method}, reverse=True):
            cell = _at(of_method, scenario)
            reached = [trial for trial in cell if trial.terminal_error_cm < SUCCESS_CM]
            once = sum(trial.best_error_cm < SUCCESS_CM for trial in cell)
            every = summarise([10 * trial.terminal_error_cm for trial in cell])
            lost = f" ({every.failures} lost)" if every.failures else ""
            rows.append(
                [
                    _label(method, labels), scenario, f"{len(reached)}/{len(cell)}",
                    _interval(clopper_pearson(len(reached), len(cell))), f"{once}/{len(cell)}",
                    _number(summarise([10 * t.terminal_error_cm for t in reached]).mean if reached else np.nan),
                    f"{_number(every.mean)}{lost}", _number(every.median), str(max(trial.steps for trial in cell)),
                ]
            )  # fmt: skip
    for entry in LIANG:
        rows.append(
            [
                f"*{entry.label}*", f"*{entry.scenario}*", f"*{entry.successes}/{entry.trials}*",
                f"*{_interval(clopper_pearson(entry.successes, entry.trials))}*", "", "",
                "" if entry.error_mm is None else f"*{entry.error_mm}*", "", "*250*",
            ]
        )  # fmt: skip
    title = [
        "method", "start", "success", "95 % interval", "below 10 mm at some time", "mean error of successes [mm]",
        "mean error of all [mm]", "median [mm]", "steps at most",
    ]  # fmt: skip
    return _markdown(title, rows)


def _of_table(trials: Iterable[Trial], table: str) -> list[Trial]:
    trials = list(trials)
    mine = [trial for trial in trials if trial.table == table]
    if not mine:
        raise ValueError(f"No trial of table {table!r}, only of {sorted({trial.table for trial in trials})}.")
    return mine


def _scenarios(trials: Sequence[Trial]) -> list[str]:
    """The letters in the paper's order, then the others as they appear."""
    present = dict.fromkeys(trial.scenario for trial in trials)
    return [s for s in _SHAPES if s in present] + [s for s in present if s not in _SHAPES]


def _methods(trials: Sequence[Trial], chosen: Sequence[str] | None) -> list[str]:
    present = dict.fromkeys(trial.method for trial in trials)
    order = [*METHOD_LABEL, *(m for m in present if m not in METHOD_LABEL)] if chosen is None else chosen
    return [method for method in order if method in present]


def _at(trials: Iterable[Trial], scenario: str) -> list[Trial]:
    return [trial for trial in trials if trial.scenario == scenario]


def _value(trial: Trial, measure: Measure) -> float:
    return trial.terminal_error_cm if measure == "terminal" else trial.settling_time_s


def _seed_interval(cell: Sequence[Trial], measure: Measure) -> Interval:
    """Bootstrap interval of the mean of the trials that did not fail, seeds resampled."""
    by_seed: dict[int, list[float]] = {}
    for trial in cell:
        if np.isfinite(value := _value(trial, measure)):
            by_seed.setdefault(trial.seed, []).append(value)
    means = [float(np.mean(values)) for values in by_seed.values()]
    return bootstrap_interval(means) if means else Interval(np.nan, np.nan)


def _cell(trials: Sequence[Trial], measure: Measure) -> str:
    return _failing_cell([_value(trial, measure) for trial in trials], measure) if trials else ""


def _failing_cell(values: Sequence[float], measure: Measure) -> str:
    """Mean ± standard deviation, and how many failed."""
    summary = summarise(values)
    spread = _spread(summary.mean, summary.std) if summary.failures < summary.count else "none"
    if not summary.failures:
        return spread
    return f"{spread} ({summary.failures} of {summary.count} {_FAILED[measure]})"


def _spread(mean: float, std: float) -> str:
    return f"{mean:.2f} ± {std:.2f}"


def _number(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else ("failed" if np.isinf(value) else "none")


def _interval(interval: Interval, form: str = ".2f") -> str:
    return f"{interval.low:{form}} to {interval.high:{form}}" if np.isfinite(interval.low) else "none"


def _trial_count(trials: Sequence[Trial]) -> str:
    """Trials per scenario: one number, or the least and the most."""
    counts = {sum(trial.scenario == s for trial in trials) for s in {trial.scenario for trial in trials}}
    return str(counts.pop()) if len(counts) == 1 else f"{min(counts)} to {max(counts)}"


def _label(method: str, labels: Mapping[str, str]) -> str:
    return labels.get(method, method)


def _markdown(title: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [title, ["---", *("---:" for _ in title[1:])], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"
