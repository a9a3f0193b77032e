"""The page on our solver and IPOPT: it says what its rows say, and explains every exception."""

import pathlib

import jax
import jax.numpy as jnp
import pytest

from against_ipopt.judge import Contestant, explain, kkt_residual, meets_all, rows_of
from against_ipopt.page import ipopt_sections
from against_ipopt.planning_problems import ProblemMaker
from against_ipopt.solver_path import PathFinder
from cablejax.bounded import BoundedQuasiNewton
from cablejax.cable import Cable
from cablejax.control.shaping import Model
from mpc_cases import planning_case, relaxing_cable

RESULTS = pathlib.Path(__file__).parents[1] / "docs" / "results"
PAGES = {"against_ipopt.md": "", "against_ipopt_no_statics.md": "gns-rigid"}
GOOD = {"objective": 1.0, "violation": 0.0, "kkt": 1e-9, "apart": 2e-3}


def row(name="a", theirs=1.0, **ours):
    found = {"objective": theirs, "kkt": 1e-8, "kkt_scaled": 1e-8, "status": 0, "violation": 0.0}
    mine = {"name": name, **GOOD, "kkt_scaled": 1e-9, "start_slope": 1.0, "sharp_objective": 1.0, "converged": True}
    mine |= {"steps": 3, "single_objective": 1.0, "single_violation": 0.0}
    seconds = {"seconds_to_both": 6.0, "ours_seconds_to_both": 2.0}
    return {**mine, **ours, "limited": {**found, **seconds}}


def explanation(starts, from_theirs=None, steepness=1.0):
    return {"steepness": steepness, "their_steepness": 1.0, "starts": starts, "from_theirs": from_theirs}


@pytest.mark.parametrize("page", PAGES)
def test_the_kept_page_is_what_the_kept_rows_give(page):
    folder = RESULTS / "trials" / "against_ipopt" / PAGES[page]

    rows, explained, kinks, calls = (rows_of(folder, kind).read() for kind in ("rows", "explained", "kinks", "calls"))
    lines = ipopt_sections(
        rows, {row["name"]: row for row in explained}, kinks, calls, ("levenberg-marquardt", "two-trials")
    )
    assert "\n".join(lines) in (RESULTS / page).read_text()


def test_shares_and_times_are_those_of_the_rows():
    rows = [row("a"), row("b", objective=1.1), row("c", kkt=1.0), row("d", violation=1e-3, objective=0.5)]
    starts = {"b": [{**GOOD, "kkt": 1.0}, GOOD], "c": [{**GOOD, "objective": 2.0}], "d": [GOOD]}
    explained = {name: explanation(of_row, GOOD) for name, of_row in starts.items()}
    text = "\n".join(ipopt_sections(rows, explained, [], [], ()))
    assert "from IPOPT's start: 1 of 4 (25.0 %)" in text
    assert "With up to 2 other random starts, until one plan has all three: **3 of 4 (75.0 %)**" in text
    assert "by the objective alone 4 of 4" in text
    assert "ours within 1e-6 of IPOPT's, or better | 3 of 4 (75.0 %)" in text
    assert "limited memory, equal ends: 2 problems | 2 / 2 / 2 | 6 / 6 / 6 | 3.0 | 3.0" in text
    assert "A control call" not in text and "Slope of the objective along" not in text
    del explained["c"]
    assert "other random starts" not in "\n".join(ipopt_sections(rows, explained, [], [], ()))


@pytest.mark.parametrize(
    ("of_row", "said", "words"),
    [
        ({"objective": 1.1}, explanation([{**GOOD, "kkt": 1.0}, GOOD]), "another local minimum; other start number 2"),
        ({"kkt": 1.0}, explanation([GOOD]), "not stationary; other start number 1 leads to a plan that has all three"),
        (
            {"objective": 1.1},
            explanation([{**GOOD, "kkt": 1.0}], GOOD),
            "another local minimum; from IPOPT's plan ours",
        ),
        ({"kkt": 1.0}, explanation([{**GOOD, "kkt": 1.0}], {**GOOD, "kkt": 1.0}, 99.0), "as at a snap-through"),
        (
            {"kkt": 1.0},
            explanation([{**GOOD, "kkt": 1.0}], {**GOOD, "kkt": 1.0}),
            "not stationary, and neither 1 other",
        ),
        ({"kkt": 1.0}, None, "not looked into"),
    ],
)
def test_every_exception_is_explained(of_row, said, words):
    lines = ipopt_sections([row(**of_row)], {} if said is None else {"a": said}, [], [], ())
    (line,) = [line for line in lines if line.startswith("- a: ours")]
    assert words in line
    assert "None." in ipopt_sections([row()], {}, [], [], ())


@pytest.mark.slow
def test_other_starts_are_tried_until_one_has_all_that_is_asked():
    with jax.enable_x64(True):
        case = planning_case()
        make = ProblemMaker(Model("analytic", None, relaxing_cable, jnp.asarray(0.8), Cable()))  # pyright: ignore[reportArgumentType]
        finder = PathFinder(
            lambda motion, problem: problem.residuals(motion),
            BoundedQuasiNewton(atol=1e-10),
            lambda motion, problem: problem.linearise(motion),
        )

        def find(problem, start, gradients):
            return finder(problem, problem.feasible, start, gradients)

        ours, problem = Contestant(make, make, make, find, find), make(case)
        path = find(problem, case.guess, 60)
        best = {"motion": path.points[-1].tolist(), "objective": float(path.objectives[-1])}
        best |= {"kkt": kkt_residual(problem, path.points[-1]), "violation": case.limits().violation(path.points[-1])}
        worse = {**best, "objective": 2 * best["objective"], "limited": best}
        reached = explain(ours, case, worse, 4)
        assert meets_all(best, worse) and meets_all(reached["starts"][-1], worse)
        assert reached["from_theirs"] is None and len(reached["starts"]) <= 4
        out_of_reach = {**best, "limited": {**best, "objective": 0.5 * best["objective"]}}
        missed = explain(ours, case, out_of_reach, 2)
        assert len(missed["starts"]) == 2 and missed["from_theirs"]["apart"] < 1e-6
        assert 0.1 < missed["steepness"] < 50.0
