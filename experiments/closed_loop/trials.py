"""One closed-loop run as a row of results."""

from __future__ import annotations

import dataclasses
import math
import os
from typing import TYPE_CHECKING, Any

import numpy as np

from cablejax.cable import Cable
from cablejax.control.run import settling_time, time_in_band
from cablejax.mpc import ObjectiveConfig
from rows import MADE_ON, read_rows

if TYPE_CHECKING:
    from cablejax.control.run import ClosedLoopRun

TrialKey = tuple[str, str, str, float, int]
"""(table, method, scenario, stiffness, seed): what makes a trial the one it is."""

KEY = ("table", "method", "scenario", "stiffness", "seed")
"""The same as names of fields."""

LATE = 10
"""Samples at the end of a run, a second apart, in which it is judged whether it has settled."""

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
        motion_m: how far the grippers were commanded in each step [m], both together, a radian counting as 0.15 m;
            None in rows that were written before it was recorded.
        reachable_cm: how near a cable at rest can come to the target [cm].
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
    motion_m: tuple[float, ...] | None = None
    reachable_cm: float = 0.0

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
    def late_errors_cm(self) -> np.ndarray:
        """Errors of the last `LATE` seconds [cm]: a single last value may be a snapshot of an oscillation."""
        return np.array(self.errors_cm[-LATE:])

    @property
    def worse_than_best(self) -> bool:
        """Whether the run ends half as far again from the target as it has been, and by more than 0.1 mm."""
        return not self.terminal_error_cm <= max(1.5 * self.best_error_cm, self.best_error_cm + 0.01)

    @property
    def late_travel_m(self) -> float:
        """Motion of both grippers in the last `LATE` commands [m]; NaN where it was not recorded."""
        return math.nan if self.motion_m is None else float(sum(self.motion_m[-LATE:]))

    @property
    def steps(self) -> int:
        """Commands carried out."""
        return len(self.errors_cm) - 1

    @property
    def settling_time_s(self) -> float:
        """See `control.run.settling_time` [s]; infinite if the run never settled."""
        return settling_time(*self._course, Cable().length)

    def step_settling_time_s(self, fraction: float) -> float:
        """From when on the error stays within a fraction of the way that it went [s]; likewise.

        This is the textbook's settling time of a step response (Ogata, Modern Control Engineering, 5-3; 2 or 5 %
        there), with the error's change over the run for the step. It is the milder one where a run ends near its
        target: 2 % of 25 cm are 5 mm.
        """
        times, error = self._course
        return time_in_band(times, error, fraction * abs(error[0] - error[-1]))

    @property
    def _course(self) -> tuple[np.ndarray, np.ndarray]:
        return np.arange(len(self.errors_cm), dtype=float), np.array(self.errors_cm)


def trial_of(
    run: ClosedLoopRun,
    *,
    table: str,
    method: str,
    scenario: str,
    stiffness: float,
    seed: int,
    wall_s: float,
    reachable_cm: float = 0.0,
) -> Trial:
    """The row of one finished run."""
    motion = run.twist[:-1] * np.array([1.0, 1.0, ObjectiveConfig().rotation_weight])
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
        reachable_cm=float(reachable_cm),
        motion_m=tuple(map(float, np.linalg.norm(motion, axis=-1).sum(axis=-1))),
    )


def read_trials(path: str | os.PathLike[str]) -> list[Trial]:
    """The trials in a file, in the order of their first appearance; of two with the same key the later one counts.

    A file that does not exist holds none. A torn last line is left out.

    Raises:
        ValueError: a line is not a trial.
    """
    trials: dict[TrialKey, Trial] = {}
    for number, fields in enumerate(read_rows(path), start=1):
        fields.pop(MADE_ON, None)
        trial = _parsed(fields, f"{os.fspath(path)}, line {number}")
        trials[trial.key] = trial
    return list(trials.values())


def _parsed(fields: dict[str, Any], where: str) -> Trial:
    kinds = {field.name: field.type for field in dataclasses.fields(Trial)}
    missing = sorted(set(kinds) - set(fields) - {"motion_m", "reachable_cm"})
    unknown = sorted(set(fields) - set(kinds))
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
    "tuple[float, ...] | None": lambda values: None if values is None else tuple(map(float, values)),
}
