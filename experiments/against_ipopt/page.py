"""The page of results on planning problems that our solver and IPOPT have solved (`experiments/11_against_ipopt.py`).

Rows are those of `against_ipopt.judge`, explanations those of `against_ipopt.explain`, for the rows whose plan does not
have all that is asked.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from against_ipopt.control_call import improved, ratios
from against_ipopt.judge import (
    EQUAL,
    FEASIBLE,
    POINTS,
    REACH,
    STATIONARY,
    as_good,
    better_referee,
    comparable_seconds,
    excess,
    meets_all,
)
from against_ipopt.referee import FOUND
from against_ipopt.rounded import CORNER
from pages import markdown_table

STEEP = 50.0
"""Largest singular value of the residuals' Jacobian above which a model is steep: with statics, at a snap-through."""

_REFEREES = {"limited": "limited memory", "exact": "exact Hessian"}


def ipopt_sections(
    rows: list[dict], explained: dict[str, dict], kinks: list[dict], calls: list[dict], solvers: Sequence[str]
) -> list[str]:
    """Lines of Markdown: all that follows the title and what was run.

    Args:
        rows: of the problems.
        explained: by name.
        kinks: rows on the slope with and without smoothed ReLUs; none leaves the table out.
        calls: rows of `control_call.race`; none leaves the section out.
        solvers: whose calls these are, by name.
    """
    sections = [
        ("Why the ReLUs are smoothed", _why_rounded(rows, kinks)),
        ("What the KKT residual is", _residuals(rows)),
        ("Objective and feasibility", _objectives(rows, explained)),
        ("Time to an equal objective", _seconds(rows)),
        ("A control call", _calls(calls, solvers)),
        ("Exceptions, one by one", _exceptions(rows, explained)),
    ]
    return [line for title, lines in sections if lines for line in (f"## {title}", "", *lines, "")]


def share(flags: Sequence[bool]) -> str:
    """How many of them, for people."""
    flags = np.asarray(flags, bool)  # pyright: ignore[reportAssignmentType]
    return f"{np.sum(flags)} of {len(flags)} ({100 * np.mean(flags):.1f} %)" if len(flags) else "none"


def quantiles(values: Sequence[float] | np.ndarray, digits: str = ".2g") -> str:
    """Median, 95th percentile and largest."""
    values = np.asarray(values, float)
    if not len(values):
        return "-"
    return " / ".join(f"{v:{digits}}" for v in (np.median(values), np.percentile(values, 95), values.max()))


def _why_rounded(rows: list[dict], kinks: list[dict]) -> list[str]:
    changes = [abs(r["sharp_objective"] - r["objective"]) / r["objective"] for r in rows]
    lines = [
        "With the network as trained, the objective has a kink wherever one of the million ReLUs of a rollout "
        "passes zero. Minima lie on kinks, where no gradient vanishes: a solver cannot end there with a small KKT "
        f"residual. With ReLUs smoothed within {CORNER:g} of zero (`against_ipopt.rounded`), the objective is twice "
        "differentiable; at our plans its value differs from the trained network's by "
        f"{quantiles(changes)}, relative (median / 95 % / largest).",
    ]
    if not kinks:
        return lines
    labels = {
        "jump": "largest change of the slope between neighbouring points [m]",
        "usual": "usual (median) change [m]",
        "kkt": "absolute KKT residual at the end [m]",
    }
    kinds = ("sharp", "smooth")
    table = [["", "as trained", "smoothed"]]
    table += [
        [label, *(quantiles([row[kind][key] for row in kinks]) for kind in kinds)] for key, label in labels.items()
    ]
    below = (share([row[kind]["kkt"] < STATIONARY for row in kinks]) for kind in kinds)
    return [
        *lines,
        "",
        f"Slope of the objective along a random direction through our plan, at {POINTS} points over "
        f"{1e6 * REACH:.0f} um to either side, and where our solver ends from the same start, on {len(kinks)} "
        "problems (median / 95 % / largest). The keypoints that both networks predict over the horizon are at most "
        f"{quantiles([1e6 * row['apart'] for row in kinks])} um apart.",
        "",
        *markdown_table([*table, ["KKT residual below 1e-5 m", *below]]),
    ]


def _residuals(rows: list[dict]) -> list[str]:
    def cells(label: str, said: Callable[[list], str], of: Callable[[dict, dict], object]) -> list[str]:
        referees = (said([of(r[which], r) for r in rows if which in r]) for which in _REFEREES)
        return [label, said([of(r, r) for r in rows]), *referees]

    return [
        "The objective is in m^2 and the plan in m, so its gradient and the residual are in m. The absolute residual "
        "is the worst element of `gradient + multipliers x normals`, of the excess over a bound and of multiplier x "
        "slack: below 1e-5 m, moving a gripper by 1 mm promises no more than 1e-8 m^2. IPOPT's `tol` asks the same of "
        "the objective divided by its value at the start (and by more where the gradient would be above 100): that is "
        "the scaled residual, in 1/m. If the start is near the target, a bound on the absolute residual is easy to "
        "meet and one on the scaled residual is not; the third row is relative to the largest element of the gradient "
        "at the start.",
        "",
        *markdown_table(
            [
                ["KKT residual, median / 95 % / largest", "ours", *(f"IPOPT, {name}" for name in _REFEREES.values())],
                cells("absolute [m]", quantiles, lambda found, row: found["kkt"]),
                cells("scaled by the objective at the start [1/m]", quantiles, lambda found, row: found["kkt_scaled"]),
                cells(
                    "relative to the gradient at the start",
                    quantiles,
                    lambda found, row: found["kkt"] / row["start_slope"],
                ),
                cells("absolute below 1e-5 m", share, lambda found, row: found["kkt"] < STATIONARY),
            ]
        ),
    ]


def _objectives(rows: list[dict], explained: dict[str, dict]) -> list[str]:
    def cells(label: str, of: Callable[[dict, str], bool], counted=lambda found: True) -> list[str]:
        judged = {which: [r for r in rows if which in r and counted(r[which])] for which in _REFEREES}
        return [label, *(share([of(r, which) for r in some]) for which, some in judged.items())]

    def ended(found: dict) -> bool:
        return found["status"] in FOUND

    table = [
        ["", *_REFEREES.values()],
        cells("ours within 1e-6 of IPOPT's, or better", lambda r, which: excess(r, which) <= EQUAL),
        cells("ours within 1e-4, or better", lambda r, which: excess(r, which) <= 1e-4),
        cells("ours better by more than 1e-6", lambda r, which: excess(r, which) < -EQUAL),
        cells("ours better by more than 1e-4", lambda r, which: excess(r, which) < -1e-4),
        cells("IPOPT ended at an optimum by its own test", lambda r, which: ended(r[which])),
        cells("of those, ours within 1e-6 or better", lambda r, which: excess(r, which) <= EQUAL, counted=ended),
        cells("IPOPT used up its iterations", lambda r, which: r[which]["status"] == -1),
    ]
    loss = [(r["single_objective"] - r["objective"]) / r["objective"] for r in rows]
    return [
        *markdown_table(table),
        "",
        *_all_at_once(rows, explained),
        "",
        f"Ours feasible to 1e-8 m: {share([r['violation'] <= FEASIBLE for r in rows])}; largest violation "
        f"{max(r['violation'] for r in rows):.1e} m, IPOPT's {max(r['limited']['violation'] for r in rows):.1e} m. "
        f"Converged by its own test: {share([r['converged'] for r in rows])}; "
        f"{quantiles([r['steps'] for r in rows], '.0f')} steps of both parts (median / 95 % / largest).",
        "",
        "In float32 the objective of the plan, evaluated in float64, is above that of the plan found in float64 by "
        f"{quantiles(loss)}, relative (median / 95 % / largest); such a plan breaks bounds by "
        f"{quantiles([r['single_violation'] for r in rows])} m.",
    ]


def _all_at_once(rows: list[dict], explained: dict[str, dict]) -> list[str]:
    """On how many problems one plan has all that is asked, from the first start and from several."""
    lines = [
        "All three at once (within 1e-6 of every IPOPT's or better, feasible to 1e-8 m, KKT residual below 1e-5 m), "
        f"from IPOPT's start: {share([meets_all(r, r) for r in rows])}."
    ]
    others = {row["name"]: explained.get(row["name"], {"starts": []})["starts"] for row in rows}
    if all(others[row["name"]] for row in rows if not meets_all(row, row)):
        every, good = (
            share([any(test(plan, row) for plan in (row, *others[row["name"]])) for row in rows])
            for test in (meets_all, as_good)
        )
        lines += [
            "",
            f"With up to {max(map(len, others.values()))} other random starts, until one plan has all three: "
            f"**{every}**; by the objective alone {good}.",
        ]
    return lines


def _seconds(rows: list[dict]) -> list[str]:
    table = [["", "ours [s] median / 95 % / largest", "IPOPT [s]", "ratio of medians", "median of ratios"]]
    for which, name in _REFEREES.items():
        for equal, where in ((EQUAL, "equal ends"), (np.inf, "all")):
            mine, theirs = comparable_seconds(rows, which, equal)
            if len(mine):
                whole = f"{np.median(theirs) / np.median(mine):.1f}", f"{np.median(theirs / mine):.1f}"
                table.append([f"{name}, {where}: {len(mine)} problems", quantiles(mine), quantiles(theirs), *whole])
    return [
        "Wall time from the start to the first feasible plan within 1e-6 of the worse of both final objectives; "
        "functions compiled and warm, both called step by step from Python, in the same process. First the problems "
        "on which both end within 1e-6 of each other, then all.",
        "",
        *markdown_table(table),
    ]


def _calls(calls: list[dict], solvers: Sequence[str]) -> list[str]:
    """What a control call reaches."""
    if not calls:
        return []
    table = [
        [
            "",
            "ours [ms] median / 95 % / largest",
            "IPOPT [ms], if it got as far",
            "IPOPT never as good",
            "ratio of times, median (quarter, three quarters)",
        ]
    ]
    for name in solvers:
        ratio, counted = ratios(calls, name), improved(calls, name)
        theirs = [one["ipopt_seconds"] for one in counted if one["ipopt_seconds"] is not None]
        low, middle, high = np.quantile(ratio, [0.25, 0.5, 0.75], method="inverted_cdf")
        table.append(
            [
                f"{name}: {len(ratio)} problems",
                quantiles([1e3 * one["seconds"] for one in counted], ".0f"),
                quantiles([1e3 * s for s in theirs], ".0f"),
                f"{int(np.isinf(ratio).sum())}",
                f"{middle:.1f} ({low:.1f}, {high:.1f})",
            ]
        )
    return [
        f"The first {len(calls)} problems with the network as trained, in float32. Ours is the solve of a control "
        "call, compiled as a whole; IPOPT (limited memory) has the same compiled objective and gradient and the "
        "same start, and is timed until its first feasible plan that is as good to 1e-6. Problems whose start a solver "
        f"does not improve are left out. {', '.join(sorted({row['machine'] for row in calls}))}.",
        "",
        *markdown_table(table),
    ]


def _exceptions(rows: list[dict], explained: dict[str, dict]) -> list[str]:
    lines = []
    for row in rows:
        if meets_all(row, row):
            continue
        theirs, said = better_referee(row), explained.get(row["name"])
        verdict = "not looked into" if said is None else _verdict(row, said)
        difference = (row["objective"] - theirs["objective"]) / theirs["objective"]
        lines.append(
            f"- {row['name']}: ours {row['objective']:.9g}, IPOPT {theirs['objective']:.9g} m^2 ({difference:+.1e}), "
            f"KKT residual {row['kkt']:.1e} m, IPOPT's {theirs['kkt']:.1e} m: {verdict}."
        )
    return lines or ["None."]


def _verdict(row: dict, said: dict) -> str:
    """Why the first start's plan does not have all that is asked."""
    stationary, count, last = row["kkt"] < STATIONARY, len(said["starts"]), said["starts"][-1]
    first = "another local minimum" if stationary else "not stationary"
    if meets_all(last, row):
        return (
            f"{first}; other start number {count} leads to a plan that has all three, {1e3 * last['apart']:.1f} mm "
            f"from the first, {last['objective']:.9g} m^2"
        )
    if meets_all(said["from_theirs"], row):
        return (
            f"{first}; from IPOPT's plan ours ends at one that has all three, {1e3 * said['from_theirs']['apart']:.1f} "
            f"mm from the first, and none of {count} other starts leads there"
        )
    if max(said["steepness"], said["their_steepness"]) > STEEP:
        return (
            f"{'stationary' if stationary else first}, where the model is steep, as at a snap-through: the largest "
            f"singular value of the residuals' Jacobian is {said['steepness']:.0f} at our plan, "
            f"{said['their_steepness']:.0f} at IPOPT's"
        )
    first = "stationary" if stationary else first
    return f"{first}, and neither {count} other starts nor IPOPT's plan lead to one that has all three"
