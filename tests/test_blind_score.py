"""The scorer of the blind check on verdicts made by hand."""

import pathlib

import pytest

from blind.measures import baselines, rate_interval, reliability, table
from blind.score_page import write_page
from blind.store import checked_labels, digest, publish_hashes, read_cases, write_cases
from blind.verdicts import Scored, coverages, place_error, scored, shrinkage_ratio
from rows import append_row

NOISE = 1.0
BLIND = pathlib.Path(__file__).parents[1] / "docs" / "results" / "blind"


def label(kind, *effects, gap=4.0, family="A", traceless=False, twins=None):
    severity = None if kind == "none" else min((1, 2, 4, 8), key=lambda s: abs(s - gap))
    return {
        "kind": kind, "family": family, "effects": [{"name": n, "parameters": p} for n, p in effects],
        "severity": severity, "gap_over_noise": gap if effects else 0.0, "traceless": traceless, "twins": twins or {},
        "noise_mm": NOISE, "oracle_after_mm": NOISE, "gap_rmse_mm_noisy": (gap**2 + 1) ** 0.5 if effects else NOISE,
    }  # fmt: skip


def verdict(said, *effects, equivalent=(), shrinkage=None, ranking=(), **more):
    return {
        "schema": "cablejax-verdict/1", "verdict": said,
        "effects": [{"name": n, "probability": p, "parameters": q, "location": {}} for n, p, q in effects],
        "equivalent": [list(group) for group in equivalent],
        "ranking": [{"name": n, "probability": p} for n, p in ranking], "gap": {"shrinkage": shrinkage}, **more,
    }  # fmt: skip


OBSTACLE = ("obstacle", {"x_m": 0.4, "y_m": 0.2, "radius_m": 0.03})
BEND = ("intrinsic_curvature", {"centre_m": 0.3, "width_m": 0.2, "curvature_per_m": 1.0, "_edge": 1})
TILT = ("gravity_tilt", {"angle_rad": 0.1, "direction_rad": 3.1})
LAG = ("camera_lag", {"time_s": 0.3, "_delay_share": 0.5})
BARREL = ("barrel_distortion", {"per_m2": 0.1})


def parameter(value, low, high):
    return {"value": value, "ci90": [low, high], "unit": "m"}


def rows(cases):
    return {row.measure: row for row in table(cases)}


def row(cases, start):
    return next(row for name, row in rows(cases).items() if name.startswith(start))


def test_a_perfect_diagnosis_reaches_everything():
    said = {"x_m": parameter(0.4, 0.39, 0.41), "y_m": parameter(0.2, 0.1, 0.3), "radius_m": parameter(0.05, 0.04, 0.06)}
    cases = [
        Scored("a", label("none"), verdict("none", seconds=10.0)),
        Scored("b", label("single", OBSTACLE), verdict("named", ("obstacle", 0.9, said), shrinkage=0.9)),
        Scored("c", label("unknown", BARREL), verdict("unknown")),
        Scored("d", label("pair", TILT, LAG),
               verdict("named", ("gravity_tilt", 0.6, {"angle_rad": parameter(0.1, 0.0, 0.2)}), ("camera_lag", 0.6, {}),
                       shrinkage=1.0)),
    ]  # fmt: skip
    assert {row.measure: row.reached for row in table(cases) if row.reached is not None and not row.reached} == {}
    # Three of four intervals cover: the radius does not.
    assert row(cases, "90 %").value.startswith("75 % (3/4")
    assert row(cases, "shrinkage").value.startswith("median 0.95")


def test_silence_reaches_nothing_but_the_absence_of_false_alarms():
    kinds = [label("none"), label("single", OBSTACLE), label("unknown", BARREL), label("pair", TILT, LAG)]
    cases = [Scored(str(i), kind, None) for i, kind in enumerate(kinds)]
    reached = {row.measure: row.reached for row in table(cases) if row.reached is not None}
    assert [name for name, hit in reached.items() if hit] == ["false alarms on no-effect cases"]


def test_equivalents_count_for_the_set_and_for_its_size_not_for_the_first_name():
    said = verdict(
        "ambiguous", ("table_friction", 0.5, {}), equivalent=[["table_friction", "linear_density"], ["obstacle"]]
    )
    case = Scored("a", label("single", ("linear_density", {"ratio": 2.0})), said)
    assert case.reported == {"table_friction", "linear_density"}
    assert row([case], "top-1 on").value.startswith("0 %")
    assert row([case], "true effect inside").value.startswith("100 % (1/1") and "size 2.00" in row([case], "true").value


def test_cases_without_a_trace_or_below_the_severity_are_not_counted_and_twins_have_rows_of_their_own():
    named = verdict("named", ("table_friction", 0.9, {}))
    friction = ("linear_density", {"ratio": 2.0})
    cases = [
        Scored("weak", label("single", OBSTACLE, gap=2.0), verdict("none")),
        Scored("traceless", label("single", OBSTACLE, traceless=True), verdict("none")),
        Scored("twin", label("single", friction, twins={"table_friction": 0.01, "bending_stiffness": 0.9}), named),
    ]
    assert cases[2].twins == {"table_friction"}
    assert row(cases, "top-1 on").value == "no case"
    assert row(cases, "top-1, effects with a twin").value.startswith("0 % (0/1")
    assert row(cases, "top-1, a twin counts").value.startswith("100 % (1/1")


def test_false_alarms_have_an_exact_bound():
    cases = [Scored(str(i), label("none"), verdict("none")) for i in range(30)]
    assert rate_interval(0, 30)[1] == pytest.approx(1 - 0.05 ** (1 / 30))
    assert "at most 10 % with 95 %" in row(cases, "false alarms").value
    cases[0] = Scored("0", label("none"), verdict("unknown"))
    assert row(cases, "false alarms").value.startswith("3 % (1/30")


def test_unknown_on_known_effects_costs_the_recall_its_mark():
    cases = [Scored("u", label("unknown", BARREL), verdict("named+unknown", ("camera_similarity", 0.8, {})))]
    cases += [Scored(str(i), label("single", OBSTACLE), verdict("named", ("obstacle", 1.0, {}))) for i in range(8)]
    assert row(cases, "unknown recall at").reached
    cases += [Scored("x", label("single", OBSTACLE), verdict("unknown"))]
    assert not row(cases, "unknown recall at").reached  # one in nine
    assert row(cases, "unknown recall, no name").value.startswith("0 %")


@pytest.mark.parametrize(
    ("true", "said", "error"),
    [
        (BEND, {"centre_m": parameter(0.35, 0.3, 0.4)}, 0.05),
        (OBSTACLE, {"x_m": parameter(0.4, 0, 1), "y_m": parameter(0.23, 0, 1)}, 0.03),
        (("gripper_slip", {"gripper": 1, "time_s": 5.0, "distance_m": 0.01}), {"gripper": {"value": 0}}, 1.0),
        (("keypoint_bias", {"index": [3, 7], "offset_m": [0.01, 0.01]}), {"index": {"value": [3, 8]}}, 1 / 12),
        (("keypoint_bias", {"index": [3, 7], "offset_m": [0.01, 0.01]}), {"index": {"value": 3}}, 4 / 12),
        (BEND, {}, float("inf")),
    ],
)
def test_place_errors(true, said, error):
    case = Scored("a", label("single", true), verdict("named", (true[0], 1.0, said)))
    assert place_error(case, case.label["effects"][0]) == pytest.approx(error)


def test_effects_without_a_place_have_no_place_error():
    case = Scored("a", label("single", TILT), verdict("named", ("gravity_tilt", 1.0, {})))
    assert place_error(case, case.label["effects"][0]) is None


def test_directions_cover_across_a_turn():
    said = {"direction_rad": parameter(-3.15, -3.25, -3.05), "angle_rad": parameter(0.3, 0.2, 0.4)}
    case = Scored("a", label("single", TILT), verdict("named", ("gravity_tilt", 1.0, said)))
    assert dict(coverages(case)) == {"gravity_tilt.direction_rad": True, "gravity_tilt.angle_rad": False}


def test_shrinkage_is_compared_with_the_oracle_of_the_same_simulator_where_that_is_given():
    said = verdict("named", ("obstacle", 1.0, {}), shrinkage=0.6)
    case = Scored("a", label("single", OBSTACLE), said)
    assert shrinkage_ratio(case) == pytest.approx(0.6)
    said["gap"]["oracle_shrinkage"] = 0.8
    assert shrinkage_ratio(case) == pytest.approx(0.75)
    said["gap"]["shrinkage"] = None
    assert shrinkage_ratio(case) is None


def test_baselines_are_scored_beside_the_diagnosis():
    more = {"baselines": {"bic": "obstacle", "lowest_cost": "gravity_tilt"}}
    cases = [
        Scored("a", label("single", OBSTACLE), verdict("none", **more)),
        Scored("b", label("none"), verdict("none", baselines={"bic": None, "lowest_cost": "obstacle"})),
    ]
    found = {name: (top, alarms) for name, top, _, alarms in baselines(cases)}
    assert found["bic"][0].startswith("100 %") and found["bic"][1].startswith("0 %")
    assert found["lowest_cost"][0].startswith("0 %") and found["lowest_cost"][1].startswith("100 %")
    assert found["the diagnosis"][0].startswith("0 %")


def test_reliability_bins_the_first_names():
    right = Scored("a", label("single", OBSTACLE), verdict("named", ("obstacle", 0.85, {})))
    wrong = Scored("b", label("single", OBSTACLE), verdict("named", ("gravity_tilt", 0.87, {})))
    assert reliability([right, wrong]) == [(pytest.approx(0.86), 0.5, 2)]


def test_page_from_locked_labels(tmp_path):
    labels, verdicts, cases = (tmp_path / f"{name}.jsonl" for name in ("labels", "verdicts", "cases"))
    made = {
        "00000001": (label("none"), verdict("none")),
        "00000002": (label("single", OBSTACLE), verdict("named", ("obstacle", 0.9, {}), ranking=[("obstacle", 0.9)])),
        "00000003": (label("unknown", BARREL, family="B"), verdict("unknown")),
        "00000004": (label("single", TILT, family="C"), None),
    }
    for name, (true, said) in made.items():
        append_row(labels, {"name": name, "salt": "ab" + name, "label": true})
        append_row(verdicts, {"name": name, **({"verdict": said} if said else {"refused": "too short"})})
    assert publish_hashes(labels, cases) == 4
    assert all(set(row) == {"name", "hash"} for row in read_cases([cases]).values())
    write_cases(cases, read_cases([cases, labels, verdicts]))
    assert publish_hashes(labels, cases) == 4, "a set that is complete stays"
    rows = read_cases([cases])
    write_page(scored(rows, checked_labels(rows)), tmp_path / "page.md", "python score.py")
    page = (tmp_path / "page.md").read_text()
    assert "4 cases: 1 without effect, 2 single effects" in page and "1 without a verdict" in page
    assert "| gravity_tilt | missing 1 |" in page and "| obstacle |  |  | 1/1/1 |  |  |" in page
    assert (tmp_path / "page_confusion.png").stat().st_size > 0
    assert (tmp_path / "page_reliability.png").stat().st_size > 0


def test_a_changed_label_is_found(tmp_path):
    labels, cases = tmp_path / "labels.jsonl", tmp_path / "cases.jsonl"
    locked = {"name": "00000001", "salt": "abcd", "label": label("none")}
    append_row(labels, locked)
    publish_hashes(labels, cases)
    assert checked_labels(read_cases([cases, labels])) == {"00000001": locked["label"]}
    with pytest.raises(ValueError, match="no label"):
        checked_labels(read_cases([cases]))
    append_row(labels, {"name": "00000002", "salt": "abcd", "label": label("none")})
    assert list(checked_labels(read_cases([cases, labels]))) == ["00000001"], "a label without a hash is left out"
    append_row(labels, {**locked, "label": label("single", OBSTACLE)})
    with pytest.raises(ValueError, match="changed afterwards"):
        checked_labels(read_cases([cases, labels]))
    with pytest.raises(ValueError, match=r"say different things of case 00000001: \['hash'\]"):
        publish_hashes(labels, cases)
    assert digest(locked) != digest({**locked, "salt": "abce"})


def test_a_row_that_has_no_verdict_of_this_format_is_refused():
    row = {"verdict": {"schema": "cablejax-verdict/1", "verdict": "maybe"}}
    with pytest.raises(ValueError, match="maybe"):
        scored({"00000001": row}, {"00000001": label("none")})


@pytest.mark.parametrize("cases", sorted(BLIND.glob("*/cases.jsonl")), ids=lambda path: path.parent.name)
def test_the_kept_page_is_what_the_kept_rows_give(cases, tmp_path):
    rows, page = read_cases([cases]), cases.with_name("score.md").read_text()
    command = page.split("`")[1]
    write_page(scored(rows, checked_labels(rows)), tmp_path / "score.md", command)
    assert (tmp_path / "score.md").read_text() == page


def test_intervals_of_several_pieces_are_matched_by_index():
    true = ("keypoint_bias", {"index": [2, 6, 11], "offset_m": [0.01, 0.02, 0.03]})
    index = {"value": [11, 2], "ci90": None, "unit": ""}
    said = {"index": index, "offset_m": parameter([0.03, 0.02], [0.029, 0.031], [0.019, 0.021])}
    case = Scored("a", label("single", true), verdict("named", ("keypoint_bias", 0.9, said)))
    assert coverages(case) == [("keypoint_bias.offset_m", True), ("keypoint_bias.offset_m", False)]
    one = {"index": {**index, "value": 2}, "offset_m": parameter(0.01, 0.0, 0.02)}
    true = ("keypoint_bias", {"index": 2, "offset_m": 0.01})
    case = Scored("b", label("single", true), verdict("named", ("keypoint_bias", 0.9, one)))
    assert coverages(case) == [("keypoint_bias.offset_m", True)]
