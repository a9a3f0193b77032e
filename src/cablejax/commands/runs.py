"""What `demo` and `shape` share: runs on the plant, kept as they finish, and their report."""

from __future__ import annotations

import dataclasses
import pathlib
import time
from collections.abc import Mapping
from typing import Any

from cablejax.cable import Cable
from cablejax.commands.options import UsageError, say
from cablejax.commands.parts import Parts
from cablejax.commands.results import summarise, write_results
from cablejax.control.run import ClosedLoopRun
from cablejax.control.shaping import Method, Model, shape_once
from cablejax.control.targets import Target
from cablejax.dynamics.fingerprint import fingerprint
from cablejax.json_file import write_json
from cablejax.perceive.camera import CameraConfig
from cablejax.report.style import METHOD_LABEL
from cablejax.simulate.plant import PlantConfig
from cablejax.solver_names import SolverName


@dataclasses.dataclass(frozen=True, kw_only=True)
class Job:
    """A cable to be brought to every target by every method.

    Attributes:
        plant: what the cable and its table really are.
        model: what the controller believes.
        targets: shapes to make, of different names.
        methods: with the online residual, without, or both.
        solver: how plans are found.
        steps: commands per run.
        camera: what the cable is seen with; None = the controller observes the simulated keypoints directly.
    """

    plant: PlantConfig
    model: Model
    targets: tuple[Target, ...]
    methods: tuple[Method, ...]
    solver: SolverName
    steps: int
    camera: CameraConfig | None = None

    def __post_init__(self):
        if self.steps < 1:
            raise UsageError(f"--steps is {self.steps}, expected at least 1.")

    def settings(self) -> dict[str, Any]:
        """All that a run depends on, as for JSON: of the model its weights, since a name may stand for others later."""
        return {
            "model": {"config": dataclasses.asdict(self.model.config), "weights": fingerprint(self.model.weights)},
            "plant": dataclasses.asdict(self.plant),
            "camera": None if self.camera is None else dataclasses.asdict(self.camera),
            "targets": [target.keypoints.tolist() for target in self.targets],
            "solver": self.solver,
            "steps": self.steps,
        }


def shape_and_report(
    job: Job, out: pathlib.Path, parts: Parts, *, about: str, facts: Mapping[str, str]
) -> dict[str, Any]:
    """Makes the runs that are not among the parts yet and writes the results.

    Args:
        job: what to do.
        out: folder for `summary.json`, `log.npz`, `report.html` and `demo.gif`, replaced where they are there.
        parts: keeps finished runs.
        about: plant and model in a sentence or two, for the page and the log.
        facts: settings to print on the page.

    Returns:
        The summary.

    Raises:
        ValueError: model and plant do not fit.
    """
    begin = time.perf_counter()
    kept = {(t.name, method): parts.load(f"{t.name}-{method}") for t in job.targets for method in job.methods}
    if any(run is None for run in kept.values()):
        say("compiling the control step ...")
    runs: dict[tuple[str, Method], ClosedLoopRun] = {}
    for target in job.targets:
        for method in job.methods:
            run = kept[target.name, method]
            if run is None:
                run = shape_once(
                    job.plant,
                    job.model,
                    target,
                    method=method,
                    solver=job.solver,
                    steps=job.steps,
                    camera=job.camera,
                )
                parts.save(f"{target.name}-{method}", run)
            runs[target.name, method] = run
            say(f"{time.perf_counter() - begin:5.0f} s  {METHOD_LABEL[method]:22s}{run.verdict()}")
    summary = summarise(runs, total_s=0.0)
    cable = job.plant.cable
    believed = Cable(length=cable.length, n_keypoints=cable.n_keypoints)
    write_results(out, runs, summary, believed=believed, about=about, facts=facts)
    summary["total_s"] = round(time.perf_counter() - begin, 3)
    write_json(out / "summary.json", summary)
    return summary
