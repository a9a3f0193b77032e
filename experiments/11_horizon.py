"""How far ahead, and by which solver? Closed loops over horizons and solvers: error against milliseconds per call.

Straight cables of the trained and of twice the trained stiffness are brought to a U and an S by the controller with the
online residual. Every point of the figure is the mean of these runs.

    python experiments/11_horizon.py                                # two solvers, two horizons
    python experiments/11_horizon.py --full --out docs/results/solvers_horizon.md

Finished runs are kept in --work, and the same command goes on from there.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("NPROC", "4")

import matplotlib.pyplot as plt
import numpy as np

from cablejax.closed_loop import run_closed_loop
from cablejax.evaluation.cases import mujoco_plant, stiffness_cases
from cablejax.mpc import SOLVERS
from cablejax.report.provenance import machine, versions
from cablejax.report.style import LIGHT
from cablejax.shaping import load_model, make_controller

HORIZONS = (1, 2, 5, 10)
DEFAULT = ("trust-region", 5)


def measured(case: Any, model: Any, solver: str, horizon: int, steps: int) -> dict[str, Any]:
    """One run: its errors, and the CPU and wall time of its control calls."""
    task = case.task()
    controller = make_controller(model, task.target, method="residual", solver="trust-region")
    config = dataclasses.replace(controller.config, horizon=horizon, solver=SOLVERS[solver])
    timed = _Timed(dataclasses.replace(controller, config=config))
    run = run_closed_loop(mujoco_plant(case.stiffness), timed, task.target, steps, start=task.start_pose, record_hz=1.0)
    return {
        "solver": solver,
        "horizon": horizon,
        "scenario": case.scenario,
        "stiffness": case.stiffness,
        "error_cm": run.terminal_error_cm,
        "mean_error_cm": float(run.error_cm.mean()),
        "wall_ms": float(np.nanmedian(run.mpc_ms)),
        "cpu_ms": float(np.median(timed.cpu_ms[1:])),
    }


class _Timed:
    """A controller whose calls are timed in CPU time of the process, which other programs do not lengthen."""

    def __init__(self, controller: Any):
        self.init, self._controller, self.cpu_ms = controller.init, controller, []

    def step(self, *arguments: Any) -> Any:
        began = time.process_time()
        state, twist, info = self._controller.step(*arguments)
        twist = np.asarray(twist)
        self.cpu_ms.append(1e3 * (time.process_time() - began))
        return state, twist, info


def figure(table: list[dict[str, Any]], path: Path) -> None:
    """Terminal error against CPU time of a call; a line joins the horizons of one solver."""
    drawing, axes = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
    colours = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#999999")
    for name, colour in zip(dict.fromkeys(row["solver"] for row in table), colours, strict=False):
        rows = sorted((row for row in table if row["solver"] == name), key=lambda row: row["horizon"])
        axes.plot([r["cpu_ms"] for r in rows], [r["error_cm"] for r in rows], "o-", color=colour, label=name)
        for row in rows:
            axes.annotate(str(row["horizon"]), (row["cpu_ms"], row["error_cm"]), (4, 4), textcoords="offset points")
            if (name, row["horizon"]) == DEFAULT:
                axes.plot(row["cpu_ms"], row["error_cm"], "o", ms=14, mfc="none", mec=LIGHT.ink, label="default")
    axes.set(xscale="log", xlabel="CPU time of one control call [ms]", ylabel="terminal error [cm]")
    axes.legend(frameon=False)
    drawing.savefig(path, dpi=150)
    plt.close(drawing)


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means over the cases of each solver and horizon."""
    keys = list(dict.fromkeys((row["solver"], row["horizon"]) for row in rows))
    table = []
    for key in keys:
        some = [row for row in rows if (row["solver"], row["horizon"]) == key]
        means = {name: float(np.mean([row[name] for row in some])) for name in ("error_cm", "mean_error_cm")}
        times = {name: float(np.median([row[name] for row in some])) for name in ("wall_ms", "cpu_ms")}
        table.append({"solver": key[0], "horizon": key[1], "runs": len(some), **means, **times})
    return table


def page(rows: list[dict[str, Any]], command: str, steps: int, picture: str) -> str:
    """The table and the figure as Markdown."""
    lines = [
        "# Horizons and solvers in closed loop",
        "",
        f"Made by `{command}`.",
        f"{versions()}; {machine()}.",
        "",
        f"Means over U and S by cables of 1 and 2 times the trained stiffness, {steps} commands from straight, with "
        "the online residual. The plant is C MuJoCo in space with contact. CPU time is that of the process, both cores "
        "added; other programs ran beside it, so the wall times are too long.",
        "",
        f"![error against milliseconds]({picture})",
        "",
        "| solver | horizon | runs | terminal error [cm] | mean error [cm] | CPU per call [ms] | wall [ms] |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in summary(rows):
        mark = " (default)" if (row["solver"], row["horizon"]) == DEFAULT else ""
        lines.append(
            f"| {row['solver']}{mark} | {row['horizon']} | {row['runs']} | {row['error_cm']:.3f} | "
            f"{row['mean_error_cm']:.2f} | {row['cpu_ms']:.0f} | {row['wall_ms']:.0f} |"
        )
    return "\n".join([*lines, ""])


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", default="gns-reference", help="released name, weights file or training's folder")
    parser.add_argument("--solvers", nargs="*", choices=tuple(SOLVERS), help="which; by default two")
    parser.add_argument("--horizons", nargs="*", type=int, help="which; by default 1 and 5")
    parser.add_argument("--letters", nargs="*", choices=("U", "S", "Z"), default=["U", "S"])
    parser.add_argument("--stiffness", nargs="*", type=float, default=[1.0, 2.0])
    parser.add_argument("--steps", type=int, default=30, help="commands of a run")
    parser.add_argument("--full", action="store_true", help="all solvers and horizons 1, 2, 5, 10")
    parser.add_argument("--work", type=Path, default=Path("runs/horizon"), help="finished runs are kept there")
    parser.add_argument("--out", type=Path, help="write the page there as Markdown, and the figure beside it")
    parser.add_argument("--report-only", action="store_true", help="the page of what is done so far")
    options = parser.parse_args(arguments)
    solvers = options.solvers or (list(SOLVERS) if options.full else ["trust-region", "deadline"])
    horizons = options.horizons or (HORIZONS if options.full else (1, 5))

    options.work.mkdir(parents=True, exist_ok=True)
    kept = options.work / f"{Path(options.weights).name}-{options.steps}.jsonl"
    rows = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    names = ("solver", "horizon", "scenario", "stiffness")
    done = {tuple(row[name] for name in names) for row in rows}
    cases = stiffness_cases(options.letters, options.stiffness, seeds=(0,), steps=options.steps)
    model = load_model(options.weights)
    for horizon in horizons if not options.report_only else ():
        for solver in solvers:
            for case in cases:
                if (solver, horizon, case.scenario, case.stiffness) in done:
                    continue
                rows.append(measured(case, model, solver, horizon, options.steps))
                with kept.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(rows[-1]) + "\n")
                print(json.dumps(rows[-1]), file=sys.stderr, flush=True)

    command = "python experiments/11_horizon.py " + " ".join(sys.argv[1:] if arguments is None else arguments)
    picture = "solvers_horizon.png" if options.out is None else options.out.with_suffix(".png").name
    text = page(rows, command.strip(), options.steps, picture)
    print(text)
    if options.out is not None:
        options.out.write_text(text, encoding="utf-8")
        figure(summary(rows), options.out.with_name(picture))


if __name__ == "__main__":
    main()
