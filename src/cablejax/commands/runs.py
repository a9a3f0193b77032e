"""What `demo` and `shape` share: runs on the plant, kept as they finish, and their report."""

from __future__ import annotations

import dataclasses
import pathlib
import time
from collections.abc import Mapping, Sequence
from typing import Any

from cablejax.closed_loop import ClosedLoopRun
from cablejax.commands.options import UsageError, output_folder, say
from cablejax.commands.parts import Parts
from cablejax.commands.results import summarise, write_results
from cablejax.json_file import write_json
from cablejax.perceive.camera import CameraConfig
from cablejax.report.record import Method
from cablejax.report.style import METHOD_LABEL
from cablejax.shaping import Model, shape_once
from cablejax.simulate import CableConfig
from cablejax.simulate.plant import PlantConfig
from cablejax.solver_names import SolverName
from cablejax.targets import Target


def shape_and_report(
    out: pathlib.Path,
    *,
    overwrite: bool,
    plant: PlantConfig,
    model: Model,
    targets: Sequence[Target],
    methods: Sequence[Method],
    solver: SolverName,
    steps: int,
    about: str,
    facts: Mapping[str, str],
    camera: CameraConfig | None = None,
) -> dict[str, Any]:
    """Brings a cable to every target by every method and writes the results. Goes on where the same call was stopped.

    Args:
        out: folder for `summary.json`, `log.npz`, `report.html` and `demo.gif`.
        overwrite: whether results that are there may be replaced.
        plant: what the cable and its table really are.
        model: what the controller believes.
        targets: shapes to make, of different names.
        methods: with the online residual, without, or both.
        solver: how plans are found.
        steps: commands per run.
        about: plant and model in a sentence or two, for the page and the log.
        facts: settings to print on the page.
        camera: what the cable is seen with; None = its keypoints are told.

    Returns:
        The summary.

    Raises:
        ValueError: `steps` is not positive, the folder holds other results, or model and plant do not fit.
    """
    if steps < 1:
        raise UsageError(f"--steps is {steps}, expected at least 1.")
    begin = time.perf_counter()
    settings = {
        "model": model.name,
        "plant": dataclasses.asdict(plant),
        "camera": None if camera is None else dataclasses.asdict(camera),
        "targets": [target.keypoints.tolist() for target in targets],
        "solver": solver,
        "steps": steps,
    }
    parts = Parts(out / "parts", settings)
    if not parts.match():
        output_folder(out, overwrite=overwrite)
    parts.begin()
    runs: dict[tuple[str, Method], ClosedLoopRun] = {}
    for target in targets:
        for method in methods:
            name = f"{target.name}-{method}"
            run = parts.load(name)
            if run is None:
                run = shape_once(plant, model, target, method=method, solver=solver, steps=steps, camera=camera)
                parts.save(name, run)
            runs[target.name, method] = run
            say(f"{time.perf_counter() - begin:5.0f} s  {METHOD_LABEL[method]:22s}{run.verdict()}")
    summary = summarise(runs, total_s=0.0)
    believed = CableConfig(length=plant.cable.length, n_keypoints=plant.cable.n_keypoints)
    write_results(out, runs, summary, believed=believed, about=about, facts=facts)
    summary["total_s"] = round(time.perf_counter() - begin, 3)
    # Last, so that a folder with a summary is a finished one.
    write_json(out / "summary.json", summary)
    parts.remove()
    return summary
