"""Tables say what the trials say, failures included; the figure shows them."""

import math

import numpy as np
import pytest

from closed_loop.cases import NEARBY, NEARBY_RATIOS, nearby_cases
from closed_loop.failures import Snapshot, append_snapshot, failure_figure, read_snapshots, worst
from closed_loop.interval_tables import interval_table, learning_table, nearby_table, paired_table, success_table
from closed_loop.tables import comparison_table, settling_table, stiffness_table
from closed_loop_cases import course, small_table, trial
from report_cases import arc


def cells(table: str) -> list[list[str]]:
    lines = table.strip().split("\n")
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert len({len(row) for row in rows}) == 1, "every row has as many cells as the title"
    return rows


def test_comparison_has_the_papers_layout():
    title, _, *rows = cells(comparison_table(small_table(), "III"))
    assert title[2:4] == ["U: terminal error [cm]", "U: settling time [s]"]
    assert [row[0] for row in rows] == [
        "direct transfer", "*in the paper*", "GNS + online residual", "*in the paper*",
        "*best in the paper*",
    ]  # fmt: skip
    errors = [t.terminal_error_cm for t in small_table() if t.method == "residual" and t.scenario == "U"]
    assert rows[2][1:4] == ["6", f"{np.mean(errors):.2f} ± {np.std(errors, ddof=1):.2f}", "8.00 ± 0.00"]
    assert rows[1][2:] == ["*1.54 ± 0.53*", "*11.32 ± 1.46*", "*1.61 ± 0.42*", "*13.98 ± 1.31*"]
    assert rows[4][2:] == ["*0.42*", "*8.31*", "*0.57*", "*13.58*"]


def test_failures_stand_in_their_cells():
    trials = [
        *small_table(),
        trial(seed=7, errors_cm=course(settled_s=math.inf)),
        trial(seed=8, errors_cm=course(math.nan)),
    ]
    row = next(r for r in cells(comparison_table(trials, "III")) if r[0] == "GNS + online residual")
    assert row[1] == "6 to 8"
    assert "(1 of 8 lost)" in row[2] and "(2 of 8 did not settle)" in row[3]
    only = [trial(errors_cm=course(settled_s=math.inf))]
    assert cells(comparison_table(only, "III"))[2][3] == "none (1 of 1 did not settle)"
    row = next(r for r in cells(interval_table(trials, "III")) if r[:2] == ["GNS + online residual", "U"])
    assert row[2:5] == ["8", "1", "0"] and row[8] == "failed"


def test_a_table_of_ones_own_has_no_published_rows():
    rows = cells(comparison_table(small_table("mine"), "mine"))
    assert not any("paper" in row[0] for row in rows)
    with pytest.raises(ValueError, match=r"No trial of table 'IV', only of \['mine'\]"):
        comparison_table(small_table("mine"), "IV")


def test_stiffness_rows_split_the_comparison():
    rows = cells(stiffness_table(small_table(), "III"))[2:]
    assert [row[:3] for row in rows] == [
        ["direct transfer", "0.5", "3"], ["direct transfer", "2", "3"],
        ["GNS + online residual", "0.5", "3"], ["GNS + online residual", "2", "3"],
    ]  # fmt: skip


def test_settling_time_by_the_textbook_is_in_a_table_of_its_own():
    way = (20.0, 5.0, 1.1, 0.5, 0.25, 0.25, 0.25)  # within 5 % of the way, 0.99 cm, at 2 s, within 2 % at 3 s
    rows = cells(settling_table([trial(errors_cm=way), trial(seed=1, errors_cm=(20.0, 9.0, 8.0, 6.0))], "III"))
    assert rows[2] == [
        "GNS + online residual", "U", "2", "4.00 ± 0.00 (1 of 2 did not settle)", "2.00 ± 0.00 (1 of 2 did not settle)",
        "3.00 ± 0.00 (1 of 2 did not settle)", "12.35 ± 1.09",
    ]  # fmt: skip


def test_pairs_show_the_difference_of_every_trial():
    rows = cells(paired_table(small_table(), "III", "direct"))[2:]
    assert [row[1] for row in rows] == ["U", "S"]
    assert rows[0][2:] == ["6", "0", "0", "-0.100", "-0.100 to -0.100", "6 / 0"]
    with pytest.raises(ValueError, match="no trial of 'fine-tuned'"):
        paired_table(small_table(), "III", "fine-tuned")


def test_learning_is_compared_with_the_same_model_without_it():
    runs = [
        trial(method=method, stiffness=ratio, scenario=letter, seed=seed, errors_cm=(20.0,) + 12 * (error,))
        for method, errors in (("direct", (1.0, 1.0)), ("residual", (0.5, 1.2)))
        for ratio, error in zip((0.5, 2.0), errors, strict=True)
        for letter in "US"
        for seed in range(3)
    ]
    bases = {"residual": "direct", "learner": "direct"}
    title, _, row = cells(learning_table(runs, "III", bases))
    assert title[2:] == ["at 0.5", "at 2", "U", "S", "cells where its mean is worse"]
    assert row == [
        "GNS + online residual", "direct transfer", "6 / 0", "0 / 6", "3 / 3, p = 0.66", "3 / 3, p = 0.66",
        "2 of 4: U at 2 +20 %, S at 2 +20 %",
    ]  # fmt: skip


def test_success_is_counted_at_the_end():
    runs = [trial(table="Liang", scenario="straight", seed=s, errors_cm=course(0.1 + 0.05 * s)) for s in range(8)]
    runs += [
        trial(table="Liang", scenario="straight", seed=8, errors_cm=course(2.0, best_cm=0.9)),
        trial(table="Liang", scenario="straight", seed=9, errors_cm=course(math.nan)),
        trial(table="Liang", scenario="diverse", errors_cm=course(0.2)),
    ]
    rows = cells(success_table(runs))[2:]
    assert rows[0] == [
        "GNS + online residual", "straight", "8/10", "0.44 to 0.97", "9/10", "2.75", "4.67 (1 lost)", "3.25", "40",
    ]  # fmt: skip
    assert rows[1][1:3] == ["diverse", "1/1"]
    assert [row[2] for row in rows[2:4]] == ["*47/50*", "*43/50*"]


def test_plants_next_to_one_another_show_what_a_run_owes_to_luck():
    cases = nearby_cases(range(3, 5))
    assert [case.stiffness for case in cases] == list(NEARBY_RATIOS) and {case.seed for case in cases} == {3}
    assert {(case.table, case.scenario) for case in cases} == {(NEARBY, "Z")}
    errors = zip(NEARBY_RATIOS, (0.1, 0.2, 0.4), strict=False)
    runs = [trial(table=NEARBY, scenario="Z", stiffness=r, errors_cm=(9.0, *[e] * 12)) for r, e in errors]
    assert cells(nearby_table(runs, NEARBY))[2] == ["GNS + online residual", "3", "0.10", "0.20", "0.40", "4.00"]


def snapshot(seed: int, error: float, final: np.ndarray) -> Snapshot:
    return Snapshot(("Liang", "residual", "diverse", 1.0, seed), arc(0.1), final, arc(1.0), error, None)


def test_failures_become_one_figure(tmp_path):
    path = tmp_path / "snapshots.jsonl"
    shots = [snapshot(0, 0.2, arc(0.99)), snapshot(1, 9.0, arc(0.5)), snapshot(2, math.nan, np.full((13, 2), np.nan))]
    for shot in shots:
        append_snapshot(path, shot)
    kept = read_snapshots(path)
    np.testing.assert_allclose(kept[1].final, arc(0.5), atol=1e-6)
    bad = worst(kept, 5, above_cm=1.0)
    assert [s.key[-1] for s in bad] == [2, 1]
    figure = failure_figure(bad)
    words = [text.get_text() for ax in figure.axes for text in ax.texts]
    assert words == ["lost", "9.00 cm"]
    figure.savefig(tmp_path / "failures.png")
    assert (tmp_path / "failures.png").stat().st_size > 5000
    with pytest.raises(ValueError, match="no run to show"):
        failure_figure([])
    path.write_text('{"key": [1]}\n')
    with pytest.raises(ValueError, match="line 1 is not a snapshot"):
        read_snapshots(path)
