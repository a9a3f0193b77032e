"""One closed-loop run as a row of the evaluation, and a file of such rows that survives being killed.

The file has one JSON object per line. A line is written by one call and flushed to the disk before the next trial
starts, so that a run that was killed loses at most the trial it was in: what is left of a torn last line is cut off by
the next writer and ignored by readers. Infinity and NaN, which JSON has no numbers for, are the strings "inf", "nan".
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import pathlib
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from cablejax.control.run import settling_time, step_settling_time

if TYPE_CHECKING:
    from cablejax.control.batched import BatchRun
    from cablejax.control.run import ClosedLoopRun

TrialKey = tuple[str, str, str, float, int]
"""(table, method, scenario, stiffness, seed): what makes a trial the one it is."""

LIANG_TABLE = "Liang"
"""Name of the table of random starts to random targets; its scenarios are "straight" and "diverse"."""


@dataclasses.dataclass(frozen=True)
class Trial:
    """One run of one method, a command every second.

    Attributes:
        table: "III", "IV" or "V" for the paper's tables, `LIANG_TABLE`, or any other name.
        method: what shaped the cable; the paper's are named in `paper.METHOD_LABEL`.
        scenario: the target's name, or for Liang's protocol the kind of start.
        stiffness: the plant's bending stiffness over the nominal one.
        seed: of everything random in the trial; methods are compared at equal seeds.
        errors_cm: root mean square distance to the target before the first command and after each [cm]; NaN where the
            cable was lost.
        stopped: why the run ended early, or None.
        mpc_ms_median: median wall time of a control call [ms].
        wall_s: wall time of the whole trial [s].
    """

    table: str
    method: str
    scenario: str
    stiffness: float
    seed: int
    errors_cm: tuple[float, ...]
    stopped: str | None
    mpc_ms_median: float
    wall_s: float

    @property
    def key(self) -> TrialKey:
        """What makes the trial the one it is."""
        return self.table, self.method, self.scenario, float(self.stiffness), self.seed

    @property
    def terminal_error_cm(self) -> float:
        """Error at the end [cm]; NaN where the cable was lost."""
        return self.errors_cm[-1]

    @property
    def best_error_cm(self) -> float:
        """The lowest error on the way [cm]."""
        return min((error for error in self.errors_cm if math.isfinite(error)), default=math.nan)

    @property
    def steps(self) -> int:
        """Commands carried out."""
        return len(self.errors_cm) - 1

    @property
    def settling_time_s(self) -> float:
        """See `control.run.settling_time` [s]; infinite if the run never settled."""
        return settling_time(*self._course)

    def step_settling_time_s(self, fraction: float) -> float:
        """See `control.run.step_settling_time` [s]; likewise."""
        return step_settling_time(*self._course, fraction)

    @property
    def _course(self) -> tuple[np.ndarray, np.ndarray]:
        return np.arange(len(self.errors_cm), dtype=float), np.array(self.errors_cm)


def trial_of(
    run: ClosedLoopRun, *, table: str, method: str, scenario: str, stiffness: float, seed: int, wall_s: float
) -> Trial:
    """The row of one finished run."""
    timed = run.mpc_ms[np.isfinite(run.mpc_ms)]
    return Trial(
        table=table,
        method=method,
        scenario=scenario,
        stiffness=float(stiffness),
        seed=int(seed),
        errors_cm=tuple(map(float, run.error_cm)),
        stopped=run.stopped,
        mpc_ms_median=float(np.median(timed)) if len(timed) else math.nan,
        wall_s=float(wall_s),
    )


def trials_of_batch(
    run: BatchRun,
    *,
    table: str,
    method: str,
    scenarios: Sequence[str],
    stiffnesses: Sequence[float],
    seeds: Sequence[int],
    wall_s: float,
) -> list[Trial]:
    """The rows of a batch of runs; each gets its share of the wall time, and there is no time of a control call."""
    errors = np.asarray(run.error_cm, float)
    return [
        Trial(
            table=table,
            method=method,
            scenario=scenario,
            stiffness=float(stiffness),
            seed=int(seed),
            errors_cm=tuple(map(float, error)),
            stopped=None,
            mpc_ms_median=math.nan,
            wall_s=wall_s / len(errors),
        )
        for error, scenario, stiffness, seed in zip(errors, scenarios, stiffnesses, seeds, strict=True)
    ]


def append_trial(path: str | os.PathLike[str], trial: Trial) -> None:
    """Adds a trial to a file of trials, which is made if need be; on return it is on the disk. One writer at a time."""
    append_line(path, dataclasses.asdict(trial))


def read_trials(path: str | os.PathLike[str]) -> list[Trial]:
    """The trials in a file, in the order of their first appearance; of two with the same key the later one counts.

    A file that does not exist holds none. A torn last line is left out.

    Raises:
        ValueError: a line is not a trial.
    """
    trials: dict[TrialKey, Trial] = {}
    for number, fields in read_lines(path):
        trial = _parsed(fields, f"{os.fspath(path)}, line {number}")
        trials[trial.key] = trial
    return list(trials.values())


def finished_keys(trials: Iterable[Trial]) -> set[TrialKey]:
    """Keys of trials that need not be run again."""
    return {trial.key for trial in trials}


def append_line(path: str | os.PathLike[str], fields: Mapping[str, Any]) -> None:
    """Adds one JSON object to a file of lines, whole; cuts off first what a killed writer left of its last line."""
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    line = json.dumps(_encoded(dict(fields)), allow_nan=False) + "\n"
    with open(path, "a+b", buffering=0) as file:
        end = file.seek(0, os.SEEK_END)
        file.seek(max(end - 1, 0))
        if end and file.read(1) != b"\n":
            file.seek(0)
            file.truncate(file.read().rfind(b"\n") + 1)
        file.write(line.encode())
        os.fsync(file.fileno())


def read_lines(path: str | os.PathLike[str]) -> list[tuple[int, dict[str, Any]]]:
    """The JSON objects in a file of lines with their line numbers; none if there is no file.

    Raises:
        ValueError: a line, other than a torn last one, is not a JSON object.
    """
    path = pathlib.Path(path)
    if not path.exists():
        return []
    lines = path.read_bytes().split(b"\n")[:-1]  # what follows the last line break was torn off
    rows = []
    for number, line in enumerate(lines, start=1):
        try:
            fields = json.loads(line)
        except ValueError as error:
            raise ValueError(f"{path}, line {number} is not JSON ({error}): remove that line to go on.") from error
        if not isinstance(fields, dict):
            raise ValueError(f"{path}, line {number} is {type(fields).__name__}, expected a JSON object.")
        rows.append((number, fields))
    return rows


def _parsed(fields: dict[str, Any], where: str) -> Trial:
    kinds = {field.name: field.type for field in dataclasses.fields(Trial)}
    missing, unknown = sorted(set(kinds) - set(fields)), sorted(set(fields) - set(kinds))
    if missing or unknown:
        raise ValueError(f"{where} is not a trial: missing fields {missing}, unknown fields {unknown}.")
    try:
        converted = {name: _CONVERT[kinds[name]](value) for name, value in fields.items()}
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where} is not a trial: {error}.") from error
    return Trial(**converted)


_CONVERT: dict[Any, Any] = {
    "str": str,
    "float": float,
    "int": int,
    "str | None": lambda value: None if value is None else str(value),
    "tuple[float, ...]": lambda values: tuple(map(float, values)),
}


def _encoded(value: Any) -> Any:
    """JSON has no NaN and no infinity: they become strings."""
    if isinstance(value, dict):
        return {key: _encoded(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_encoded(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value
