"""The bounded solvers against IPOPT on 1,000 planning problems, in float64, with the released network.

A quarter of the problems are what the controller asked its solver for on the way to U, S and Z with cables 0.5, 1 and 2
times as stiff as the one trained on; a quarter are the same states with another step bound; half are random shapes with
random targets. IPOPT gets the same objective and gradient from JAX, the same start, and on `--exact` of the problems
the exact Hessian as well.

    python experiments/11_against_ipopt.py --draw                 # once: the problems, some minutes
    python experiments/11_against_ipopt.py --n 20                 # the first 20 of them, resumable
    python experiments/11_against_ipopt.py --n 1000 --process 1 2 &   # the second half, beside --process 0 2
    python experiments/11_against_ipopt.py --report docs/results/against_ipopt.md     # the page, of what is done
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from pathlib import Path

os.environ.setdefault("NPROC", "4")

import jax
import numpy as np
from tqdm import tqdm

from cablejax.evaluation.against_ipopt import (
    EQUAL,
    STEPS,
    TOLERANCE,
    Contestant,
    comparable_seconds,
    contestant,
    excess,
    judge,
)
from cablejax.evaluation.planning_problems import (
    PlanningCase,
    closed_loop_cases,
    load_cases,
    other_radii,
    random_cases,
    save_cases,
)
from cablejax.evaluation.referee import RefereeConfig
from cablejax.report.provenance import machine, versions
from cablejax.shaping import load_model

FOLDER = Path("runs") / "against_ipopt"
STARTS = 8
"""Further starts for a problem on which ours is worse than IPOPT's."""


def draw(path: Path) -> None:
    """The problems, in an order in which every beginning is a fair sample."""
    model = load_model("gns-reference")
    loops = closed_loop_cases(model, ("U", "S", "Z"), (0.5, 1.0, 2.0), (0,), 28)[:250]
    cases = loops + other_radii(loops, 0) + random_cases(model, range(500))
    order = np.random.default_rng(0).permutation(len(cases))
    save_cases(path, [cases[i] for i in order])


def judged(ours: Contestant, case: PlanningCase, exact: bool) -> dict:
    """One problem by all of them, and where ours is worse, why."""
    row = judge(ours, case, [RefereeConfig(), RefereeConfig(exact=True)] if exact else [RefereeConfig()])
    theirs = min(row[which]["objective"] for which in ("limited", "exact") if which in row)
    if row["objective"] > theirs * (1 + EQUAL):
        row["explained"] = explain(ours, case, theirs, row)
    return row


def explain(ours: Contestant, case: PlanningCase, theirs: float, row: dict) -> dict:
    """Whether ours is at another local minimum: from other starts ours finds IPOPT's value, or better."""
    problem, rng = ours.make(case), np.random.default_rng([len(case.name), 12])
    found = []
    for _ in range(STARTS):
        start = rng.uniform(-1.0, 1.0, case.guess.shape) * case.radius / 3**0.5
        found.append(float(ours.find(problem, problem.feasible, start, STEPS).objectives[-1]))
    return {"multi_start": found, "reached": min(found) <= theirs * (1 + EQUAL), "stationary": row["kkt"] < 1e-5}


def run(cases: list[PlanningCase], path: Path, n_exact: int, process: tuple[int, int], seconds: float) -> None:
    """Judges what the file does not have yet, until the time is up."""
    done = {row["name"] for row in read(path.parent)}
    index, count = process
    todo = [(case, i < n_exact) for i, case in enumerate(cases) if i % count == index and case.name not in done]
    ours, began = contestant(load_model("gns-reference")), time.perf_counter()
    if todo:
        judged(ours, *todo[0])  # compiles, so that no clock below sees that
    for case, exact in tqdm(todo, unit="problem", dynamic_ncols=True):
        if time.perf_counter() - began > seconds:
            break
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(judged(ours, case, exact)) + "\n")


def read(folder: Path) -> list[dict]:
    """All finished rows."""
    lines = [line for path in sorted(folder.glob("rows-*.jsonl")) for line in path.read_text().splitlines()]
    return list({row["name"]: row for row in map(json.loads, lines)}.values())


def share(flags) -> str:
    flags = np.asarray(flags, bool)
    return f"{flags.sum()} of {len(flags)} ({100 * flags.mean():.1f} %)" if len(flags) else "none"


def quantiles(values, digits: str = ".2g") -> str:
    values = np.asarray(values, float)
    if not len(values):
        return "-"
    return " / ".join(f"{v:{digits}}" for v in (np.median(values), np.percentile(values, 95), values.max()))


def page(rows: list[dict], n_all: int) -> str:
    """The Markdown page of what is done."""
    limited, exact = ([row for row in rows if which in row] for which in ("limited", "exact"))
    lines = [
        "# Against IPOPT",
        "",
        "Made by `python experiments/11_against_ipopt.py --report docs/results/against_ipopt.md`, after "
        f"`--draw` and `--n {len(rows)}`.",
        f"{versions()}, ipyopt {_version('ipyopt')}; {machine()}; {platform.machine()}.",
        "",
        f"{len(rows)} of {n_all} problems, in a random order, seed 0; {len(exact)} of them with the exact Hessian too. "
        "Released network gns-reference with the residual fitted online, horizon 5, 36 unknowns, float64. Ours: "
        f"`BoundedLevenbergMarquardt(atol={TOLERANCE:g})`, at most {STEPS} steps. IPOPT: tol 1e-9 on the objective "
        "divided by its value at the start, constr_viol_tol 1e-9, bound_relax_factor 0, adaptive mu, "
        "limited memory of 20 or exact Hessian. Both begin at the same feasible plan.",
        "",
        "## Objective, feasibility, KKT residual",
        "",
        "| | limited memory | exact Hessian |",
        "| --- | --- | --- |",
    ]

    def both(label, function):
        lines.append(
            f"| {label} | "
            + " | ".join(function(rows, w) for rows, w in ((limited, "limited"), (exact, "exact")))
            + " |"
        )

    both("ours within 1e-6 of IPOPT's, or better", lambda rs, w: share([excess(r, w) <= EQUAL for r in rs]))
    both("ours better by more than 1e-6", lambda rs, w: share([excess(r, w) < -EQUAL for r in rs]))
    both("IPOPT ended at an optimum by its own test", lambda rs, w: share([r[w]["status"] in (0, 1) for r in rs]))
    both(
        "relative difference where within 1e-3: median / 95 % / largest",
        lambda rs, w: quantiles([excess(r, w) for r in rs if abs(excess(r, w)) < 1e-3]),
    )
    lines += [
        "",
        f"Ours feasible to 1e-8 m: {share([r['violation'] <= 1e-8 for r in rows])}; largest violation "
        f"{max(r['violation'] for r in rows):.1e} m. KKT residual below 1e-5: "
        f"{share([r['kkt'] < 1e-5 for r in rows])}; median / 95 % / largest "
        f"{quantiles([r['kkt'] for r in rows])}. Converged by its own test within {STEPS} "
        f"steps: {share([r['converged'] for r in rows])}; steps {quantiles([r['steps'] for r in rows], '.0f')}.",
        "",
        "In float32 the objective of the plan, evaluated in float64, is above that of the plan found in float64 by "
        f"{quantiles([(r['single_objective'] - r['objective']) / r['objective'] for r in rows])}, relative (median / "
        f"95 % / largest); such a plan breaks bounds by {quantiles([r['single_violation'] for r in rows])} m.",
        "",
        "## Time to an equal objective",
        "",
        "Wall time from the start to the first feasible plan within 1e-6 of the worse of both final objectives; "
        "functions compiled and warm, both called step by step from Python, in the same process. Problems on which "
        "both end within 1e-6 of each other.",
        "",
        "| | ours [s] median / 95 % / largest | IPOPT [s] | ratio of medians | median of ratios |",
        "| --- | --- | --- | --- | --- |",
    ]
    for label, which, some in (("limited memory", "limited", limited), ("exact Hessian", "exact", exact)):
        mine, theirs = comparable_seconds(some, which)
        if len(mine):
            lines.append(
                f"| {label}, {len(mine)} problems | {quantiles(mine)} | {quantiles(theirs)} | "
                f"{np.median(theirs) / np.median(mine):.1f} | {np.median(theirs / mine):.1f} |"
            )
    lines += ["", "## Exceptions, one by one", ""]
    odd = [row for row in rows if "explained" in row]
    if not odd:
        lines.append("None: on no problem is ours worse than IPOPT's by more than 1e-6.")
    for row in odd:
        which = min((w for w in ("limited", "exact") if w in row), key=lambda w: row[w]["objective"])
        said = row["explained"]
        if said["reached"]:
            verdict = f"another local minimum: of {len(said['multi_start'])} other starts one reaches IPOPT's value"
        elif said["stationary"]:
            verdict = "stationary, but no other start reached the value of IPOPT"
        else:
            verdict = "not converged"
        lines.append(
            f"- {row['name']}: ours {row['objective']:.9g}, IPOPT {row[which]['objective']:.9g} m^2 "
            f"({excess(row, which):+.1e}), KKT residual {row['kkt']:.1e}: {verdict}."
        )
    return "\n".join([*lines, ""])


def _version(name: str) -> str:
    import importlib.metadata

    return importlib.metadata.version(name)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draw", action="store_true", help="make the problems, and nothing else")
    parser.add_argument("--n", type=int, default=20, help="judge the first so many")
    parser.add_argument("--exact", type=int, default=50, help="the first so many with the exact Hessian too")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no other problem after this time")
    parser.add_argument("--process", nargs=2, type=int, default=(0, 1), metavar=("INDEX", "COUNT"))
    parser.add_argument("--folder", type=Path, default=FOLDER)
    parser.add_argument("--report", type=Path, help="run nothing; write the page on what is done to this file")
    options = parser.parse_args()
    cases_path = options.folder / "cases.npz"
    if options.draw:
        draw(cases_path)
        return
    if not cases_path.is_file():
        parser.error(f"there is no {cases_path}: make the problems first, with --draw")
    jax.config.update("jax_enable_x64", True)
    cases = load_cases(cases_path)
    if options.report is None:
        path = options.folder / f"rows-{options.process[0]}.jsonl"
        run(cases[: options.n], path, options.exact, tuple(options.process), options.seconds)
    rows = read(options.folder)
    text = page(rows, len(cases))
    print(text)
    if options.report is not None:
        options.report.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
