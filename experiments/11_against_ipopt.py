"""The bounded solvers against IPOPT on 1,000 planning problems, in float64, with the released network or another one.

A quarter of the problems are those that the controller gave its solver on the way to U, S and Z, with cables 0.5, 1 and
2 times as stiff as the trained one; a quarter are the same states with another step bound; half are random shapes with
random targets. The network's ReLUs are smoothed: without that, no plan is stationary. IPOPT gets the same objective and
gradient from JAX, the same start, and on `--exact` of the problems the exact Hessian as well.

    python experiments/11_against_ipopt.py --draw                 # the problems, once; some minutes
    python experiments/11_against_ipopt.py --n 20                 # the first 20 of them, resumable
    python experiments/11_against_ipopt.py --n 1000 --executor 2      # in two processes, or tcp://...
    python experiments/11_against_ipopt.py --explain              # the exceptions
    python experiments/11_against_ipopt.py --kinks 10             # why the ReLUs are smoothed
    python experiments/11_against_ipopt.py --calls 60             # a control call, and IPOPT until it is as good
    python experiments/11_against_ipopt.py --n 60 --exact 0 --weights experiments/weights/gns-rigid   # no snap-through
    python experiments/11_against_ipopt.py --report docs/results/against_ipopt.md     # the page of the finished rows
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import os
import platform
from concurrent.futures import Executor
from importlib.metadata import version
from pathlib import Path
from typing import Any

os.environ.setdefault("NPROC", "4")

import jax
import numpy as np

from against_ipopt.control_call import race
from against_ipopt.judge import (
    ACCURATE,
    POINTS,
    REACH,
    Contestant,
    contestant,
    explain,
    judge,
    keypoints_apart,
    kkt_residual,
    meets_all,
    rows_of,
    slopes_along,
)
from against_ipopt.page import ipopt_sections
from against_ipopt.planning_problems import (
    PlanningCase,
    ProblemMaker,
    closed_loop_cases,
    load_cases,
    other_radii,
    random_cases,
    save_cases,
)
from against_ipopt.referee import RefereeConfig
from cablejax.control.shaping import Model, load_model
from cablejax.dynamics.weights import fingerprint
from cablejax.mpc import SOLVERS
from cablejax.provenance import machine
from executors import add_option, executor_of
from pages import page_of_results, publish
from rows import MADE_ON, made_on, read_rows

FOLDER = Path("docs") / "results" / "trials" / "against_ipopt"
"""Problems and rows, kept with the repository: a thousand problems take longer than one sitting."""
CASES = "cases.npz"
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


def run(options: argparse.Namespace, cases: list[PlanningCase], folder: Path, executor: Executor | None) -> None:
    """Judges what has no row yet, until the time is up."""
    rows = rows_of(folder)
    mine = network(options.weights)
    if other := sum(row.get("weights") != mine for row in rows.read()):
        raise SystemExit(
            f"{rows.path} has {other} rows of other weights than {options.weights} has now, and a table is of one "
            f"network: give another --folder, with a copy of {options.folder / CASES}."
        )
    exact = frozenset(case.name for case in cases[: options.exact])
    # with the exact Hessian again where that was not asked for before
    short = {row["name"] for row in rows.read() if "exact" not in row} & exact
    wanted = [(case.name,) for case in cases]
    missing = set(rows.missing(wanted)) | {(name,) for name in short}
    make = functools.partial(judged, options.weights, options.folder.absolute(), exact)
    rows.run([key for key in wanted if key in missing], make, executor=executor, seconds=options.seconds)


def judged(weights: str, folder: Path, exact: frozenset[str], name: str) -> dict[str, Any]:
    """The row of one problem."""
    cases, ours = compiled(weights, folder, name in exact)
    row = judge(ours, cases[name], referees(name in exact))
    return {**row, "weights": network(weights), "machine": machine(), "threads": os.environ["NPROC"]}


@functools.lru_cache
def network(weights: str) -> str:
    """Which arrays a model has today."""
    return fingerprint(load_model(weights).weights)


@functools.lru_cache
def compiled(weights: str, folder: Path, exact: bool) -> tuple[dict[str, PlanningCase], Contestant]:
    """The problems, and ours, which has solved one: no clock sees the compilation."""
    jax.config.update("jax_enable_x64", True)
    cases, ours = known(weights, folder)
    few = [dataclasses.replace(config, max_iterations=2) for config in referees(exact)]
    judge(ours, next(iter(cases.values())), few, gradients=2)
    return cases, ours


@functools.lru_cache
def known(weights: str, folder: Path) -> tuple[dict[str, PlanningCase], Contestant]:
    """The problems in a folder, and ours for one model."""
    return {case.name: case for case in load_cases(folder / CASES)}, contestant(load_model(weights))


def explain_all(ours: Contestant, cases: list[PlanningCase], folder: Path, seconds: float) -> None:
    """Explains what is not explained yet, until the time is up."""
    explained, by_name = rows_of(folder, "explained"), {case.name: case for case in cases}
    short = {row["name"]: row for row in rows_of(folder).read() if not meets_all(row, row)}
    todo = explained.missing((name,) for name in short)
    explained.run(todo, lambda name: explain(ours, by_name[name], short[name], STARTS), seconds=seconds)


def measure_kinks(ours: Contestant, cases: list[PlanningCase], folder: Path, n: int) -> None:
    """What the corners do to the slope, and to where our solver ends, on the first problems that are judged."""
    kinks, by_name = rows_of(folder, "kinks"), {case.name: case for case in cases}
    judged = {row["name"]: row for row in rows_of(folder).read()[:n]}

    def measured(name: str) -> dict[str, Any]:
        case, row, found = by_name[name], judged[name], {}
        for kind, make in (("sharp", ours.make_sharp), ("smooth", ours.make)):
            problem, rng = make(case), np.random.default_rng([len(name), 13])
            changes = np.abs(np.diff(slopes_along(problem, np.asarray(row["motion"]), rng, REACH, POINTS)))
            end = ours.find(problem, case.guess, ACCURATE.gradients).points[-1] if kind == "sharp" else None
            kkt = row["kkt"] if end is None else kkt_residual(problem, end)
            found[kind] = {"jump": float(changes.max()), "usual": float(np.median(changes)), "kkt": kkt}
        apart = keypoints_apart(ours.make_sharp(case), ours.make(case), np.asarray(row["motion"]))
        return {**found, "apart": apart}

    kinks.run(kinks.missing((name,) for name in judged), measured)


def time_calls(model: Model, cases: list[PlanningCase], folder: Path) -> None:
    """A control call's solve and IPOPT until it is as good, on the first problems, in single precision."""
    calls, by_name = rows_of(folder, "calls"), {case.name: case for case in cases}
    with jax.enable_x64(False):
        make = ProblemMaker(model, np.float32)
        race(make, cases[0], CALLS, RefereeConfig(max_iterations=2))  # compiles, so that no clock below sees that
        todo = calls.missing((name,) for name in by_name)
        calls.run(todo, lambda name: {**race(make, by_name[name], CALLS), "machine": machine()})


def page(options: argparse.Namespace, folder: Path, n_all: int) -> str:
    """The Markdown page of what is done."""
    rows, kinks, calls, explanations = (rows_of(folder, k).read() for k in ("rows", "kinks", "calls", "explained"))
    explained = {row["name"]: row for row in explanations}
    n_exact = sum("exact" in row for row in rows)
    done = f"`--draw`, `--n {len(rows)} --exact {n_exact}`"
    for finished, option in ((explained, "explain"), (kinks, f"kinks {len(kinks)}"), (calls, f"calls {len(calls)}")):
        done += f", `--{option}`" if finished else ""
    weights = "" if options.weights == RELEASED else f" --weights {options.weights}"
    path, machines = rows_of(folder).path, ", ".join(sorted({row["machine"] for row in rows}))
    kept = any(MADE_ON in row for row in read_rows(path))
    made = made_on(path) if kept else f"Versions were not kept; {machines}."
    mine = network(options.weights)
    older = "" if all(row.get("weights") == mine for row in rows) else ", as it was released earlier,"
    lines = [
        f"{len(rows)} of {n_all} problems, in a random order, seed 0; {n_exact} of them with the exact Hessian too. "
        f"Network {options.weights}{older} with smoothed ReLUs and the residual fitted online, horizon 5, "
        f"36 unknowns, float64. Our solver: `against_ipopt.accurate.{ACCURATE}`. "
        "IPOPT: tol 1e-9 on the objective divided by its value at the start, constr_viol_tol 1e-9, "
        f"bound_relax_factor 0, adaptive mu, limited memory of 20, at most {ITERATIONS} iterations, or exact Hessian, "
        f"at most {EXACT_ITERATIONS}. Both begin at the same feasible plan.",
        "",
        *ipopt_sections(rows, explained, kinks, calls, tuple(CALLS)),
    ]
    return page_of_results(
        "Against IPOPT",
        f"`python experiments/11_against_ipopt.py{weights} --report {options.report}`, after {done}",
        lines,
        made_on=f"{made} The page: ipyopt {version('ipyopt')}; {platform.machine()}, "
        f"NPROC={'/'.join(sorted({row['threads'] for row in rows}))}. The machine had other work to do: times "
        "are inflated; only their ratios are meaningful.",
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draw", action="store_true", help="make the problems, and stop")
    parser.add_argument("--n", type=int, default=20, help="number of problems to judge, from the first on")
    parser.add_argument("--exact", type=int, default=10, help="number of problems with the exact Hessian too")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no further problem after this time")
    add_option(parser)
    parser.add_argument("--weights", default=RELEASED, help="released model by name, or the folder of a training")
    parser.add_argument("--folder", type=Path, default=FOLDER, help="folder of the problems")
    parser.add_argument("--explain", action="store_true", help="explain the exceptions")
    parser.add_argument("--kinks", type=int, help="measure the kinks on this many judged problems")
    parser.add_argument("--calls", type=int, help="time a control call and IPOPT on this many problems")
    parser.add_argument("--report", type=Path, help="write the page of the finished rows, and run nothing")
    options = parser.parse_args()
    cases_path = options.folder / CASES
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
        with executor_of(options.executor) as executor:
            run(options, cases[: options.n], folder, executor)
    text = page(options, folder, len(cases))
    publish(text, options.report)


if __name__ == "__main__":
    main()
