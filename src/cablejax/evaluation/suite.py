"""Many trials, one after the other, resumable: every case by every method, each appended to a file once it is done."""

from __future__ import annotations

import dataclasses
import functools
import pathlib
import time
from collections.abc import Callable, Sequence

from tqdm import tqdm

from cablejax.control.loop import run_closed_loop
from cablejax.control.run import ClosedLoopRun
from cablejax.control.shaping import Model, load_model
from cablejax.evaluation.failures import Snapshot, append_snapshot, read_snapshots, snapshot_of
from cablejax.evaluation.methods import MethodSpec, controller_of
from cablejax.evaluation.protocols import GuessingCable, LaidOut, Task
from cablejax.evaluation.trials import Trial, TrialKey, append_trial, read_trials, trial_of

PATIENCE = 12
"""Commands without any change of the error after which a trial ends: nothing more happens."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One cable to be brought from one start to one target, by whatever method.

    Attributes:
        table: for the trial's key, as are `scenario`, `stiffness` and `seed`.
        scenario: see `Trial`.
        stiffness: see `Trial`.
        seed: see `Trial`.
        task: start and target, made when they are needed.
        plant: the cable, made when it is needed.
        cable: name of the physical cable: a fine-tuned model serves all cases of one.
        steps: most commands of a run.
    """

    table: str
    scenario: str
    stiffness: float
    seed: int
    task: Callable[[], Task]
    plant: Callable[[], GuessingCable]
    cable: str
    steps: int


def key_of(case: Case, method: MethodSpec) -> TrialKey:
    """What the trial will be known by."""
    return case.table, method.name, case.scenario, float(case.stiffness), case.seed


def run_case(case: Case, method: MethodSpec, model: Model | None) -> ClosedLoopRun:
    """One trial, without keeping anything."""
    task = case.task()
    plant = LaidOut(case.plant(), task.start_shape)
    controller = controller_of(method, model, task.target)
    return run_closed_loop(
        plant, controller, task.target, case.steps, start=task.start_pose, record_hz=1.0, patience=PATIENCE
    )


def run_suite(
    cases: Sequence[Case],
    methods: Sequence[MethodSpec],
    folder: pathlib.Path,
    *,
    fine_tuned: Callable[[Case], Model],
    process: tuple[int, int] = (0, 1),
    progress: bool = True,
) -> None:
    """Runs what the folder does not have yet. Seeds go first, so that an unfinished suite is balanced.

    Args:
        cases: of any tables.
        methods: each is tried on every case.
        folder: receives `trials-P.jsonl` and `snapshots-P.jsonl`; read them with `read_suite`.
        fine_tuned: the model that was trained on a case's cable.
        process: (index P, count): this process runs every `count`-th trial; each has files of its own.
        progress: show a bar with the time left.
    """
    index, count = process
    wanted = [(case, method) for case in sorted(cases, key=lambda case: case.seed) for method in methods]
    done = {trial.key for trial in read_suite(folder)[0]}
    mine = [(c, m) for c, m in wanted[index::count] if key_of(c, m) not in done]
    with tqdm(total=len(mine), unit="trial", disable=not progress, dynamic_ncols=True) as bar:
        for case, method in mine:
            key = key_of(case, method)
            bar.set_postfix_str(" ".join(map(str, key)))
            model = None
            if method.weights is not None:
                model = fine_tuned(case) if method.fine_tuned else released(method.weights)
            begin = time.perf_counter()
            run = run_case(case, method, model)
            names = dict(zip(("table", "method", "scenario", "stiffness", "seed"), key, strict=True))
            trial = trial_of(run, **names, wall_s=time.perf_counter() - begin)  # pyright: ignore[reportArgumentType]
            append_snapshot(folder / f"snapshots-{index}.jsonl", snapshot_of(run, key))
            append_trial(folder / f"trials-{index}.jsonl", trial)
            bar.update()


@functools.lru_cache(maxsize=8)
def released(name: str) -> Model:
    """A released model, loaded once."""
    return load_model(name)


def read_suite(folder: pathlib.Path) -> tuple[list[Trial], list[Snapshot]]:
    """All trials in a suite's folder, and their pictures."""
    trials = {t.key: t for path in sorted(folder.glob("trials-*.jsonl")) for t in read_trials(path)}
    pictures = {s.key: s for path in sorted(folder.glob("snapshots-*.jsonl")) for s in read_snapshots(path)}
    return list(trials.values()), [pictures[key] for key in trials if key in pictures]
