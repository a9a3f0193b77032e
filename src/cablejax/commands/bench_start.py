"""`cablejax bench start`: times start-up, the first control call and a verdict."""

from __future__ import annotations

import dataclasses
import json
import os
import pathlib
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from typing import Annotated, Any, Literal, get_args

import tyro

from cablejax.commands.options import SeededCommand, UsageError, require_counts, say, text_table
from cablejax.compiled_programs import FOLDER, keep_compiled_programs
from cablejax.limits import require

Part = Literal["import", "help", "control", "verdict"]
"""What is timed."""

# A first control call in a process of its own.
_CONTROL = "import sys; from cablejax.commands.bench_start import first_call; first_call(sys.argv[1], int(sys.argv[2]))"
_CACHE = ("JAX_COMPILATION_CACHE", "JAX_PERSISTENT_CACHE")


@dataclasses.dataclass(frozen=True, kw_only=True)
class BenchStart(SeededCommand):
    """Time start-up, the first control call and a verdict, each in a separate process.

    Each runs first with an empty cache of compiled programs, then with the cache that the first run filled. Processor
    time, of all cores together, is reported next to wall time: on a busy machine only processor time is comparable.

    Attributes:
        logs: Gap logs to diagnose; by default one of a cable that is too soft, staged with the contact plant.
        parts: What to time: `import cablejax`, `cablejax --help`, a first control call, `cablejax diagnose LOG`.
        weights: Released model by name, or the folder of a training by `cablejax train`, of the control call.
        horizon: Steps that the control call's plan looks ahead, beyond the next one.
        repeats: How often `import` and `--help` are run; the median counts.
    """

    logs: Annotated[tuple[pathlib.Path, ...], tyro.conf.Positional] = ()
    parts: tuple[Part, ...] = get_args(Part)
    weights: str = "gns-reference"
    horizon: int = 5
    repeats: int = 5

    def execute(self):
        """Runs every part with an empty and a filled folder and returns seconds of both kinds."""
        from cablejax.commands.workloads import setting
        from cablejax.dynamics.weights import weights_path
        from cablejax.gaplog import read_gap_log

        require_counts(self, "repeats")
        require(self.horizon, "count_from_zero", "--horizon")
        if not self.parts:
            raise UsageError(f"--parts is empty, expected some of {', '.join(get_args(Part))}.")
        for log in self.logs:
            read_gap_log(log)  # what cannot be read is said before anything is timed
        if "control" in self.parts:
            weights_path(self.weights)
        result: dict[str, Any] = {}
        with tempfile.TemporaryDirectory() as scratch:
            folder = pathlib.Path(scratch)
            if "import" in self.parts:
                result["import"] = self._started(["-c", "import cablejax"])
            if "help" in self.parts:
                result["help"] = self._started(["-m", "cablejax", "--help"])
            if "control" in self.parts:
                say("a first control call ...")
                words = ["-c", _CONTROL, os.path.expanduser(self.weights), str(self.horizon)]
                result["control"] = twice(words, folder / "control", own=True)
            if "verdict" in self.parts:
                result["verdict"] = self._verdicts(folder)
        rows = [[name, f"{s['wall_s']:.2f}", f"{s['cpu_s']:.2f}"] for name, s in self._rows(result)]
        return {**result, **setting()}, text_table(["", "wall time [s]", "processor time [s]"], rows)

    def _started(self, words: Sequence[str]) -> dict[str, float]:
        say(f"{' '.join(words)} ...")
        return median(seconds_of(words)[0] for _ in range(self.repeats))

    def _verdicts(self, folder: pathlib.Path) -> dict[str, Any]:
        """Of every log, and the medians over them."""
        logs = self.logs or (staged_log(folder / "staged.npz", self.seed),)
        each = {}
        for k, log in enumerate(logs):
            say(f"the verdict of {log.name} ...")
            words = ["-m", "cablejax", "diagnose", str(log), "--out", str(folder / f"report_{k}"), "--overwrite"]
            each[log.stem if log.stem not in each else str(log)] = twice(words, folder / f"programs_{k}")
        return {"logs": each, **{state: median(one[state] for one in each.values()) for state in ("empty", "filled")}}

    def _rows(self, result: dict[str, Any]) -> list[tuple[str, dict[str, float]]]:
        words = {"import": "import cablejax", "help": "cablejax --help"}
        rows = [(words[part], result[part]) for part in words if part in result]
        for part, name in (("control", "first control call"), ("verdict", "verdict, median over the logs")):
            rows += [
                (f"{name}, {state} folder", result[part][state]) for state in ("empty", "filled") if part in result
            ]
        return rows


def seconds_of(words: Sequence[str], programs: pathlib.Path | None = None) -> tuple[dict[str, float], str]:
    """Wall and processor time [s] of a Python process, and what it printed.

    Args:
        words: after the interpreter on its command line.
        programs: folder for compiled programs; None = none are kept.

    Raises:
        UsageError: the process failed; says with which message.
    """
    environment = {name: value for name, value in os.environ.items() if not name.startswith(_CACHE)}
    environment[FOLDER] = "" if programs is None else str(programs)
    before, begin = _children_cpu(), time.perf_counter()
    done = subprocess.run([sys.executable, *words], env=environment, capture_output=True, text=True)
    wall, cpu = time.perf_counter() - begin, _children_cpu() - before
    if done.returncode != 0:
        raise UsageError(f"`python {' '.join(words)}` failed and cannot be timed. {done.stderr.strip()}")
    return {"wall_s": wall, "cpu_s": cpu}, done.stdout


def _children_cpu() -> float:
    """Processor time of the processes that this one has waited for [s]; to the microsecond, as `os.times` is not."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def twice(words: Sequence[str], programs: pathlib.Path, *, own: bool = False) -> dict[str, dict[str, float]]:
    """Times of a Python process with an empty cache of compiled programs, and with the cache that this run filled.

    Args:
        words: after the interpreter on its command line.
        programs: the folder, which does not exist yet.
        own: the process prints its times as JSON: these are taken, and not those of all of it.
    """
    result = {}
    for state in ("empty", "filled"):
        whole, printed = seconds_of(words, programs)
        result[state] = json.loads(printed) if own else whole
    return result


def median(times: Iterable[dict[str, float]]) -> dict[str, float]:
    """The median of each kind of time."""
    import numpy as np

    every = list(times)
    return {kind: float(np.median([one[kind] for one in every])) for kind in every[0]}


def first_call(weights: str, horizon: int) -> None:
    """Prints the times of a first control call with the default solver, from the observation to the command, as JSON.

    Args:
        weights: of the model; see `BenchStart`.
        horizon: of the plan.
    """
    keep_compiled_programs()
    from cablejax.commands.workloads import control_calls, controller_to_s
    from cablejax.control.shaping import initial_history, load_model

    model = load_model(weights)
    controller = controller_to_s(model, "levenberg-marquardt", horizon)
    call = control_calls(controller, initial_history(model.cable, model.config))
    begin, before = time.perf_counter(), time.process_time()
    call()
    print(json.dumps({"wall_s": time.perf_counter() - begin, "cpu_s": time.process_time() - before}))


def staged_log(path: pathlib.Path, seed: int) -> pathlib.Path:
    """Writes a gap log of a cable that is too soft, as `cablejax study` records it first, with fewer links.

    Args:
        path: of the file.
        seed: of plant and noise.

    Returns:
        The path.
    """
    from cablejax.cable import Cable
    from cablejax.commands.runs import PLANT_EFFECT, plant_of, staged_effects
    from cablejax.control.targets import make_target, straight_start
    from cablejax.diagnose.study import first_recording
    from cablejax.gaplog import write_gap_log
    from cablejax.simulate.plant import Plant
    from cablejax.simulate.play import play

    say(f"staging {PLANT_EFFECT} in the contact plant ...")
    cable = Cable()
    goals = {f"to {letter}": make_target(letter, cable).gripper_pose for letter in ("U", "S", "Z")}
    plant = Plant(plant_of(cable, staged_effects(()), links=24, seed=seed))
    log = play(
        plant, first_recording(cable, straight_start(cable), goals), source="contact plant", noise=1e-3, seed=seed
    )
    return write_gap_log(path, log)
