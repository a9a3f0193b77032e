"""Many trials, resumable: every case by every method, each appended to a file once it is done."""

from __future__ import annotations

import dataclasses
import functools
import pathlib
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from typing import Any

from cablejax.control.loop import run_closed_loop
from cablejax.control.run import ClosedLoopRun
from cablejax.control.shaping import Model
from closed_loop.failures import Snapshot, append_snapshot, read_snapshots, snapshot_of
from closed_loop.methods import MethodSpec, controller_of, model_named
from closed_loop.protocols import GuessingCable, LaidOut, Task
from closed_loop.trials import KEY, Trial, TrialKey, read_trials, trial_of
from rows import Rows

PATIENCE = 12
"""Commands without any change of the error after which a trial ends: nothing more happens."""
TRIALS, SNAPSHOTS = "trials.jsonl", "snapshots.jsonl"
"""Files of a suite's folder."""


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
        patience: commands without any change of the error after which it ends; None = it goes on.
    """

    table: str
    scenario: str
    stiffness: float
    seed: int
    task: Callable[[], Task]
    plant: Callable[[], GuessingCable]
    cable: str
    steps: int
    patience: int | None = PATIENCE


def key_of(case: Case, method: MethodSpec) -> TrialKey:
    """What the trial will be known by."""
    return case.table, method.name, case.scenario, float(case.stiffness), case.seed


def run_case(case: Case, method: MethodSpec, model: Model | None, task: Task | None = None) -> ClosedLoopRun:
    """One trial, without keeping anything; `task` if it was made already."""
    task = case.task() if task is None else task
    plant = LaidOut(case.plant(), task.start_shape)
    controller = controller_of(method, model, task.target)
    return run_closed_loop(
        plant, controller, task.target, case.steps, start=task.start_pose, record_hz=1.0, patience=case.patience
    )


def run_suite(
    cases: Sequence[Case],
    methods: Sequence[MethodSpec],
    folder: pathlib.Path,
    *,
    fine_tuned: Callable[[Case], Model],
    executor: Executor | None = None,
    progress: bool = True,
) -> None:
    """Runs what the folder does not have yet. Seeds go first, so that an unfinished suite is balanced.

    Args:
        cases: of any tables.
        methods: each is tried on every case.
        folder: receives `trials.jsonl` and `snapshots.jsonl`; read them with `read_suite`.
        fine_tuned: the model that was trained on a case's cable; made here before any trial that needs it.
        executor: where trials run; None = here, one after the other.
        progress: show a bar with the time left.
    """
    pairs = [(case, method) for case in sorted(cases, key=lambda case: case.seed) for method in methods]
    wanted = {key_of(case, method): (case, method) for case, method in pairs}

    def keep(made: tuple[Trial, Snapshot]) -> dict[str, Any]:
        append_snapshot(folder / SNAPSHOTS, made[1])
        return dataclasses.asdict(made[0])

    rows = Rows(folder / TRIALS, KEY)
    missing = rows.missing(wanted)
    # two processes must not train the same model
    tuned = {case.cable: case for case, method in (wanted[key] for key in missing) if method.fine_tuned}
    for case in tuned.values():
        fine_tuned(case)
    make = functools.partial(_trial, {key: wanted[key] for key in missing}, fine_tuned)
    rows.run(missing, make, executor=executor, keep=keep, progress=progress)


def _trial(
    wanted: Mapping[tuple, tuple[Case, MethodSpec]], fine_tuned: Callable[[Case], Model], *key: Any
) -> tuple[Trial, Snapshot]:
    """One trial, with its picture."""
    case, method = wanted[key]
    model = None
    if method.weights is not None:
        model = fine_tuned(case) if method.fine_tuned else model_named(method.weights)
    begin, task = time.perf_counter(), case.task()
    finished = run_case(case, method, model, task)
    names = dict(zip(KEY, key, strict=True))
    trial = trial_of(finished, **names, wall_s=time.perf_counter() - begin, reachable_cm=task.reachable_cm)
    return trial, snapshot_of(finished, trial.key)


def read_suite(folder: pathlib.Path) -> tuple[list[Trial], list[Snapshot]]:
    """All trials in a suite's folder, and their pictures."""
    trials = read_trials(folder / TRIALS)
    pictures = {snapshot.key: snapshot for snapshot in read_snapshots(folder / SNAPSHOTS)}
    return trials, [pictures[trial.key] for trial in trials if trial.key in pictures]
