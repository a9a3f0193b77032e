"""The bounded solvers against IPOPT on 1,000 planning problems, in float64, with the released network or another one.

A quarter of the problems are what the controller asked its solver for on the way to U, S and Z with cables 0.5, 1 and 2
times as stiff as the one trained on; a quarter are the same states with another step bound; half are random shapes with
random targets. The network's corners are rounded, without which there is no stationary plan to be found. IPOPT gets the
same objective and gradient from JAX, the same start, and on `--exact` of the problems the exact Hessian as well.

    python experiments/11_against_ipopt.py --draw                 # once, and done: the problems, some minutes
    python experiments/11_against_ipopt.py --n 20                 # the first 20 of them, resumable
    python experiments/11_against_ipopt.py --n 1000 --process 1 2 &   # every second one, beside --process 0 2
    python experiments/11_against_ipopt.py --explain              # the exceptions
    python experiments/11_against_ipopt.py --kinks 10             # why the network's corners are rounded
    python experiments/11_against_ipopt.py --calls 60             # a control call, and IPOPT until it is as good
    python experiments/11_against_ipopt.py --n 60 --exact 0 --weights experiments/weights/gns-rigid   # no snap-through
    python experiments/11_against_ipopt.py --report docs/results/against_ipopt.md     # the page, of what is done
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import platform
import time
from importlib.metadata import version
from pathlib import Path

os.environ.setdefault("NPROC", "4")

import jax
import numpy as np
from tqdm import tqdm

from cablejax.control.shaping import Model, load_model
from cablejax.evaluation.against_ipopt import (
    ACCURATE,
    POINTS,
    REACH,
    Contestant,
    contestant,
    explain,
    judge,
    kept_rows,
    keypoints_apart,
    kkt_residual,
    meets_all,
    slopes_along,
)
from cablejax.evaluation.control_call import race
from cablejax.evaluation.ipopt_page import ipopt_sections
from cablejax.evaluation.planning_problems import (
    PlanningCase,
    ProblemMaker,
    closed_loop_cases,
    load_cases,
    other_radii,
    random_cases,
    save_cases,
)
from cablejax.evaluation.referee import RefereeConfig
from cablejax.mpc import SOLVERS
from cablejax.report.markdown import publish
from cablejax.report.provenance import machine, versions

FOLDER = Path("docs") / "results" / "trials" / "against_ipopt"
"""Problems and rows, kept with the repository: a thousand problems take longer than one sitting."""
RELEASED = "gns-reference"
STARTS = 6
"""Further starts, at most, for a problem on which the first does not meet all that is asked."""
ITERATIONS, EXACT_ITERATIONS = 200, 60
"""Of IPOPT at most, with limited memory and with the exact Hessian, of which one costs as much as ten gradients."""
CALLS = {name: SOLVERS[name] for name in ("levenberg-marquardt", "two-trials")}
"""What a control call solves with."""


def draw(path: Path) -> None:
    """The problems, in an order in which every beginning is a fair sample."""
    model = load_model(RELEASED)
    loops = closed_loop_cases(model, ("U", "S", "Z"), (0.5, 1.0, 2.0), (0,), 28)[:250]
    cases = loops + other_radii(loops, 0) + random_cases(model, range(500))
    order = np.random.default_rng(0).permutation(len(cases))
    save_cases(path, [cases[i] for i in order])


def referees(exact: bool) -> list[RefereeConfig]:
    limited = RefereeConfig(max_iterations=ITERATIONS)
    return [limited, RefereeConfig(exact=True, max_iterations=EXACT_ITERATIONS)] if exact else [limited]


def run(
    ours: Contestant, cases: list[PlanningCase], path: Path, n_exact: int, process: tuple[int, int], seconds: float
) -> None:
    """Judges what the file does not have yet, until the time is up."""
    done = {row["name"]: "exact" in row for row in kept_rows(path.parent)}
    index, count = process
    wanted = [(case, i < n_exact) for i, case in enumerate(cases) if i % count == index]
    # with the exact Hessian again where that was not asked for before
    todo = [(case, exact) for case, exact in wanted if case.name not in done or (exact and not done[case.name])]
    began = time.perf_counter()
    for exact in {exact for _, exact in todo}:
        # Compiles, so that no clock below sees that.
        judge(
            ours, todo[0][0], [dataclasses.replace(config, max_iterations=2) for config in referees(exact)], gradients=2
        )
    for case, exact in tqdm(todo, unit="problem", dynamic_ncols=True):
        if time.perf_counter() - began > seconds:
            break
        with path.open("a", encoding="utf-8") as file:
            row = judge(ours, case, referees(exact))
            file.write(json.dumps({**row, "machine": machine(), "threads": os.environ["NPROC"]}) + "\n")


def explain_all(ours: Contestant, cases: list[PlanningCase], folder: Path, seconds: float) -> None:
    """Explains what is not explained yet, until the time is up."""
    known, by_name = {row["name"] for row in kept_rows(folder, "explained")}, {case.name: case for case in cases}
    todo = [row for row in kept_rows(folder) if not meets_all(row, row) and row["name"] not in known]
    began = time.perf_counter()
    for row in tqdm(todo, unit="problem", dynamic_ncols=True):
        if time.perf_counter() - began > seconds:
            break
        with (folder / "explained-0.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(explain(ours, by_name[row["name"]], row, STARTS)) + "\n")


def measure_kinks(ours: Contestant, cases: list[PlanningCase], folder: Path, n: int) -> None:
    """What the corners do to the slope, and to where our solver ends, on the first problems that are judged."""
    done, by_name = {row["name"] for row in kept_rows(folder, "kinks")}, {case.name: case for case in cases}
    for row in tqdm(kept_rows(folder)[:n], unit="problem", dynamic_ncols=True):
        if row["name"] in done:
            continue
        case, found = by_name[row["name"]], {}
        for kind, make in (("sharp", ours.make_sharp), ("smooth", ours.make)):
            problem, rng = make(case), np.random.default_rng([len(case.name), 13])
            changes = np.abs(np.diff(slopes_along(problem, np.asarray(row["motion"]), rng, REACH, POINTS)))
            end = ours.find(problem, case.guess, ACCURATE.gradients).points[-1] if kind == "sharp" else None
            kkt = row["kkt"] if end is None else kkt_residual(problem, end)
            found[kind] = {"jump": float(changes.max()), "usual": float(np.median(changes)), "kkt": kkt}
        found["apart"] = keypoints_apart(ours.make_sharp(case), ours.make(case), np.asarray(row["motion"]))
        with (folder / "kinks-0.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps({"name": row["name"], **found}) + "\n")


def time_calls(model: Model, cases: list[PlanningCase], folder: Path) -> None:
    """A control call's solve and IPOPT until it is as good, on the first problems, in single precision."""
    done = {row["name"] for row in kept_rows(folder, "calls")}
    with jax.enable_x64(False):
        make = ProblemMaker(model, np.float32)
        race(make, cases[0], CALLS, RefereeConfig(max_iterations=2))  # compiles, so that no clock below sees that
        for case in tqdm([case for case in cases if case.name not in done], unit="problem", dynamic_ncols=True):
            with (folder / "calls-0.jsonl").open("a", encoding="utf-8") as file:
                file.write(json.dumps({**race(make, case, CALLS), "machine": machine()}) + "\n")


def page(options: argparse.Namespace, folder: Path, n_all: int) -> str:
    """The Markdown page of what is done."""
    rows, kinks, calls = (kept_rows(folder, kind) for kind in ("rows", "kinks", "calls"))
    explained = {row["name"]: row for row in kept_rows(folder, "explained")}
    n_exact = sum("exact" in row for row in rows)
    done = f"`--draw`, `--n {len(rows)} --exact {n_exact}`"
    for rows_of, option in ((explained, "explain"), (kinks, f"kinks {len(kinks)}"), (calls, f"calls {len(calls)}")):
        done += f", `--{option}`" if rows_of else ""
    weights = "" if options.weights == RELEASED else f" --weights {options.weights}"
    lines = [
        "# Against IPOPT",
        "",
        f"Made by `python experiments/11_against_ipopt.py{weights} --report {options.report}`, after {done}.",
        f"{versions()}, ipyopt {version('ipyopt')}; {', '.join(sorted({row['machine'] for row in rows}))}; "
        f"{platform.machine()}, NPROC={'/'.join(sorted({row['threads'] for row in rows}))}. The machine had other work "
        "to do meanwhile: seconds are long, and say something only beside each other.",
        "",
        f"{len(rows)} of {n_all} problems, in a random order, seed 0; {n_exact} of them with the exact Hessian too. "
        f"Network {options.weights}, the corners of its ReLUs rounded, with the residual fitted online, horizon 5, "
        f"36 unknowns, float64. Ours: `mpc.{ACCURATE}`. "
        "IPOPT: tol 1e-9 on the objective divided by its value at the start, constr_viol_tol 1e-9, "
        f"bound_relax_factor 0, adaptive mu, limited memory of 20, at most {ITERATIONS} iterations, or exact Hessian, "
        f"at most {EXACT_ITERATIONS}. Both begin at the same feasible plan.",
        "",
        *ipopt_sections(rows, explained, kinks, calls, tuple(CALLS)),
    ]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draw", action="store_true", help="make the problems, and nothing else")
    parser.add_argument("--n", type=int, default=20, help="judge the first so many")
    parser.add_argument("--exact", type=int, default=10, help="the first so many with the exact Hessian too")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no other problem after this time")
    parser.add_argument("--process", nargs=2, type=int, default=(0, 1), metavar=("INDEX", "COUNT"))
    parser.add_argument("--weights", default=RELEASED, help="released model by name, or the folder of a training")
    parser.add_argument("--folder", type=Path, default=FOLDER, help="has the problems")
    parser.add_argument("--explain", action="store_true", help="explain the exceptions")
    parser.add_argument("--kinks", type=int, help="measure the kinks of the first so many problems that are judged")
    parser.add_argument("--calls", type=int, help="time a control call and IPOPT on the first so many problems")
    parser.add_argument("--report", type=Path, help="run nothing; write the page on what is done to this file")
    options = parser.parse_args()
    cases_path = options.folder / "cases.npz"
    if options.draw:
        draw(cases_path)
        return
    if not cases_path.is_file():
        parser.error(f"there is no {cases_path}: make the problems first, with --draw")
    jax.config.update("jax_enable_x64", True)
    cases, folder = load_cases(cases_path), options.folder
    if options.weights != RELEASED:
        folder = folder / Path(options.weights).name
        folder.mkdir(exist_ok=True)
    model = load_model(options.weights)
    if options.calls:
        time_calls(model, cases[: options.calls], folder)
        return
    ours = contestant(model)
    if options.explain:
        explain_all(ours, cases, folder, options.seconds)
        return
    if options.kinks:
        measure_kinks(ours, cases, folder, options.kinks)
        return
    if options.report is None:
        path = folder / f"rows-{options.process[0]}.jsonl"
        run(ours, cases[: options.n], path, options.exact, tuple(options.process), options.seconds)
    text = page(options, folder, len(cases))
    publish(text, options.report)


if __name__ == "__main__":
    main()
