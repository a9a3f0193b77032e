"""Compares plans with exact and with bfloat16 slopes: objective, Jacobian and time.

The planning problems are those of experiments/11_against_ipopt.py: those that the controller gave its solver on the way
to U, S and Z, the same with other step bounds, and random shapes. They are solved in float32, by the default solver and
by the same with two trials.

    python experiments/13_rough_slopes.py                                  # the first 100 problems: some minutes
    python experiments/13_rough_slopes.py --out docs/results/rough_slopes.md
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("NPROC", "4")

import jax
import jax.numpy as jnp
import numpy as np

from against_ipopt.planning_problems import ProblemMaker, load_cases
from cablejax.control.shaping import load_model
from cablejax.mpc import SOLVERS
from cablejax.residual import Dynamics
from pages import markdown_table, page_of_results, publish

CASES = Path("docs") / "results" / "trials" / "against_ipopt" / "cases.npz"
PLANNERS = ("levenberg-marquardt", "two-trials")


@dataclasses.dataclass(frozen=True)
class ExactSlopes:
    """A model without a Jacobian of its own: every slope is the network's, in full."""

    dynamics: Dynamics

    def __call__(self, weights, history, twist):
        return self.dynamics(weights, history, twist)


def timed(function, *arguments):
    """What it gives, and how long it took [ms]."""
    begin = time.perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return result, 1e3 * (time.perf_counter() - begin)


def quantiles(values, digits: str = ".2g") -> str:
    return " / ".join(f"{value:{digits}}" for value in np.percentile(values, [5, 50, 95]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=100, help="problems")
    parser.add_argument("--weights", default="gns-reference", help="released model by name, or a training's folder")
    parser.add_argument("--out", type=Path, help="write the page there")
    options = parser.parse_args()

    model, cases = load_model(options.weights), load_cases(CASES)[: options.n]
    exact = dataclasses.replace(model, dynamics=ExactSlopes(model.dynamics))
    makers = {"exact": ProblemMaker(exact, np.float32), "rough": ProblemMaker(model, np.float32)}
    linearise = jax.jit(lambda problem, motion: problem.linearise(motion))
    functions = {"one linearisation": lambda problem, motion: linearise(problem, motion)[1]}
    for name in PLANNERS:
        functions[f"plan, {name}"] = jax.jit(
            lambda problem, guess, name=name: SOLVERS[name](problem, problem.start(guess)).value
        )

    found = {(name, kind): [] for name in functions for kind in makers}
    spent = {key: [] for key in found}
    for case in [cases[0], *cases]:  # the first call compiles
        guess = jnp.asarray(case.guess, jnp.float32)
        for name, function in functions.items():
            for kind, make in makers.items():
                value, ms = timed(function, make(case), guess)
                found[name, kind].append(np.asarray(value, np.float64))
                spent[name, kind].append(ms)
        print(f"{case.name}", file=sys.stderr, flush=True)

    rows = [["", "exact [ms]", "rough [ms]", "exact / rough", "difference: 5 % / median / 95 %", "lower / higher"]]
    for name in functions:
        (e, r), (value_e, value_r) = (
            [np.array(table[name, kind][1:]) for kind in ("exact", "rough")] for table in (spent, found)
        )
        cells = [f"{np.median(e):.0f}", f"{np.median(r):.0f}", f"{np.median(e / r):.2f}"]
        if value_e.ndim > 1:
            off = [np.linalg.norm(b - a) / np.linalg.norm(a) for a, b in zip(value_e, value_r, strict=True)]
            rows.append([name, *cells, quantiles(off), "-"])
        else:
            change = value_r / value_e - 1
            rows.append([name, *cells, quantiles(change), f"{(change < 0).sum()} / {(change > 0).sum()}"])
    page = page_of_results(
        "Slopes in bfloat16",
        f"`python experiments/13_rough_slopes.py --n {options.n} --weights {options.weights} --out {options.out}`",
        [
            f"{options.n} planning problems, {model.name} with the residual fitted online, horizon 5, float32. Both "
            "kinds take turns, so that other load on the machine affects both. Exact is `jax.jacrev` of the whole "
            "model, which also has cotangents of the grasped keypoints. The Jacobian's difference is relative to its "
            "Frobenius norm. A plan's difference is relative to the objective at its end; negative if the plan with "
            "rough slopes is better.",
            "",
            *markdown_table(rows),
        ],
    )
    publish(page, options.out)


if __name__ == "__main__":
    main()
