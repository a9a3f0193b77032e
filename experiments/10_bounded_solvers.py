"""Compares the bounded solvers with scipy's on standard problems.

The problems are those of NIST, Hock and Schittkowski, More, Garbow and Hillstrom, Rosenbrock, and an ideal rod. scipy's
solvers are `least_squares` (trf and dogbox), L-BFGS-B and SLSQP, from the same starts, with derivatives from JAX in
float64. A solver has succeeded if its point is feasible to 1e-8 and its objective within 1e-6 of the best known.

    python experiments/10_bounded_solvers.py --family Rosenbrock       # one family: a minute
    python experiments/10_bounded_solvers.py --out docs/results/bounded_solvers.md    # all of them; resumable
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("NPROC", "4")

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

from cablejax.bounded import (
    BoundedDogleg,
    BoundedGaussNewton,
    BoundedLevenbergMarquardt,
    BoundedQuasiNewton,
    Result,
    SpectralProjectedGradient,
    least_squares,
    minimise,
)
from pages import markdown_table, page_of_results, publish
from rows import Rows, made_on
from standard_problems import BoundedProblem, all_problems

TOLERANCE = 1e-10
"""Of ours: largest element of the projected gradient."""
TIGHT = 1e-14
"""Of scipy's relative tests on objective and step; its gradient test is as ours."""
LEAST_SQUARES_STEPS = 1000
GRADIENT_STEPS = 20000
OURS = {
    "Levenberg-Marquardt": BoundedLevenbergMarquardt(atol=TOLERANCE),
    "dogleg": BoundedDogleg(atol=TOLERANCE),
    "Gauss-Newton": BoundedGaussNewton(atol=TOLERANCE),
    "quasi-Newton": BoundedQuasiNewton(atol=TOLERANCE),
    "spectral gradient": SpectralProjectedGradient(atol=TOLERANCE),
}
BY_GRADIENTS = ("quasi-Newton", "spectral gradient")
"""Those for any function, not only for sums of squares."""
SCIPYS = ("scipy trf", "scipy dogbox", "scipy L-BFGS-B", "scipy SLSQP")
SOLVERS = (*OURS, *SCIPYS)


@dataclasses.dataclass(frozen=True)
class Run:
    """One solver on one problem."""

    problem: str
    family: str
    solver: str
    solved: bool
    objective: float
    optimum: float
    violation: float
    iterations: int
    evaluations: int
    said: str


@functools.cache
def compiled(solver: str, residuals: Callable | None, function: Callable | None) -> Callable:
    """One of our solvers on one function; bounds and start are traced, so that they do not compile again."""
    if residuals is not None:
        steps = GRADIENT_STEPS if solver in BY_GRADIENTS else LEAST_SQUARES_STEPS
        solve = functools.partial(least_squares, lambda y, _: residuals(y).ravel(), OURS[solver], max_steps=steps)
    else:
        assert function is not None
        solve = functools.partial(minimise, lambda y, _: function(y), OURS[solver], max_steps=GRADIENT_STEPS)
    return jax.jit(functools.partial(solve, throw=False))


@functools.cache
def derivatives(residuals: Callable | None, function: Callable | None, shape: tuple[int, ...]) -> tuple:
    """Objective with gradient, residuals, Jacobian; all of a flat point."""
    if residuals is None:
        assert function is not None
        return jax.jit(jax.value_and_grad(lambda y: function(y.reshape(shape)))), None, None

    def flat(y):
        return residuals(y.reshape(shape)).ravel()

    return jax.jit(jax.value_and_grad(lambda y: 0.5 * jnp.sum(flat(y) ** 2))), jax.jit(flat), jax.jit(jax.jacfwd(flat))


def applies(solver: str, problem: BoundedProblem) -> bool:
    """Whether a solver is made for such a problem."""
    if solver in OURS:
        return problem.is_least_squares or solver in BY_GRADIENTS
    if solver in ("scipy trf", "scipy dogbox"):
        return problem.is_least_squares and problem.is_box
    return problem.is_box or solver != "scipy L-BFGS-B"


def ours(problem: BoundedProblem, solver: str) -> Run:
    """One of our solvers on a problem that it applies to."""
    solve = compiled(solver, problem.residuals, problem.function)
    out = solve(jnp.asarray(problem.start), problem.feasible())
    said = Result(int(out.result)).name
    stats = out.stats
    return verdict(problem, solver, np.asarray(out.value), int(stats.iterations), int(stats.evaluations), said)


def scipys(problem: BoundedProblem, solver: str) -> Run:
    """One of scipy's solvers on a problem that it applies to."""
    method = solver.split()[1]
    shape = problem.start.shape
    both, residuals, jacobian = derivatives(problem.residuals, problem.function, shape)
    start = problem.start.ravel().astype(float)
    lower, upper = np.full(start.shape, -np.inf), np.full(start.shape, np.inf)
    if problem.lower is not None and problem.upper is not None:
        lower, upper = np.ravel(problem.lower), np.ravel(problem.upper)
        start = np.clip(start, lower, upper)

    def value(y):
        f, g = both(y)
        return float(f), np.asarray(g, float)

    try:
        if method in ("trf", "dogbox"):
            out = scipy.optimize.least_squares(
                lambda y: np.asarray(residuals(y)),
                start,
                lambda y: np.asarray(jacobian(y)),  # pyright: ignore[reportArgumentType]
                bounds=(lower, upper),
                method=method,
                x_scale="jac",
                ftol=TIGHT,
                xtol=TIGHT,
                gtol=TOLERANCE,
                max_nfev=LEAST_SQUARES_STEPS,
            )
            iterations = int(out.njev)
        elif method == "L-BFGS-B":
            limits = {"maxiter": GRADIENT_STEPS, "maxfun": GRADIENT_STEPS, "ftol": TIGHT, "gtol": TOLERANCE}
            bounds = scipy.optimize.Bounds(lower, upper)  # pyright: ignore[reportArgumentType]
            out = scipy.optimize.minimize(value, start, jac=True, method=method, bounds=bounds, options=limits)
            iterations = int(out.nit)
        else:
            bounds = scipy.optimize.Bounds(lower, upper) if problem.is_box else None  # pyright: ignore[reportArgumentType]
            balls = () if problem.is_box else (slack_of(problem),)
            limits = {"maxiter": LEAST_SQUARES_STEPS, "ftol": TIGHT}
            out = scipy.optimize.minimize(
                value, start, jac=True, method=method, bounds=bounds, constraints=balls, options=limits
            )
            iterations = int(out.nit)
    except (ValueError, np.linalg.LinAlgError) as error:
        return verdict(problem, solver, np.full(shape, np.nan), 0, 0, f"{type(error).__name__}: {error}")
    point = out.x
    if problem.is_box:  # SLSQP is outside by rounding of the bounds
        point = np.clip(point, lower, upper)
    return verdict(problem, solver, point.reshape(shape), iterations, int(out.nfev), str(out.message).strip())


def slack_of(problem: BoundedProblem) -> dict:
    """The balls as SLSQP takes them: positive inside, in metres near the boundary."""
    radius, width = problem.radius, problem.start.shape[-1]
    count = problem.start.size // width
    assert radius is not None

    def slack(y):
        return (radius**2 - np.sum(y.reshape(count, width) ** 2, axis=1)) / (2 * radius)

    def slope(y):
        matrix = np.zeros((count, count, width))
        matrix[np.arange(count), np.arange(count)] = -y.reshape(count, width) / radius
        return matrix.reshape(count, -1)

    return {"type": "ineq", "fun": slack, "jac": slope}


def verdict(problem: BoundedProblem, solver: str, point: np.ndarray, iterations: int, evaluations: int, said: str):
    """The outcome; the objective is evaluated again, in the same way for all."""
    both = derivatives(problem.residuals, problem.function, problem.start.shape)[0]
    objective = float(both(jnp.asarray(point.ravel()))[0])
    violation = problem.violation(point) if np.isfinite(point).all() else np.inf
    return Run(
        problem=problem.name,
        family=problem.family,
        solver=solver,
        solved=problem.is_solved(point, objective),
        objective=objective,
        optimum=problem.optimum,
        violation=violation,
        iterations=iterations,
        evaluations=evaluations,
        said=said,
    )


def run_all(problems: list[BoundedProblem], path: Path, solvers: tuple[str, ...]) -> list[Run]:
    """Runs what the file does not have yet."""
    rows, wanted = Rows(path, ("problem", "solver")), []
    for index, problem in enumerate(problems, 1):
        keys = [(problem.name, solver) for solver in solvers if applies(solver, problem)]

        def run(name: str, solver: str, problem: BoundedProblem = problem):
            return dataclasses.asdict((ours if solver in OURS else scipys)(problem, solver))

        rows.run(rows.missing(keys), run, progress=False)
        wanted += keys
        failed = [row["solver"] for row in rows.read() if row["problem"] == problem.name and not row["solved"]]
        print(f"{index} of {len(problems)} {problem.name}: {', '.join(failed) or 'all'}", file=sys.stderr, flush=True)
        # no problem shares a program with another one, and all of them are more than LLVM's memory for code holds
        jax.clear_caches()
    by_key = {(row["problem"], row["solver"]): Run(**row) for row in rows.read()}
    return [by_key[key] for key in wanted]


def rates(runs: list[Run]) -> list[list[str]]:
    """Successes over problems that the solver applies to, by family."""
    families = list(dict.fromkeys(run.family for run in runs))
    rows = [["solver", *families, "all"]]
    for solver in SOLVERS:
        row = [solver]
        for family in (*families, None):
            mine = [r for r in runs if r.solver == solver and family in (None, r.family)]
            row.append(f"{sum(r.solved for r in mine)} / {len(mine)}" if mine else "does not apply")
        rows.append(row)
    return rows


def duels(runs: list[Run]) -> list[list[str]]:
    """Ours against each of scipy's on the problems that both apply to."""
    by = {(run.problem, run.solver): run.solved for run in runs}
    rows = [["ours", *SCIPYS]]
    for solver in OURS:
        row = [solver]
        for rival in SCIPYS:
            shared = [name for name, of in by if of == solver and (name, rival) in by]
            mine, theirs = (sum(by[name, one] for name in shared) for one in (solver, rival))
            row.append(f"{mine} : {theirs} of {len(shared)}" if shared else "none shared")
        rows.append(row)
    return rows


def effort(runs: list[Run]) -> list[list[str]]:
    """Iterations and evaluations of every run; a failed one in brackets."""
    rows = [["problem", *SOLVERS]]
    by = {(run.problem, run.solver): run for run in runs}
    for name in dict.fromkeys(run.problem for run in runs):
        row = [name]
        for solver in SOLVERS:
            run = by.get((name, solver))
            text = "" if run is None else f"{run.iterations} / {run.evaluations}"
            row.append(text if run is None or run.solved else f"({text})")
        rows.append(row)
    return rows


def failures(runs: list[Run]) -> list[list[str]]:
    """One by one."""
    rows = [["problem", "solver", "objective", "best known", "violation", "iterations", "what it says"]]
    for run in runs:
        if not run.solved:
            values = [f"{run.objective:.9g}", f"{run.optimum:.9g}", f"{run.violation:.1e}", str(run.iterations)]
            rows.append([run.problem, run.solver, *values, run.said.replace("|", "/").split("\n")[0]])
    return rows


def page(runs: list[Run], command: str, made: str) -> str:
    """The Markdown page."""
    return page_of_results(
        "Bounded solvers on standard problems",
        f"`{command}`",
        [
            f"{len({run.problem for run in runs})} problems in float64, derivatives by JAX, one start each. Success: "
            "feasible to 1e-8 and an objective within 1e-6 of the best known, relative to it (1e-10 where that is 0). "
            f"Our solvers stop at a projected gradient of {TOLERANCE:g}. scipy's tolerances on gradient, objective and "
            f"step are {TOLERANCE:g}, {TIGHT:g} and {TIGHT:g}, and `least_squares` scales by the Jacobian. Solvers "
            f"take at most {LEAST_SQUARES_STEPS} steps, methods that use gradients only {GRADIENT_STEPS}. The "
            "families, their sources and the origin of the best known values are in `experiments/standard_problems/`. "
            "All solvers are local. Some problems first had a second minimum, so success depended on chance "
            "(Rosenbrock of four and more variables, Wood, HS2, a rod that had to snap through). Their box, start or "
            "target was changed before this table was made, after some of these solvers, ours and scipy's, had failed "
            "on them. MGH17 and Thurber still have second minima.",
            "",
            "## Successes",
            "",
            *markdown_table(rates(runs)),
            "",
            "## Ours : scipy's, on the problems that both apply to",
            "",
            *markdown_table(duels(runs)),
            "",
            "## Failures, one by one",
            "",
            *markdown_table(failures(runs)),
            "",
            "## Iterations / evaluations of the function",
            "",
            "In brackets where the solver failed. An iteration of the least squares methods takes at most one "
            "Jacobian, one of the others one gradient.",
            "",
            *markdown_table(effort(runs)),
        ],
        made_on=made,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--family", help="run only this family of problems")
    parser.add_argument("--solver", choices=SOLVERS, nargs="*", default=SOLVERS, help="run only these")
    parser.add_argument("--cache", type=Path, default=Path("runs") / "bounded_solvers.jsonl", help="finished runs")
    parser.add_argument("--out", type=Path, help="write the page there")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")  # scipy's, of overflow in trial points
    problems = [problem for problem in all_problems() if options.family in (None, problem.family)]
    runs = run_all(problems, options.cache, tuple(options.solver))
    made = f"{made_on(options.cache)} The page: scipy {scipy.__version__}."
    text = page(runs, "python experiments/10_bounded_solvers.py --out docs/results/bounded_solvers.md", made)
    publish(text, options.out)


if __name__ == "__main__":
    main()
