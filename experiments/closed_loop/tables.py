"""Trials as Markdown tables in the layout of Wang et al., RA-L 2022, next to the paper's own figures.

No table drops a trial: a cell that holds failures says so after its mean, and every table's first column says over how
many trials each method was run.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import cast

from closed_loop.cells import (
    MEASURES,
    UNIT,
    cell_text,
    failing_text,
    label_of,
    markdown,
    methods_of,
    of_scenario,
    scenarios_of,
    spread_text,
    trial_count,
    trials_of_table,
)
from closed_loop.methods import LEARNERS, METHODS
from closed_loop.paper import PAPER, PaperTable, best_in_paper
from closed_loop.trials import Trial

STEP_BANDS = (0.05, 0.02)
"""Bands of the settling time of a step response, as fractions of the way that the error went."""


def methods_table(trials: Sequence[Trial]) -> str:
    """The model of every method of these trials, and what corrects it online."""
    rows = []
    for spec in (METHODS[method] for method in methods_of(trials)):
        model = "none" if spec.weights is None else f"`{spec.weights}`"
        rows.append(
            [label_of(spec.name), model + ", fine-tuned on this cable" * spec.fine_tuned, LEARNERS[spec.learner]]
        )
    return markdown(["method", "model", "corrected online by"], rows).rstrip()


def comparison_table(trials: Iterable[Trial], table: str) -> str:
    """Terminal error and settling time as mean ± standard deviation over all stiffnesses and seeds.

    One row per method, under it the paper's row where it has one, and at the end the paper's best of each column.

    Args:
        trials: of any table; only those of `table` count.
        table: "III", "IV", "V", or another name, which then has no published rows.

    Raises:
        ValueError: there is no trial of this table.
    """
    mine = trials_of_table(trials, table)
    scenarios = scenarios_of(mine)
    published = PAPER.get(cast(PaperTable, table), {})
    rows = []
    for method in methods_of(mine):
        of_method = [trial for trial in mine if trial.method == method]
        rows.append([label_of(method), trial_count(of_method)])
        rows[-1] += [cell_text(of_scenario(of_method, s), measure) for s in scenarios for measure in MEASURES]
        if method in published:
            rows.append(["*in the paper*", "*5*"])
            for scenario in scenarios:
                cell = published[method].get(scenario)
                rows[-1] += ["" if cell is None else f"*{spread_text(*getattr(cell, m))}*" for m in MEASURES]
    if published:
        rows.append(["*best in the paper*", ""])
        known = {scenario for row in published.values() for scenario in row}
        rows[-1] += [
            f"*{best_in_paper(cast(PaperTable, table), s, m):.2f}*" if s in known else ""
            for s in scenarios
            for m in MEASURES
        ]
    return markdown(["method", "trials", *(f"{s}: {UNIT[m]}" for s in scenarios for m in MEASURES)], rows)


def stiffness_table(trials: Iterable[Trial], table: str) -> str:
    """As `comparison_table`, one row for each method and stiffness.

    Raises:
        ValueError: there is no trial of this table.
    """
    mine = trials_of_table(trials, table)
    scenarios = scenarios_of(mine)
    rows = []
    for method in methods_of(mine):
        for stiffness in sorted({trial.stiffness for trial in mine if trial.method == method}):
            cell = [trial for trial in mine if trial.method == method and trial.stiffness == stiffness]
            rows.append([label_of(method), f"{stiffness:g}", trial_count(cell)])
            rows[-1] += [cell_text(of_scenario(cell, s), measure) for s in scenarios for measure in MEASURES]
    return markdown(["method", "stiffness", "trials", *(f"{s}: {UNIT[m]}" for s in scenarios for m in MEASURES)], rows)


def settling_table(trials: Iterable[Trial], table: str) -> str:
    """Settling times by the textbook's two bands, next to the stricter one of the other tables and the paper's own.

    Raises:
        ValueError: there is no trial of this table.
    """
    mine = trials_of_table(trials, table)
    published = PAPER.get(cast(PaperTable, table), {})
    rows = []
    for method in methods_of(mine):
        for scenario in scenarios_of(mine):
            cell = of_scenario([trial for trial in mine if trial.method == method], scenario)
            if not cell:
                continue
            paper = published.get(method, {}).get(scenario)
            rows.append(
                [
                    label_of(method), scenario, str(len(cell)), cell_text(cell, "settling"),
                    *(failing_text([t.step_settling_time_s(band) for t in cell], "settling") for band in STEP_BANDS),
                    "" if paper is None else spread_text(*paper.settling),
                ]
            )  # fmt: skip
    bands = [f"within {100 * band:g} % of the way [s]" for band in STEP_BANDS]
    return markdown(["method", "scenario", "trials", "strict [s]", *bands, "in the paper [s]"], rows)
