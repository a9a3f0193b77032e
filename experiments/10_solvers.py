"""Are the planner's solutions minima? Each problem solved by the package and by IPOPT, from the same start.

Problems come from closed-loop runs (the planning problem of every third control step, its residual and warm start
included) and from random states (a cable at rest between grippers anywhere, a letter as the target, a random guess).
Both solvers call the same objective and the same derivatives, by JAX in float64. Where the package's minimum is worse,
it starts again from other guesses, to tell another local minimum from a failure.

    python experiments/10_solvers.py                                  # a few problems
    python experiments/10_solvers.py --problems 100 --out docs/results/solvers.md
    python experiments/10_solvers.py --full                           # 1000 problems: most of a day on two cores

What is solved is kept in --work, and the same command goes on from there.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("NPROC", "4")

import ipyopt
import jax
import jax.numpy as jnp
import numpy as np

from cablejax.mpc import (
    ShapingProblem,
    TrustRegion,
    feasible_from,
    multi_start,
    planning_problem,
    random_starts,
    solve,
)
from cablejax.report.provenance import machine, versions
from cablejax.shaping import Model, initial_history, load_model, make_controller
from cablejax.simulate import CableConfig
from cablejax.simulate.elastica import ElasticaError, elastica
from cablejax.simulate.plant import Plant, PlantConfig
from cablejax.targets import make_target, straight_start
from cablejax.types import History

EXACT = TrustRegion(max_iterations=100, tolerance=1e-8, inner_iterations=300, secant=True)
"""The package's solver at float64 accuracy."""
SINGLE = TrustRegion(max_iterations=30, tolerance=2e-5, inner_iterations=60, secant=True)
"""The same in float32."""
OBJECTIVE_TOLERANCE = 1e-6
FEASIBILITY_TOLERANCE = 1e-8
KKT_TOLERANCE = 1e-5
EVERY = 3
RUN_STEPS = 30


# --- the problems -----------------------------------------------------------------------------------------------------


def closed_loop_problems(model: Model, count: int) -> list[tuple[ShapingProblem, Any]]:
    """Planning problems of every third step of runs to U, S and Z by cables of three stiffnesses, in float32."""
    found: list[tuple[ShapingProblem, Any]] = []
    for ratio in (2.0, 1.0, 0.5):
        for letter in ("U", "S", "Z"):
            cable = CableConfig(n_links=24, dimension=3, timestep=0.005)
            plant = Plant(PlantConfig(cable=cable, stiffness_ratio=ratio))
            controller = make_controller(model, make_target(letter, cable), method="residual", solver="trust-region")
            arguments = (controller.config, controller.dynamics, controller.weights, controller.target)
            take = jax.jit(functools.partial(planning_problem, *arguments[:2]))
            seen = plant.reset(straight_start(cable))
            state = controller.init(initial_history(cable, model.config))
            for step in range(RUN_STEPS):
                if step % EVERY == 0:
                    found.append(take(*arguments[2:], state, seen.keypoints, seen.gripper_pose))
                if len(found) == count:
                    return found
                state, twist, _ = controller.step(state, seen.keypoints, seen.gripper_pose)
                seen = plant.record(np.asarray(twist, float), 1.0, samples=1)[-1]
            say(f"{len(found)} problems from closed loops")
    return found


def random_problems(
    model: Model, template: ShapingProblem, count: int, seed: int = 0
) -> list[tuple[ShapingProblem, Any]]:
    """A cable at rest in a random place, a letter as the target, a random feasible guess; no residual."""
    random, found = np.random.default_rng(seed), []
    targets = [make_target(letter, CableConfig()).keypoints for letter in ("U", "S", "Z")]
    none = jax.tree.map(jnp.zeros_like, template.weights[1])
    while len(found) < count:
        distance, turns = random.uniform(0.3, 0.97), random.uniform(-1.3, 1.3, 2)
        pose = np.array([[0.0, 0.0, turns[0]], [distance, 0.0, turns[1]]])
        try:
            keypoints = elastica(pose, 1.0, CableConfig().keypoint_arclength)
        except ElasticaError:
            continue
        shift = random.uniform(-0.1, 0.1, 2)
        pose[:, :2] += shift
        history = History(
            keypoints=jnp.asarray(np.repeat((keypoints + shift)[None], model.config.history, axis=0), jnp.float32),
            gripper_pose=jnp.asarray(pose, jnp.float32),
        )
        radius = jnp.asarray(random.choice([0.05, 0.02, 0.2]), jnp.float32)
        problem = dataclasses.replace(
            template,
            weights=(template.weights[0], none),
            history=history,
            target=jnp.asarray(targets[random.integers(3)], jnp.float32),
            feasible=feasible_from(history.gripper_pose, radius, (0.15, 0.99)),
        )
        found.append((problem, random_starts(problem, 6, 1, seed=len(found))[0]))
    return found


def widened(tree: Any) -> Any:
    """Every float32 array in float64: exactly the same problem."""
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float64) if leaf.dtype == jnp.float32 else leaf, tree)


# --- the functions that both solvers call -----------------------------------------------------------------------------


@jax.jit
def value_of(problem: ShapingProblem, flat: Any) -> Any:
    return problem.value(flat.reshape(-1, 2, 3))


gradient_of = jax.jit(jax.grad(value_of, argnums=1))
hessian_of = jax.jit(jax.hessian(value_of, argnums=1))


@jax.jit
def constraints_of(problem: ShapingProblem, flat: Any) -> Any:
    return problem.feasible.constraints(flat)


constraint_slopes_of = jax.jit(jax.jacfwd(constraints_of, argnums=1))


@jax.jit
def constraint_bend_of(problem: ShapingProblem, flat: Any, multipliers: Any) -> Any:
    return jax.hessian(lambda flat: jnp.vdot(multipliers, problem.feasible.constraints(flat)))(flat)


@jax.jit
def ours(problem: ShapingProblem, guess: Any) -> Any:
    solution = solve(problem, EXACT, guess)
    return solution, solution.certificate()


@jax.jit
def ours_from(problem: ShapingProblem, guesses: Any) -> Any:
    return multi_start(problem, EXACT, guesses)[0]


@jax.jit
def ours_single(problem: ShapingProblem, guess: Any) -> Any:
    return solve(problem, SINGLE, guess).motion


def ipopt(problem: ShapingProblem, guess: Any, *, exact: bool) -> dict[str, Any]:
    """IPOPT on the same problem; the limited-memory Hessian where `exact` is false."""
    start = np.asarray(problem.feasible.project(guess), float).ravel()
    size, count = start.size, int(constraints_of(problem, start).size)
    rows, columns = np.divmod(np.arange(count * size), size)
    lower_rows, lower_columns = np.tril_indices(size)
    calls = {"value": 0, "gradient": 0, "hessian": 0}

    def eval_f(x):
        calls["value"] += 1
        return float(value_of(problem, x))

    def eval_grad_f(x, out):
        calls["gradient"] += 1
        out[()] = np.asarray(gradient_of(problem, x))

    def eval_g(x, out):
        out[()] = np.asarray(constraints_of(problem, x))

    def eval_jac_g(x, out):
        out[()] = np.asarray(constraint_slopes_of(problem, x)).ravel()

    def eval_h(x, multipliers, factor, out):
        calls["hessian"] += 1
        matrix = factor * np.asarray(hessian_of(problem, x)) + np.asarray(constraint_bend_of(problem, x, multipliers))
        out[()] = matrix[lower_rows, lower_columns]

    nlp = ipyopt.Problem(
        size,
        np.full(size, -1e19),
        np.full(size, 1e19),
        count,
        np.full(count, -1e19),
        np.zeros(count),
        (rows, columns),
        (lower_rows, lower_columns),
        eval_f,
        eval_grad_f,
        eval_g,
        eval_jac_g,
        eval_h if exact else None,
        ipopt_options={
            "tol": 1e-9,
            "acceptable_iter": 0,
            "max_iter": 500,
            "bound_relax_factor": 0.0,
            "print_level": 0,
            "sb": "yes",
            "hessian_approximation": "exact" if exact else "limited-memory",
        },
    )
    began, cpu = time.perf_counter(), time.process_time()
    x, value, status = nlp.solve(start.copy())
    return {
        "value": float(value),
        "status": int(status),
        "violation": float(max(np.asarray(constraints_of(problem, x)).max(), 0.0)),
        "wall_s": time.perf_counter() - began,
        "cpu_s": time.process_time() - cpu,
        "calls": calls,
    }


# --- one problem ------------------------------------------------------------------------------------------------------


def judged(index: int, kind: str, single: ShapingProblem, guess32: Any, *, exact: bool) -> dict[str, Any]:
    """Everything that is measured on one problem; JSON."""
    problem, guess = widened(single), widened(guess32)
    began, cpu = time.perf_counter(), time.process_time()
    solution, certificate = jax.block_until_ready(ours(problem, guess))
    row: dict[str, Any] = {
        "index": index,
        "kind": kind,
        "start_value": float(value_of(problem, problem.feasible.project(guess).ravel())),
        "ours": {
            "value": float(solution.value),
            "outcome": int(solution.outcome),
            "violation": float(certificate.violation),
            "kkt": float(certificate.residual),
            "active": int(certificate.active.sum()),
            "iterations": int(solution.plan.evaluations),
            "linearisations": int(solution.plan.linearisations),
            "wall_s": time.perf_counter() - began,
            "cpu_s": time.process_time() - cpu,
        },
        "limited": ipopt(problem, guess, exact=False),
    }
    if exact:
        row["exact"] = ipopt(problem, guess, exact=True)
    best = min(row[name]["value"] for name in ("limited", "exact") if name in row)
    if row["ours"]["value"] > best * (1 + OBJECTIVE_TOLERANCE):
        starts = jnp.concatenate([guess[None], widened(random_starts(problem, len(guess), 3, seed=index))])
        row["multi_start"] = float(ours_from(problem, starts).value)
    with jax.enable_x64(False):
        motion = np.asarray(ours_single(single, guess32))
    row["single_value"] = float(value_of(problem, np.asarray(motion, float).ravel()))
    return row


def warmed_up(problem: ShapingProblem, guess: Any) -> None:
    """Compiles everything, so that no problem pays for it."""
    problem, guess = widened(problem), widened(guess)
    flat = np.asarray(problem.feasible.project(guess), float).ravel()
    jax.block_until_ready(ours(problem, guess))
    for function in (value_of, gradient_of, hessian_of, constraints_of, constraint_slopes_of):
        jax.block_until_ready(function(problem, flat))
    jax.block_until_ready(constraint_bend_of(problem, flat, np.ones(constraints_of(problem, flat).size)))


# --- the page ---------------------------------------------------------------------------------------------------------


def best_of_ipopt(row: dict[str, Any]) -> float:
    """The lower of IPOPT's values that is feasible."""
    runs = [row[name] for name in ("exact", "limited") if name in row]
    fine = [run["value"] for run in runs if run["violation"] <= FEASIBILITY_TOLERANCE]
    return min(fine, default=min(run["value"] for run in runs))


def verdict(row: dict[str, Any]) -> str:
    """ "agrees" or "better", or why not."""
    mine, reference = row["ours"], best_of_ipopt(row)
    if mine["violation"] > FEASIBILITY_TOLERANCE:
        return "infeasible"
    excess = mine["value"] / reference - 1.0
    if excess > OBJECTIVE_TOLERANCE:
        if mine["kkt"] > KKT_TOLERANCE:
            return "not converged"
        found = row.get("multi_start", np.inf) <= reference * (1 + OBJECTIVE_TOLERANCE)
        return "another minimum" if found else "another minimum, not found by multi-start"
    if mine["kkt"] > KKT_TOLERANCE:
        return "KKT residual"
    return "better" if excess < -OBJECTIVE_TOLERANCE else "agrees"


def page(rows: list[dict[str, Any]], command: str) -> str:
    """The results as Markdown."""
    verdicts = [verdict(row) for row in rows]
    good = sum(v in ("agrees", "better") for v in verdicts)
    counted = {v: verdicts.count(v) for v in sorted(set(verdicts))}
    kkt = np.array([row["ours"]["kkt"] for row in rows])
    violation = np.array([row["ours"]["violation"] for row in rows])
    loss = np.array([row["single_value"] / min(row["ours"]["value"], best_of_ipopt(row)) - 1 for row in rows])
    lines = [
        "# The planner's solver against IPOPT",
        "",
        f"Made by `{command}`.",
        f"{versions()}; {machine()}.",
        "",
        f"{len(rows)} planning problems of the full-size model, horizon 5, 36 unknowns: "
        + ", ".join(f"{sum(row['kind'] == kind for row in rows)} {kind}" for kind in ("closed loop", "random state"))
        + ". Both solvers start from the same guess and call the same functions in float64; IPOPT runs to 1e-9, with a "
        "limited-memory Hessian on every problem and with the exact one on "
        f"{sum('exact' in row for row in rows)}. A problem counts as solved if the objective is at most "
        f"{OBJECTIVE_TOLERANCE:g} (relative) above the better of IPOPT's, the plan feasible to "
        f"{FEASIBILITY_TOLERANCE:g} m and the KKT residual below {KKT_TOLERANCE:g}.",
        "",
        f"**{good} of {len(rows)} solved ({100 * good / len(rows):.1f} %).** "
        + "; ".join(f"{name}: {count}" for name, count in counted.items())
        + ".",
        "",
        "| | median | 95th percentile | worst |",
        "| --- | --- | --- | --- |",
        _row("KKT residual", kkt, "{:.1e}"),
        _row("violation [m]", violation, "{:.1e}"),
        _row("active bounds", np.array([row["ours"]["active"] for row in rows]), "{:.0f}"),
        _row("trial plans", np.array([row["ours"]["iterations"] for row in rows]), "{:.0f}"),
        _row("linearisations", np.array([row["ours"]["linearisations"] for row in rows]), "{:.0f}"),
        _row("loss of objective in float32, relative", loss, "{:.1e}"),
        "",
        "## Cost",
        "",
        "CPU seconds of the process, both cores added: other programs ran beside this one, so wall times say little.",
        "",
        "| solver | problems | CPU seconds, median | over ours, median of ratios | gradients | Hessians |",
        "| --- | --- | --- | --- | --- | --- |",
        f"| ours | {len(rows)} | {np.median([row['ours']['cpu_s'] for row in rows]):.2f} | 1 | | |",
    ]
    for name, title in (("limited", "IPOPT, limited memory"), ("exact", "IPOPT, exact Hessian")):
        some = [row for row in rows if name in row]
        if some:
            ratio = np.median([row[name]["cpu_s"] / row["ours"]["cpu_s"] for row in some])
            cpu, gradients, hessians = (
                np.median([row[name]["cpu_s"] for row in some]),
                *(np.median([row[name]["calls"][key] for row in some]) for key in ("gradient", "hessian")),
            )
            lines.append(f"| {title} | {len(some)} | {cpu:.2f} | {ratio:.1f} | {gradients:.0f} | {hessians:.0f} |")
    rest = [(row, v) for row, v in zip(rows, verdicts, strict=True) if v not in ("agrees", "better")]
    if rest:
        lines += [
            "",
            "## The rest, one by one",
            "",
            "| problem | kind | ours | IPOPT, best | ours from four starts | KKT residual | verdict |",
            "| --- | --- | --- | --- | --- | --- | --- |",
        ]
        lines += [
            f"| {row['index']} | {row['kind']} | {row['ours']['value']:.8g} | {best_of_ipopt(row):.8g} | "
            f"{row.get('multi_start', float('nan')):.8g} | {row['ours']['kkt']:.1e} | {v} |"
            for row, v in rest
        ]
    return "\n".join([*lines, ""])


def _row(name: str, values: np.ndarray, form: str) -> str:
    cells = (np.median(values), np.percentile(values, 95), values.max())
    return f"| {name} | " + " | ".join(form.format(cell) for cell in cells) + " |"


def say(message: str) -> None:
    print(message, file=sys.stderr, flush=True)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", default="gns-reference", help="released name, weights file or training's folder")
    parser.add_argument("--problems", type=int, default=6, help="half from closed loops, half from random states")
    parser.add_argument("--full", action="store_true", help="1000 problems")
    parser.add_argument("--exact-every", type=int, default=5, help="IPOPT with the exact Hessian on every so many")
    parser.add_argument("--work", type=Path, default=Path("runs/solvers"), help="what is solved is kept there")
    parser.add_argument("--out", type=Path, help="write the page there as Markdown")
    parser.add_argument("--report-only", action="store_true", help="the page of what is done so far")
    options = parser.parse_args(arguments)
    count = 1000 if options.full else options.problems
    if count < 2 or options.exact_every < 1:
        parser.error("--problems must be at least 2, and --exact-every at least 1")
    options.work.mkdir(parents=True, exist_ok=True)
    kept = options.work / f"{Path(options.weights).name}-{count}.jsonl"
    rows = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    if not options.report_only:
        solve_all(options, count, rows, kept)
    command = "python experiments/10_solvers.py " + " ".join(sys.argv[1:] if arguments is None else arguments)
    text = page(sorted(rows, key=lambda row: row["index"]), command.strip())
    print(text)
    if options.out is not None:
        options.out.write_text(text, encoding="utf-8")


def solve_all(options: argparse.Namespace, count: int, rows: list[dict[str, Any]], kept: Path) -> None:
    """Solves what is not yet solved, and keeps each result as soon as it is there."""
    done = {row["index"] for row in rows}
    if len(done) >= count:
        return
    model = load_model(options.weights)
    loops = closed_loop_problems(model, count // 2)
    states = random_problems(model, loops[0][0], count - len(loops))
    # alternately, so that what is done after an interruption is of both kinds
    problems = [(2 * k, "closed loop", *pair) for k, pair in enumerate(loops)]
    problems += [(2 * k + 1, "random state", *pair) for k, pair in enumerate(states)]
    problems.sort(key=lambda item: item[0])
    with jax.enable_x64(True):
        warmed_up(*problems[0][2:])
        for place, (index, kind, problem, guess) in enumerate(problems):
            if index in done:
                continue
            row = judged(index, kind, problem, guess, exact=place % options.exact_every == 0)
            rows.append(row)
            with kept.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
            say(f"{len(rows)} of {count}: {verdict(row)}, {row['ours']['linearisations']} linearisations, "
                f"{row['ours']['cpu_s']:.1f} s against {row['limited']['cpu_s']:.1f} s")  # fmt: skip


if __name__ == "__main__":
    main()
