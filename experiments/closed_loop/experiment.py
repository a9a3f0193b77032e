"""The command line of the experiments on closed loops: runs missing trials, then writes the page."""

from __future__ import annotations

import argparse
import dataclasses
import functools
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

import executors
from cablejax.control.shaping import Model
from cablejax.dynamics.weights import FILE_NAME
from cablejax.mpc import MPCConfig
from closed_loop import interval_tables, tables
from closed_loop.cases import NEARBY, NEARBY_RATIOS
from closed_loop.cells import label_of
from closed_loop.failures import failure_figure, worst
from closed_loop.fine_tuning import FineTuneConfig, fine_tune, record
from closed_loop.harder import MARGIN_CM
from closed_loop.methods import METHODS, NO_PRIOR_LEARNER, WITHOUT_LEARNING, model_named
from closed_loop.protocols import least_time
from closed_loop.suite import TRIALS, Case, read_suite, run_suite
from closed_loop.trials import LATE, LIANG_TABLE, Trial
from pages import page_of_results, publish
from rows import made_on

WORST = 10
"""Runs shown as pictures: the ones that ended farthest off."""

SETTLING_NOTE = (
    "The settling time of a step response is the time after which the error stays within 5 or 2 % of its total change; "
    "the strict one, in all other tables here, uses a tenth of the terminal error, or of the total change if that is "
    "smaller, and at least 1 mm. The paper does not define its settling time."
)


@dataclasses.dataclass(frozen=True)
class Extent:
    """How much of an experiment is run.

    Attributes:
        cases: makes those of some seeds.
        seeds: unless the command line names others.
        methods: their names, likewise.
    """

    cases: Callable[[Sequence[int]], list[Case]]
    seeds: Sequence[int]
    methods: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Experiment:
    """What one script of `experiments/` measures.

    Attributes:
        name: of its default folder under runs/.
        script: its file in experiments/.
        title: of its page.
        about: what was done, in a few sentences, for the page.
        small: the short version.
        full: the whole table.
        tables: tables that the cases belong to, in the page's order.
    """

    name: str
    script: str
    title: str
    about: str
    small: Extent
    full: Extent
    tables: tuple[str, ...]


def main(experiment: Experiment, arguments: Sequence[str] | None = None) -> None:
    """Runs what is missing of an experiment and prints its page."""
    parser = argparse.ArgumentParser(description=experiment.about)
    parser.add_argument("--full", action="store_true", help="the whole table instead of the small version")
    parser.add_argument("--out", type=pathlib.Path, help="folder of the trials; an interrupted run resumes")
    parser.add_argument("--methods", nargs="*", choices=tuple(METHODS), help="run only these methods")
    parser.add_argument("--seeds", type=seed_range, metavar="FIRST:END", help="seeds to run instead of the table's own")
    executors.add_option(parser)
    parser.add_argument("--report", type=pathlib.Path, help="write the page of the finished rows, and run nothing")
    options = parser.parse_args(arguments)
    extent = experiment.full if options.full else experiment.small
    seeds = options.seeds or extent.seeds
    folder = options.out or pathlib.Path("runs") / (experiment.name if options.full else f"{experiment.name}-small")
    if options.report is None:
        with executors.executor_of(options.executor) as executor:
            run_suite(
                extent.cases(seeds),
                [METHODS[name] for name in options.methods or extent.methods],
                folder,
                fine_tuned=functools.partial(fine_tuned_model, (folder / "fine-tuned").absolute()),
                executor=executor,
            )
    everything, pictures = read_suite(folder)
    trials = [trial for trial in everything if trial.seed in seeds]
    if options.report is not None and not trials:
        parser.error(
            f"{folder / TRIALS} has no trial of these seeds: copy docs/results/trials/{experiment.name}.jsonl there, "
            "or run them first, without --report"
        )
    shown = {trial.key for trial in trials}
    picture = None
    if options.report is not None:
        picture = options.report.with_name(f"{options.report.stem}_worst.png")
        # trials that are kept without their snapshots leave the figure as it is
        if snapshots := [snapshot for snapshot in pictures if snapshot.key in shown]:
            failure_figure(worst(snapshots, WORST)).savefig(picture, dpi=110, bbox_inches="tight")
    name = picture.name if picture is not None and picture.exists() else None
    made = made_on(folder / TRIALS, by=lambda row: label_of(row["method"]))
    publish(page(experiment, trials, command(experiment, options), made, picture=name), options.report)


def seed_range(text: str) -> range:
    """`"100:150"` = seeds 100 to 149; `"7"` = seed 7 alone."""
    first, _, end = text.partition(":")
    seeds = range(int(first), int(end) if end else int(first) + 1)
    if not seeds:
        raise argparse.ArgumentTypeError(f"{text!r} holds no seed; FIRST:END has END above FIRST, such as 100:150")
    return seeds


def fine_tuned_model(folder: pathlib.Path, case: Case) -> Model:
    """The model trained on a case's cable, made when it is first asked for."""
    config, home = FineTuneConfig(), folder / case.cable
    if not (home / FILE_NAME).is_file():
        plant: Any = case.plant()
        fine_tune(record(plant, plant.config.cable, config, home / "recording.npz"), config, home)
    return model_named(str(home))


def page(experiment: Experiment, trials: Sequence[Trial], command: str, made: str, picture: str | None) -> str:
    """The Markdown page of an experiment's trials."""
    lines = [experiment.about, "", tables.methods_table(trials)]
    for table in experiment.tables:
        mine = [trial for trial in trials if trial.table == table]
        if not mine:
            continue
        if table == NEARBY:
            ratios = f"{NEARBY_RATIOS[0]:g} to {NEARBY_RATIOS[-1]:g} times as stiff as the reference cable"
            about = f"Z from one start, {ratios}; mean error of the last {LATE} s."
            lines += ["", "## Ten plants next to one another", "", about, ""]
            lines += [interval_tables.nearby_table(mine, table)]
            continue
        lines += ["", f"## Table {table}", "", f"Seeds: {seeds_text({trial.seed for trial in mine})}.", ""]
        if table == LIANG_TABLE:
            lines += [interval_tables.success_table(mine)]
            continue
        if table in MARGIN_CM:
            lines += [interval_tables.reached_table(mine, table, MARGIN_CM[table])]
            continue
        lines += [tables.comparison_table(mine, table)]
        least = least_times(experiment, {trial.key[:1] + trial.key[2:] for trial in mine})
        lines += ["", "### Settling time by other definitions", "", f"{SETTLING_NOTE} {least}"]
        lines += ["", tables.settling_table(mine, table)]
        lines += ["", "### By stiffness", "", tables.stiffness_table(mine, table)]
        lines += ["", "### How runs end", "", interval_tables.end_table(mine, table)]
        lines += ["", "### Intervals and failures", "", interval_tables.INTERVAL_NOTE]
        lines += ["", interval_tables.interval_table(mine, table)]
        methods = {trial.method for trial in mine}
        if any({learning, base} <= methods for learning, base in WITHOUT_LEARNING.items()):
            lines += [
                "",
                "### What learning online changes",
                "",
                f"Wins / losses in pairs, by means of the last {LATE} s; p is of the one-sided sign test, as if pairs "
                "were independent, although those of one seed share their start.",
            ]
            lines += ["", interval_tables.learning_table(mine, table, WITHOUT_LEARNING)]
        if NO_PRIOR_LEARNER in methods and len(methods) > 1:
            lines += ["", "### In pairs", "", interval_tables.paired_table(mine, table, NO_PRIOR_LEARNER)]
    if picture is not None:
        lines += ["", "## The runs that ended farthest off", "", f"![start, end and target of each]({picture})"]
    return page_of_results(experiment.title, f"`{command}`", lines, made_on=made)


def seeds_text(seeds: set[int]) -> str:
    """All seeds; more than ten in a row by the first and the last."""
    first, last = min(seeds), max(seeds)
    whole = len(seeds) > 10 and len(seeds) == last - first + 1
    return f"{first} to {last}" if whole else ", ".join(map(str, sorted(seeds)))


def least_times(experiment: Experiment, shown: set[tuple[str, str, float, int]]) -> str:
    """How long the grippers' way alone takes, in a sentence. `shown`: (table, scenario, stiffness, seed) of cases."""
    config, seconds = MPCConfig(), {}
    for case in experiment.full.cases(sorted({seed for *_, seed in shown})):
        if (case.table, case.scenario, float(case.stiffness), case.seed) in shown:
            seconds.setdefault(case.scenario, []).append(least_time(case.task(), config))
    means = ", ".join(f"{scenario} {np.mean(values):.1f} s" for scenario, values in sorted(seconds.items()))
    return (
        f"Straight and at the motion bound ({100 * config.radius_max:g} cm per command; a radian counts as "
        f"{100 * config.objective.rotation_weight:g} cm), the grippers need on average {means} from these starts to "
        "the poses that hold the targets' ends."
    )


def command(experiment: Experiment, options: argparse.Namespace) -> str:
    """The call that makes the page."""
    parts = ["python", f"experiments/{experiment.script}"]
    if options.full:
        parts.append("--full")
    if options.seeds is not None:
        parts.append(f"--seeds {options.seeds.start}:{options.seeds.stop}")
    if options.report is not None:
        parts.append(f"--report {options.report}")
    return " ".join(parts)
