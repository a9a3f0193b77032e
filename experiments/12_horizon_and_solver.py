"""Compares planning horizons and solvers in closed loop: error against milliseconds of a control call.

Every pair of a horizon (1, 2, 5, 10) and a solver brings a straight cable, twice as stiff as the reference cable, to U,
S and Z on the plant in C MuJoCo, with the online residual; everything else is the controller's default.

    python experiments/12_horizon_and_solver.py --shapes U --horizons 5      # a part of it: some minutes
    python experiments/12_horizon_and_solver.py                              # all of it: an hour on two idle cores
    python experiments/12_horizon_and_solver.py --report docs/results/horizon_and_solver.md   # its page
"""

from __future__ import annotations

import argparse
import dataclasses
import os
from pathlib import Path
from typing import get_args

os.environ.setdefault("NPROC", "4")

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import FixedLocator, NullFormatter

from cablejax.control.loop import run_closed_loop
from cablejax.control.shaping import load_model
from cablejax.control.targets import Shape
from cablejax.mpc import MPC, SOLVERS, LevenbergMarquardt, MPCConfig
from closed_loop.cases import PLANT_CHAIN, mujoco_plant
from closed_loop.protocols import LaidOut, letter_task
from pages import markdown_table, page_of_results, publish
from rows import Rows, made_on

CONVERGED = "levenberg-marquardt, converged"
PLANNERS = {**SOLVERS, CONVERGED: LevenbergMarquardt(max_iterations=12, trials_per_linearisation=1)}
HORIZONS = (1, 2, 5, 10)
SHAPES = get_args(Shape)
STIFFNESS = 2.0
STEPS = 35
SEEDS = (0,)
COLOURS = ("#0072b2", "#56b4e9", "#009e73", "#e69f00", "#d55e00", "#000000", "#cc79a7", "#999999")
MARKERS = ("o", "s", "D", "^")
CACHE = Path("docs") / "results" / "trials" / "horizon_and_solver.jsonl"


@dataclasses.dataclass(frozen=True)
class Trial:
    """One closed loop."""

    solver: str
    horizon: int
    shape: str
    seed: int
    terminal_cm: float
    settling_s: float
    p50_ms: float
    p95_ms: float
    stopped: str | None

    @property
    def key(self) -> tuple:
        return self.solver, self.horizon, self.shape, self.seed


KEY = ("solver", "horizon", "shape", "seed")


def run(model, solver: str, horizon: int, shape: Shape, seed: int) -> Trial:
    """One of them; what is compiled is kept for the next target."""
    task = letter_task(shape, seed, PLANT_CHAIN)
    config = dataclasses.replace(MPCConfig(), horizon=horizon, solver=PLANNERS[solver])
    controller = MPC(config, model.dynamics, model.weights, task.target.keypoints)
    plant = LaidOut(mujoco_plant(STIFFNESS), task.start_shape)
    out = run_closed_loop(plant, controller, task.target, STEPS, start=task.start_pose, record_hz=1.0)
    p50, p95 = np.nanpercentile(out.mpc_ms, [50, 95])
    values = (out.terminal_error_cm, out.settling_time_s, float(p50), float(p95), out.stopped)
    return Trial(solver, horizon, shape, seed, *values)


def run_all(path: Path, wanted: list[tuple]) -> None:
    """Runs what the file does not have yet."""
    model, rows = load_model("gns-reference"), Rows(path, KEY)
    todo = rows.missing(wanted)
    for pair in dict.fromkeys(key[:2] for key in todo):
        # some twenty compiled controllers are more than LLVM's memory for code holds
        jax.clear_caches()
        rows.run([key for key in todo if key[:2] == pair], lambda *key: dataclasses.asdict(run(model, *key)))


def cells(trials: list[Trial]) -> dict[tuple[str, int], dict[str, float]]:
    """Means over targets and seeds; times are medians of the runs' percentiles."""
    out = {}
    for solver in PLANNERS:
        for horizon in HORIZONS:
            mine = [t for t in trials if (t.solver, t.horizon) == (solver, horizon)]
            if mine:
                out[solver, horizon] = {
                    "runs": len(mine),
                    "error": float(np.mean([t.terminal_cm for t in mine])),
                    "worst": float(np.max([t.terminal_cm for t in mine])),
                    "p50": float(np.median([t.p50_ms for t in mine])),
                    "p95": float(np.median([t.p95_ms for t in mine])),
                }
    return out


def draw(table: dict, path: Path) -> None:
    """Terminal error against milliseconds per call; the default is ringed."""
    figure, axis = plt.subplots(figsize=(8.2, 5.0), layout="constrained")
    for solver, colour in zip(PLANNERS, COLOURS, strict=True):
        known = [h for h in HORIZONS if (solver, h) in table]
        points = np.array([[table[solver, h]["p50"], table[solver, h]["error"]] for h in known]).reshape(-1, 2)
        axis.plot(*points.T, color=colour, linewidth=1.0, alpha=0.7, label=solver if known else None)
        for horizon, point in zip(known, points, strict=True):
            axis.plot(*point, MARKERS[HORIZONS.index(horizon)], color=colour, markersize=6)
    default = MPCConfig()
    chosen = next((name for name, solver in PLANNERS.items() if solver == default.solver), None)
    if (chosen, default.horizon) in table:
        cell = table[chosen, default.horizon]
        axis.plot(cell["p50"], cell["error"], "o", markersize=17, fillstyle="none", color="black", markeredgewidth=1.4)
        axis.annotate("default", (cell["p50"], cell["error"]), xytext=(10, 12), textcoords="offset points", fontsize=9)
    for horizon, marker in zip(HORIZONS, MARKERS, strict=True):
        axis.plot([], [], marker, color="#555555", label=f"horizon {horizon}")
    axis.set(xscale="log", yscale="log", xlabel="median of one control call [ms]")
    axis.xaxis.set_major_locator(FixedLocator([50, 100, 200, 500, 1000, 2000]))
    axis.yaxis.set_major_locator(FixedLocator([0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 1.0, 2.0]))
    for side in (axis.xaxis, axis.yaxis):
        side.set_major_formatter("{x:g}")
        side.set_minor_formatter(NullFormatter())
    axis.set_ylabel(f"error after {STEPS} commands, mean over {', '.join(SHAPES)} [cm]")
    axis.grid(alpha=0.25, which="both", linewidth=0.5)
    axis.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(path, dpi=140)


def page(trials: list[Trial], table: dict, picture: str | None, made: str) -> str:
    """The Markdown page."""
    lines = [
        f"{len(trials)} closed loops: a straight cable, {STIFFNESS:g} times as stiff as the reference cable, brought "
        f"to {', '.join(sorted({t.shape for t in trials}))} by {STEPS} commands on the contact plant; seeds "
        f"{', '.join(map(str, sorted({t.seed for t in trials})))}; gns-reference with the online residual. A horizon h "
        "plans h + 1 commands. Milliseconds are those of a control call in the loop, while other work was running on "
        "this machine: compare rows, and see [speed](speed.md) for the default alone. Means of a few runs support "
        "only rough comparisons: here, more accurately solved plans do not end nearer to the target, and short "
        "horizons end as near as long ones.",
    ]
    if picture is not None:
        lines += ["", f"![Error against milliseconds]({picture})"]
    lines += [
        "",
        *markdown_table(
            [
                ["solver", "horizon", "runs", "error, mean [cm]", "worst [cm]", "call p50 [ms]", "p95 [ms]"],
                *(
                    [
                        solver,
                        str(h),
                        str(c["runs"]),
                        f"{c['error']:.3f}",
                        f"{c['worst']:.3f}",
                        f"{c['p50']:.0f}",
                        f"{c['p95']:.0f}",
                    ]
                    for (solver, h), c in table.items()
                ),
            ]
        ),
    ]
    slow = {t.key[2:]: t for t in trials if t.key[:2] == (CONVERGED, MPCConfig().horizon)}
    fast = [(h, table["two-trials", h]) for h in HORIZONS if ("two-trials", h) in table]
    if slow and fast:
        lines += ["", "## Two trials against converged, in the same targets and seeds", ""]
        for h, cell in fast:
            same = [slow[t.key[2:]] for t in trials if t.key[:2] == ("two-trials", h) and t.key[2:] in slow]
            if len(same) == cell["runs"]:
                (other,) = cells(same).values()
                lines.append(
                    f"- horizon {h}, {cell['runs']} runs: {cell['error']:.3f} cm in {cell['p50']:.0f} ms, p95 "
                    f"{cell['p95']:.0f} ms, against {other['error']:.3f} cm in {other['p50']:.0f} ms "
                    f"({100 * (cell['error'] / other['error'] - 1):+.0f} %)"
                )
    stopped = [t for t in trials if t.stopped]
    lines += ["", "## Runs that ended early", ""]
    lines += [f"- {' '.join(map(str, t.key))}: {t.stopped}" for t in stopped] or ["None."]
    rows = [["solver", "horizon", "target", "seed", "error [cm]", "settled [s]", "p50 [ms]"]]
    rows += [
        [*map(str, t.key), f"{t.terminal_cm:.3f}", f"{t.settling_s:.0f}", f"{t.p50_ms:.0f}"]
        for t in sorted(trials, key=lambda t: t.key)
    ]
    lines += ["", "## Every run", "", *markdown_table(rows)]
    command = "python experiments/12_horizon_and_solver.py --report docs/results/horizon_and_solver.md"
    return page_of_results("Horizon and solver", f"`{command}`", lines, made_on=made)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shapes", nargs="*", choices=SHAPES, default=SHAPES)
    parser.add_argument("--horizons", nargs="*", type=int, choices=HORIZONS, default=(5, 2, 1, 10))
    parser.add_argument("--solvers", nargs="*", choices=tuple(PLANNERS), default=tuple(PLANNERS))
    parser.add_argument("--seeds", nargs="*", type=int, default=SEEDS)
    parser.add_argument("--cache", type=Path, default=CACHE, help="file of the finished runs")
    parser.add_argument("--report", type=Path, help="write the page of the finished rows, and run nothing")
    options = parser.parse_args()
    if options.report is None:
        wanted = [
            (solver, horizon, shape, seed)
            for horizon in options.horizons
            for solver in options.solvers
            for seed in options.seeds
            for shape in options.shapes
        ]
        run_all(options.cache, wanted)
    trials = [Trial(**row) for row in Rows(options.cache, KEY).read()]
    table = cells(trials)
    picture = None
    if options.report is not None:
        image = options.report.parent.parent / "images" / "horizon_and_solver.png"
        draw(table, image)
        picture = f"../images/{image.name}"
    text = page(trials, table, picture, made_on(options.cache))
    publish(text, options.report)


if __name__ == "__main__":
    main()
