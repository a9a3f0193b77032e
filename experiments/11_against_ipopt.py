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
from pathlib import Path

os.environ.setdefault("NPROC", "4")

import jax
import numpy as np
from tqdm import tqdm

from cablejax.dynamics.smooth import CORNER
from cablejax.evaluation.against_ipopt import (
    ACCURATE,
    EQUAL,
    STATIONARY,
    Contestant,
    comparable_seconds,
    contestant,
    excess,
    judge,
    keypoints_apart,
    kkt_residual,
    slopes_along,
    steepness,
)
from cablejax.evaluation.control_call import improved, race, ratios
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
from cablejax.report.provenance import machine, versions
from cablejax.shaping import Model, load_model

FOLDER = Path("docs") / "results" / "trials" / "against_ipopt"
"""Problems and rows, kept with the repository: a thousand problems take longer than one sitting."""
RELEASED = "gns-reference"
STARTS = 4
"""Further starts for a problem on which ours is worse than IPOPT's."""
ITERATIONS, EXACT_ITERATIONS = 200, 60
"""Of IPOPT at most, with limited memory and with the exact Hessian, of which one costs as much as ten gradients."""
STEEP = 50.0
"""Largest singular value of the residuals' Jacobian above which a plan leads through a snap-through."""
CALLS = {name: SOLVERS[name] for name in ("trust-region", "deadline")}
"""What a control call solves with."""
REACH, POINTS = 1e-5, 101
"""How far along a direction the slope is looked at, to either side [m], and at how many points."""


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


def explain(ours: Contestant, case: PlanningCase, row: dict) -> dict:
    """How steep the model is at the plans; and, where IPOPT's is better, where ours ends from other starts and from
    IPOPT's plan: whether it is at another local minimum."""
    problem, rng = ours.make(case), np.random.default_rng([len(case.name), 12])
    theirs = better_referee(row)
    steep = {
        "name": case.name,
        "steepness": steepness(problem, np.asarray(row["motion"])),
        "their_steepness": steepness(problem, np.asarray(theirs["motion"])),
    }
    if not worse(row):
        return steep
    sizes = rng.uniform(-1.0, 1.0, (STARTS, *case.guess.shape)) * case.radius / 3**0.5
    starts = [*sizes, np.asarray(theirs["motion"])]
    paths = [ours.find(problem, start, ACCURATE.gradients) for start in starts]
    values, good = [float(path.objectives[-1]) for path in paths], theirs["objective"] * (1 + EQUAL)
    return {
        **steep,
        "multi_start": values[:-1],
        "from_theirs": values[-1],
        "from_theirs_kkt": kkt_residual(problem, paths[-1].points[-1]),
        "apart": float(np.linalg.norm(paths[-1].points[-1] - np.asarray(row["motion"]), axis=-1).max()),
        "reached": min(values[:-1]) <= good,
        "reached_from_theirs": values[-1] <= good,
    }


def better_referee(row: dict) -> dict:
    """What the referee with the lower objective found."""
    return min((row[which] for which in ("limited", "exact") if which in row), key=lambda found: found["objective"])


def worse(row: dict) -> bool:
    return row["objective"] > better_referee(row)["objective"] * (1 + EQUAL)


def exceptional(row: dict) -> bool:
    return worse(row) or row["kkt"] >= STATIONARY


def run(
    ours: Contestant, cases: list[PlanningCase], path: Path, n_exact: int, process: tuple[int, int], seconds: float
) -> None:
    """Judges what the file does not have yet, until the time is up."""
    done = {row["name"]: "exact" in row for row in read(path.parent)}
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
    known, by_name = {row["name"] for row in read(folder, "explained")}, {case.name: case for case in cases}
    todo = [row for row in read(folder) if exceptional(row) and row["name"] not in known]
    began = time.perf_counter()
    for row in tqdm(todo, unit="problem", dynamic_ncols=True):
        if time.perf_counter() - began > seconds:
            break
        with (folder / "explained-0.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(explain(ours, by_name[row["name"]], row)) + "\n")


def measure_kinks(ours: Contestant, cases: list[PlanningCase], folder: Path, n: int) -> None:
    """What the corners do to the slope, and to where our solver ends, on the first problems that are judged."""
    done, by_name = {row["name"] for row in read(folder, "kinks")}, {case.name: case for case in cases}
    for row in tqdm(read(folder)[:n], unit="problem", dynamic_ncols=True):
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
    done = {row["name"] for row in read(folder, "calls")}
    with jax.enable_x64(False):
        make = ProblemMaker(model, np.float32)
        race(make, cases[0], CALLS, RefereeConfig(max_iterations=2))  # compiles, so that no clock below sees that
        for case in tqdm([case for case in cases if case.name not in done], unit="problem", dynamic_ncols=True):
            with (folder / "calls-0.jsonl").open("a", encoding="utf-8") as file:
                file.write(json.dumps({**race(make, case, CALLS), "machine": machine()}) + "\n")


def read(folder: Path, kind: str = "rows") -> list[dict]:
    """All finished rows of a kind, "rows" or "explained"."""
    lines = [line for path in sorted(folder.glob(f"{kind}-*.jsonl")) for line in path.read_text().splitlines()]
    return list({row["name"]: row for row in map(json.loads, lines)}.values())


def share(flags) -> str:
    flags = np.asarray(flags, bool)
    return f"{flags.sum()} of {len(flags)} ({100 * flags.mean():.1f} %)" if len(flags) else "none"


def quantiles(values, digits: str = ".2g") -> str:
    values = np.asarray(values, float)
    if not len(values):
        return "-"
    return " / ".join(f"{v:{digits}}" for v in (np.median(values), np.percentile(values, 95), values.max()))


def page(
    weights: str,
    rows: list[dict],
    explained: dict[str, dict],
    kinks: list[dict],
    calls: list[dict],
    n_all: int,
    out: str,
) -> str:
    """The Markdown page of what is done."""
    limited, exact = ([row for row in rows if which in row] for which in ("limited", "exact"))
    lines = [
        "# Against IPOPT",
        "",
        f"Made by `python experiments/11_against_ipopt.py{'' if weights == RELEASED else f' --weights {weights}'} "
        f"--report {out}`, after `--draw`, `--n {len(rows)} --exact {len(exact)}`"
        f"{', `--explain`' if explained else ''}{f', `--kinks {len(kinks)}`' if kinks else ''}"
        f"{f', `--calls {len(calls)}`' if calls else ''}.",
        f"{versions()}, ipyopt {_version('ipyopt')}; {', '.join(sorted({row['machine'] for row in rows}))}; "
        f"{platform.machine()}, NPROC={'/'.join(sorted({row['threads'] for row in rows}))}. The machine had other work "
        "to do meanwhile: seconds are long, and say something only beside each other.",
        "",
        f"{len(rows)} of {n_all} problems, in a random order, seed 0; {len(exact)} of them with the exact Hessian too. "
        f"Network {weights}, the corners of its ReLUs rounded, with the residual fitted online, horizon 5, "
        f"36 unknowns, float64. Ours: `mpc.{ACCURATE}`. "
        "IPOPT: tol 1e-9 on the objective divided by its value at the start, constr_viol_tol 1e-9, "
        f"bound_relax_factor 0, adaptive mu, limited memory of 20, at most {ITERATIONS} iterations, or exact Hessian, "
        f"at most {EXACT_ITERATIONS}. "
        "Both begin at the same feasible plan.",
        "",
        *_why_rounded(rows, kinks),
        "",
        "## What the KKT residual is",
        "",
        "The objective is in m^2 and the plan in m, so its gradient and the residual are in m. The absolute residual "
        "is the worst element of `gradient + multipliers x normals`, of the excess over a bound and of multiplier x "
        "slack: below 1e-5 m, moving a gripper by 1 mm promises no more than 1e-8 m^2. IPOPT's `tol` asks the same of "
        "the objective divided by its value at the start (and by more where the gradient would be above 100): that is "
        "the scaled residual, in 1/m. Where the start is near the target the absolute one is easy to meet and the "
        "scaled one is not; the third row is relative to the largest element of the gradient at the start.",
        "",
        "| KKT residual, median / 95 % / largest | ours | IPOPT, limited memory | IPOPT, exact Hessian |",
        "| --- | --- | --- | --- |",
    ]

    def residuals(label, function):
        parts = [quantiles([function(r, r) for r in rows])]
        parts += [quantiles([function(r[w], r) for r in rs]) for rs, w in ((limited, "limited"), (exact, "exact"))]
        lines.append(f"| {label} | " + " | ".join(parts) + " |")

    residuals("absolute [m]", lambda found, row: found["kkt"])
    residuals("scaled by the objective at the start [1/m]", lambda found, row: found["kkt_scaled"])
    residuals("relative to the gradient at the start", lambda found, row: found["kkt"] / row["start_slope"])
    below = [share([r["kkt"] < STATIONARY for r in rows])]
    below += [share([r[w]["kkt"] < STATIONARY for r in rs]) for rs, w in ((limited, "limited"), (exact, "exact"))]
    lines += [
        "| absolute below 1e-5 m | " + " | ".join(below) + " |",
        "",
        "## Objective and feasibility",
        "",
        "| | limited memory | exact Hessian |",
        "| --- | --- | --- |",
    ]

    def both(label, function):
        cells = (function(rs, w) for rs, w in ((limited, "limited"), (exact, "exact")))
        lines.append(f"| {label} | " + " | ".join(cells) + " |")

    both("ours within 1e-6 of IPOPT's, or better", lambda rs, w: share([excess(r, w) <= EQUAL for r in rs]))
    both("ours within 1e-4, or better", lambda rs, w: share([excess(r, w) <= 1e-4 for r in rs]))
    both("ours better by more than 1e-6", lambda rs, w: share([excess(r, w) < -EQUAL for r in rs]))
    both("ours better by more than 1e-4", lambda rs, w: share([excess(r, w) < -1e-4 for r in rs]))
    both("IPOPT ended at an optimum by its own test", lambda rs, w: share([r[w]["status"] in (0, 1) for r in rs]))
    both(
        "of those, ours within 1e-6 or better",
        lambda rs, w: share([excess(r, w) <= EQUAL for r in rs if r[w]["status"] in (0, 1)]),
    )
    both("IPOPT used up its iterations", lambda rs, w: share([r[w]["status"] == -1 for r in rs]))
    if all(r["name"] in explained for r in rows if worse(r)):
        best = [not worse(r) or explained[r["name"]]["reached"] for r in rows]
        lines += [
            "",
            f"By the best of {1 + STARTS} starts (the others at random, tried where the first is worse) ours is within "
            f"1e-6 of every IPOPT's, or better, on {share(best)}.",
        ]
    all_met = [max(excess(r, w) for w in ("limited", "exact") if w in r) <= EQUAL for r in rows]
    met = [a and r["violation"] <= 1e-8 and r["kkt"] < STATIONARY for a, r in zip(all_met, rows, strict=True)]
    lines += [
        "",
        f"All three at once (within 1e-6 of every IPOPT's or better, feasible to 1e-8 m, KKT residual below 1e-5 m): "
        f"{share(met)}.",
        "",
        f"Ours feasible to 1e-8 m: {share([r['violation'] <= 1e-8 for r in rows])}; largest violation "
        f"{max(r['violation'] for r in rows):.1e} m, IPOPT's {max(r['limited']['violation'] for r in limited):.1e} m. "
        f"Converged by its own test: {share([r['converged'] for r in rows])}; "
        f"{quantiles([r['steps'] for r in rows], '.0f')} steps of both parts (median / 95 % / largest).",
        "",
        "In float32 the objective of the plan, evaluated in float64, is above that of the plan found in float64 by "
        f"{quantiles([(r['single_objective'] - r['objective']) / r['objective'] for r in rows])}, relative (median / "
        f"95 % / largest); such a plan breaks bounds by {quantiles([r['single_violation'] for r in rows])} m.",
        "",
        "## Time to an equal objective",
        "",
        "Wall time from the start to the first feasible plan within 1e-6 of the worse of both final objectives; "
        "functions compiled and warm, both called step by step from Python, in the same process. First the problems "
        "on which both end within 1e-6 of each other, then all.",
        "",
        "| | ours [s] median / 95 % / largest | IPOPT [s] | ratio of medians | median of ratios |",
        "| --- | --- | --- | --- | --- |",
    ]
    for label, which, some in (("limited memory", "limited", limited), ("exact Hessian", "exact", exact)):
        for equal, where in ((EQUAL, "equal ends"), (np.inf, "all")):
            mine, theirs = comparable_seconds(some, which, equal)
            if len(mine):
                lines.append(
                    f"| {label}, {where}: {len(mine)} problems | {quantiles(mine)} | {quantiles(theirs)} | "
                    f"{np.median(theirs) / np.median(mine):.1f} | {np.median(theirs / mine):.1f} |"
                )
    lines += [*_calls(calls), "", "## Exceptions, one by one", "", *_exceptions(rows, explained)]
    return "\n".join([*lines, ""])


def _calls(calls: list[dict]) -> list[str]:
    """The section on what a control call reaches."""
    if not calls:
        return []
    lines = [
        "",
        "## A control call",
        "",
        f"On the first {len(calls)} problems, of the network as it was trained, in float32: the solve of a control "
        "call, compiled as a whole, and IPOPT (limited memory) with the same compiled objective and gradient, from the "
        "same start, until its first feasible plan that is as good to 1e-6. Problems whose start a solver does not "
        f"improve are left out. {', '.join(sorted({row['machine'] for row in calls}))}.",
        "",
        "| | ours [ms] median / 95 % / largest | IPOPT [ms], where it came as far | IPOPT never as good | ratio of "
        "times, median (quarter, three quarters) |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name in CALLS:
        ratio, counted = ratios(calls, name), improved(calls, name)
        theirs = [one["ipopt_seconds"] for one in counted if one["ipopt_seconds"] is not None]
        low, middle, high = np.quantile(ratio, [0.25, 0.5, 0.75], method="inverted_cdf")
        lines.append(
            f"| {name}: {len(ratio)} problems | {quantiles([1e3 * one['seconds'] for one in counted], '.0f')} | "
            f"{quantiles([1e3 * s for s in theirs], '.0f')} | {int(np.isinf(ratio).sum())} | {middle:.1f} ({low:.1f}, "
            f"{high:.1f}) |"
        )
    return lines


def _why_rounded(rows: list[dict], kinks: list[dict]) -> list[str]:
    changes = [abs(r["sharp_objective"] - r["objective"]) / r["objective"] for r in rows]
    lines = [
        "## Why the corners are rounded",
        "",
        "By the network as it was trained the objective has a kink wherever one of the million ReLUs of a rollout "
        "passes zero. Minima lie on kinks, where no gradient vanishes: a solver cannot end there with a small KKT "
        f"residual. Rounded within {CORNER:g} of zero (`cablejax.dynamics.smooth`), the objective of the network is "
        "twice differentiable; at our plans its value differs from the trained network's by "
        f"{quantiles(changes)}, relative (median / 95 % / largest).",
    ]
    if kinks:
        lines += [
            "",
            f"Slope of the objective along a random direction through our plan, at {POINTS} points over "
            f"{1e6 * REACH:.0f} um to either side, and where our solver ends from the same start, on {len(kinks)} "
            "problems (median / 95 % / largest). The keypoints that both networks predict over the horizon are at most "
            f"{quantiles([1e6 * row['apart'] for row in kinks])} um apart.",
            "",
            "| | as trained | rounded |",
            "| --- | --- | --- |",
        ]
        labels = {
            "jump": "largest change of the slope between neighbouring points [m]",
            "usual": "usual (median) change [m]",
            "kkt": "absolute KKT residual at the end [m]",
        }
        for key, label in labels.items():
            cells = (quantiles([row[kind][key] for row in kinks]) for kind in ("sharp", "smooth"))
            lines.append(f"| {label} | " + " | ".join(cells) + " |")
        below = (share([row[kind]["kkt"] < STATIONARY for row in kinks]) for kind in ("sharp", "smooth"))
        lines.append("| KKT residual below 1e-5 m | " + " | ".join(below) + " |")
    return lines


def _exceptions(rows: list[dict], explained: dict[str, dict]) -> list[str]:
    lines = []
    for row in rows:
        theirs, said = better_referee(row), explained.get(row["name"])
        if not exceptional(row):
            continue
        if row["kkt"] >= STATIONARY:
            verdict = "ended by its own test, above 1e-5" if row["converged"] else "not converged"
            if said is not None and max(said["steepness"], said["their_steepness"]) > STEEP:
                verdict += (
                    ", on the verge of a snap-through: the largest singular value of the residuals' Jacobian is "
                    f"{said['steepness']:.0f} at our plan, {said['their_steepness']:.0f} at IPOPT's"
                )
        elif said is None:
            verdict = "stationary; not looked into"
        elif said["reached"]:
            verdict = f"another local minimum: of {len(said['multi_start'])} other starts one leads to IPOPT's value"
        elif said["reached_from_theirs"] and said["from_theirs_kkt"] < STATIONARY:
            verdict = (
                "another local minimum: from IPOPT's plan ours ends at a stationary one as good, "
                f"{1e3 * said['apart']:.1f} mm from the first; none of {len(said['multi_start'])} other starts leads "
                "there"
            )
        else:
            verdict = "stationary, and from neither other starts nor IPOPT's plan does ours end as low and stationary"
        difference = (row["objective"] - theirs["objective"]) / theirs["objective"]
        lines.append(
            f"- {row['name']}: ours {row['objective']:.9g}, IPOPT {theirs['objective']:.9g} m^2 ({difference:+.1e}), "
            f"KKT residual {row['kkt']:.1e} m, IPOPT's {theirs['kkt']:.1e} m: {verdict}."
        )
    return lines or ["None."]


def _version(name: str) -> str:
    import importlib.metadata

    return importlib.metadata.version(name)


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
    explained = {row["name"]: row for row in read(folder, "explained")}
    rows, kinks, calls = (read(folder, kind) for kind in ("rows", "kinks", "calls"))
    text = page(options.weights, rows, explained, kinks, calls, len(cases), str(options.report))
    print(text)
    if options.report is not None:
        options.report.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
