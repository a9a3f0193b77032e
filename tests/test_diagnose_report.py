"""The page of a diagnosis and its verdict: what they say for every kind of verdict, and that they need nothing else."""

from __future__ import annotations

import dataclasses
import html.parser
import json
import re

import numpy as np
import pytest
from PIL import Image

import spatial_cases
from cablejax.cable import Cable, Discretisation
from cablejax.commands.cable import find_cable
from cablejax.control.targets import straight_start
from cablejax.diagnose.diagnosis import CableDiagnosis, Gap, NamedEffect, NextMotion, ParameterEstimate, Ranked
from cablejax.diagnose.judgement import verdict_sentence
from cablejax.diagnose.safe_motions import safe_motions
from cablejax.diagnose.verdict_json import verdict_json, write_verdict
from cablejax.diagnose.where import localise
from cablejax.effects import OUTSIDE
from cablejax.effects.given import OPTIONAL
from cablejax.gaplog import write_gap_log
from cablejax.report.diagnosis_charts import ranking_figure, shrinkage_figure
from cablejax.report.diagnosis_figures import where_figure, worst_moment
from cablejax.report.diagnosis_page import write_diagnosis_page
from cablejax.report.diagnosis_sections import detail_tables, ranking_note
from cablejax.report.effect_words import effect_place, instruction, parameter_title, quantity, share
from cablejax.report.motion_figures import motion_figure
from cablejax.report.spatial_figures import recording_ends
from cablejax.simulate.rod import Rod
from cablejax.spatial.cable import SpatialCable
from cablejax.spatial.gap import constant_offset, gap_of, in_log, smallest_gap, where_of
from cablejax.spatial.identify import layout_of
from cablejax.spatial.windows import windows_of
from diagnose_cases import arches, log_of, poses

MOTIONS = ("approach", "translation")
POINTS = 13
CURVED = NamedEffect(
    "intrinsic_curvature",
    0.93,
    {
        "centre_m": ParameterEstimate(0.31, (0.29, 0.33), "m"),
        "curvature_per_m": ParameterEstimate(1.25, (1.1, 1.4), "1/m"),
    },
    {"along_cable_m": [0.2, 0.42], "time_s": None, "table_m": None},
)
MARKS = NamedEffect(
    "keypoint_bias",
    0.8,
    {
        "index": ParameterEstimate([8, 4], None, ""),
        "offset_m": ParameterEstimate([0.0055, -0.004], [(0.005, 0.006), (-0.005, -0.003)], "m"),
    },
    {"along_cable_m": [0.33, 0.33], "time_s": None, "table_m": None},
)
OBSTACLE = NamedEffect(
    "obstacle",
    0.7,
    {"x_m": ParameterEstimate(0.4, (0.39, 0.41), "m"), "radius_m": ParameterEstimate(0.03, (0.02, 0.04), "m")},
    {"along_cable_m": None, "time_s": None, "table_m": [0.4, 0.1]},
)
GAIN = NamedEffect(
    "actuation_gain",
    0.9,
    {"gain": ParameterEstimate(0.8, (0.79, 0.81), "")},
    {"along_cable_m": None, "time_s": None, "table_m": None},
)
RANKING = (
    Ranked("intrinsic_curvature", 0.93, 0.97, 0.4),
    Ranked("gripper_rotation_offset", 0.07, 0.7, 1.6),
    Ranked("obstacle", 0.0, float("nan"), 2.9),
)


def following(motion: str, separates: tuple[str, ...], information: float, ended: str | None = None) -> NextMotion:
    """A made-up recommendation with two straight cables that move apart."""
    pose = poses("approach")
    shares = np.linspace(0.0, 1.0, POINTS)[:, None]
    straight = pose[:, None, 0, :2] * (1 - shares) + pose[:, None, 1, :2] * shares
    apart = 1e-3 * np.arange(len(pose))[:, None, None]
    names = separates or ("plasticity",)
    return NextMotion(
        motion,
        separates,
        information,
        float(np.log(max(len(separates), 1))),
        {motion: information, "translation": 0.01},
        pose,
        0.1,
        {name: straight + i * apart for i, name in enumerate(names)},
        ended,
    )


def diagnosis(verdict="named", **changes) -> CableDiagnosis:
    """A made-up diagnosis of two episodes whose gap is 3 mm in the middle of the cable."""
    s, nominal = np.linspace(0.0, 1.0, POINTS), arches(POINTS, MOTIONS)
    gap = 0.0 if verdict == "none" else 4e-3 * np.sin(np.pi * s)[:, None]
    noise = 1e-3 * np.random.default_rng(0).normal(size=nominal.shape)
    log = log_of((nominal + gap + noise).astype(np.float32), MOTIONS)
    values = {
        "verdict": verdict,
        "sentence": f"A sentence about {verdict} & nothing < else.",
        "effects": (CURVED,),
        "equivalent": (),
        "ranking": RANKING,
        "leftover_p": 0.037,
        "gap": Gap(
            horizon_s=9.9,
            before_rmse_mm=3.2,
            after_rmse_mm=1.1,
            noise_floor_mm=1.0,
            shrinkage=0.977,
            shrinkage_ci90=(0.95, 0.99),
            ahead_mm={"nominal": 2.9, "ridge": 2.2, "named": 1.4},
            horizons_mm={1.0: (2.0, 1.0), 5.0: (2.8, 1.1), 9.9: (3.2, 1.1)},
            held_out_episodes=(0, 1),
            split={"noise": 0.1, "named": 0.87, "learnable": 0.02, "unexplained": 0.01},
        ),
        "where": localise(log, nominal, np.full(POINTS, 1e-3)),
        "next_motion": following("mirror", ("intrinsic_curvature", "gripper_rotation_offset + obstacle"), 0.6),
        "baselines": {"lowest_cost": "plasticity", "bic": "intrinsic_curvature"},
        "caveats": ("No holds & <no> commissioning.",),
        "log": log,
        "nominal": nominal,
        "explained": nominal + gap,
        "noise_mm": np.ones(POINTS),
        "noise_correlation": np.zeros(3),
        "seconds": 12.3,
        "settings": {"jax": "0", "links": {"fit": 33}},
    }
    return CableDiagnosis(**{**values, **changes})


NO_GAP = Gap(
    horizon_s=1.0,
    before_rmse_mm=1.0,
    after_rmse_mm=1.0,
    noise_floor_mm=1.0,
    shrinkage=None,
    shrinkage_ci90=None,
    ahead_mm=None,
    horizons_mm={1.0: (1.0, 1.0)},
    held_out_episodes=(),
    split={"noise": 1.0, "named": 0.0, "learnable": 0.0, "unexplained": 0.0},
)
ALIKE = (("intrinsic_curvature", "gripper_rotation_offset"),)
THREE = (("intrinsic_curvature", "gripper_rotation_offset", "obstacle"),)
CHANCES = {"gripper_rotation_offset": 0.06, "obstacle": 0.004}
FAINT = ("taut", ("bending_stiffness", "table_friction"), 0.03)
CASES = {
    "named": (
        lambda: diagnosis(),
        "Cause named",
        [
            "0.31 m (0.29 to 0.33)",
            "98 %",
            "95 % to 99 %",
            "Record <b>mirror",
            "probability of 91 %",
            "compared with 50 % now",
        ],
    ),
    "named with the arms": (
        lambda: diagnosis(effects=(CURVED, GAIN)),
        "Cause named",
        ["inform a model of the cause", "cablejax shape --target Z --weights MODEL --with verdict.json"],
    ),
    "none": (
        lambda: diagnosis("none", effects=(), ranking=(), gap=NO_GAP, next_motion=None, explained=None, caveats=()),
        "No gap found",
        ["no effect is named", "No explanations are left to separate", "would have shown"],
    ),
    "ambiguous": (
        lambda: diagnosis("ambiguous", equivalent=ALIKE, next_motion=following(*FAINT)),
        "Cause narrowed down",
        [
            "intrinsic curvature or gripper rotation offset",
            "are indistinguishable",
            "No motion that was tried separates",
            "remove 4 % of the doubt",
            "A designed motion may",
        ],
    ),
    "inseparable": (
        lambda: diagnosis("ambiguous", equivalent=ALIKE, next_motion=following(*FAINT, "settled")),
        "Cause narrowed down",
        ["the best, the <b>designed motion", "Measure one of them by other means"],
    ),
    "with one that is improbable": (
        lambda: diagnosis("ambiguous", equivalent=THREE, effects=(dataclasses.replace(CURVED, alike=CHANCES),)),
        "Cause narrowed down",
        [
            "<p>intrinsic curvature or gripper rotation offset</p>",
            "<b>intrinsic curvature</b> and <b>gripper rotation offset</b> are indistinguishable",
            "<b>obstacle</b> would leave as little of the gap, but with a probability below 1 %",
        ],
    ),
    "named+unknown": (
        lambda: diagnosis("named+unknown", effects=(CURVED, MARKS, OBSTACLE), next_motion=None),
        "Part of the cause named",
        ["at keypoints 4 and 8", "x = 0.40 m", "-4.0 mm (-5.0 to -3.0)", "No motion of the library would help"],
    ),
    "unknown": (
        lambda: diagnosis("unknown", effects=(), next_motion=following("designed", (), 2.0, "settled")),
        "Cause unknown",
        [
            "which none of the tried effects explains",
            "closest: intrinsic curvature",
            "Record the <b>designed motion",
        ],
    ),
}


@pytest.fixture(scope="module", params=CASES)
def written(request, tmp_path_factory):
    build, badge, words = CASES[request.param]
    folder = tmp_path_factory.mktemp("diagnosis")
    (folder / "ranking.png").write_bytes(b"of an earlier diagnosis")
    result = build()
    page = write_diagnosis_page(result, folder)
    return result, folder, page.read_text(encoding="utf-8"), badge, words


class _Outside(html.parser.HTMLParser):
    """Collects what a page would fetch."""

    def __init__(self):
        super().__init__()
        self.fetched: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.fetched += [v for name, v in attrs if name in ("src", "href", "xlink:href", "data") and v]


@pytest.mark.parametrize("name", sorted(OPTIONAL))
def test_a_parameter_that_an_effect_may_have_is_reported_in_words(name):
    assert parameter_title(name) != name.replace("_", " ")


def test_page_says_the_verdict_and_what_belongs_to_it(written):
    _, _, page, badge, words = written
    assert badge in page
    for word in words:
        assert word in page, word


WORKS = {
    "named": "the gap shrinks by 98 % on episodes that no fit has seen. This verdict has 1 limit",
    "none": "The simulated cable moves like the recorded one",
    "unknown": "Not on this log",
}


def test_page_answers_a_strangers_questions_below_the_cards(written, tmp_path):
    result, folder, page, _, _ = written
    first = page.split("<svg")[0]
    for words in ("What is this?", "Does it work?", "On my cable?", "cablejax import csv", "cablejax diagnose log.npz"):
        assert words in first.split('class="cards"')[1]
    assert WORKS.get(result.verdict, "shrinks by") in first
    command = "cablejax simulate --cable simulated.npz --with verdict.json"
    named = [effect.name for effect in result.effects]
    assert (command in first) == bool(named and OUTSIDE.isdisjoint(named))
    # the file that the command names is there, and has the log's cable
    assert find_cable(folder / "simulated.npz") == find_cable(write_gap_log(tmp_path / "log.npz", result.log))


def test_page_needs_nothing_else(written):
    _, _, page, _, _ = written
    parser = _Outside()
    parser.feed(page)
    assert parser.fetched and all(link.startswith(("data:", "#")) for link in parser.fetched)
    assert not re.search(r"<script|@import|url\((?!#)", page)
    ids = re.findall(r'\bid="([^"]+)"', page)
    assert len(ids) == len(set(ids))


def test_text_from_outside_cannot_break_the_page(written):
    result, _, page, _, _ = written
    assert "&amp; nothing &lt; else." in page
    if result.caveats:
        assert "No holds &amp; &lt;no&gt; commissioning." in page


def test_figures_lie_beside_the_page(written):
    result, folder, _, _, _ = written
    names = {path.stem for path in folder.glob("*.png")}
    assert names == {"cable", "where", "shrinkage"} | ({"ranking"} if result.ranking else set())
    for path in folder.glob("*.png"):
        with Image.open(path) as picture:
            assert min(picture.size) > 100


def test_verdict_beside_the_page_is_strict_json_of_the_format(written):
    result, folder, _, _, _ = written
    verdict = json.loads((folder / "verdict.json").read_text(encoding="utf-8"), parse_constant=_refuse)
    assert verdict["schema"] == "cablejax-verdict/1" and verdict["verdict"] == result.verdict
    assert {"effects", "equivalent", "ranking", "gap", "where", "next_motion"} <= set(verdict)
    assert [e["name"] for e in verdict["effects"]] == [e.name for e in result.effects]
    assert len(verdict["where"]["along_cable_mm"]) == POINTS and len(verdict["where"]["per_episode_mm"]) == 2
    # what nothing was named for has not shrunk
    assert verdict["gap"]["shrinkage"] == (0.0 if result.verdict == "unknown" else result.gap.shrinkage)
    assert verdict["gap"]["best_shrinkage"] == result.gap.shrinkage
    assert verdict["gap"]["horizon_s"] == result.gap.horizon_s


def _refuse(constant):
    raise AssertionError(f"{constant} is not JSON")


def test_verdict_has_the_formats_effects():
    verdict = verdict_json(diagnosis())
    assert verdict["effects"][0] == {
        "name": "intrinsic_curvature",
        "probability": 0.93,
        "parameters": {
            "centre_m": {"value": 0.31, "ci90": [0.29, 0.33], "unit": "m"},
            "curvature_per_m": {"value": 1.25, "ci90": [1.1, 1.4], "unit": "1/m"},
        },
        "location": {"along_cable_m": [0.2, 0.42], "time_s": None, "table_m": None},
        "alike": {},
    }
    assert verdict["ranking"][2]["held_out_shrinkage"] is None
    assert verdict["next_motion"] == "mirror" and verdict["seconds"] == 12.3
    worth = verdict["next_motion_worth"]
    assert worth["information_nats"] == 0.6 and worth["doubt_nats"] == pytest.approx(np.log(2), rel=1e-5)
    assert worth["certainty"] == pytest.approx(0.5 * np.exp(0.6), rel=1e-5) and worth["inseparable"] is False
    assert verdict_json(diagnosis(next_motion=following(*FAINT)))["next_motion_worth"]["inseparable"] is False
    searched = diagnosis(next_motion=following(*FAINT, "settled"))
    assert verdict_json(searched)["next_motion_worth"]["inseparable"] is True


@pytest.fixture(scope="module")
def space(tmp_path_factory):
    """A made-up diagnosis in space that a forward search came to, and its page."""
    log = spatial_cases.recording()
    log = dataclasses.replace(log, meta={**log.meta, "recording": ["a", "a", "b", "c"]})
    windows = windows_of(log)
    cable = SpatialCable(Rod(16, twisting=False), layout_of(windows, spatial_cases.NOMINAL), windows)
    noise, along = windows.noise, np.sin(np.pi * np.linspace(0, 1, windows.keypoints.shape[2]))[:, None]
    before, after = (np.nan_to_num(windows.keypoints) + size * along for size in (0.03, 0.004))
    nominal, explained = (in_log(log, windows, part) for part in (before, after))
    stiffness = ParameterEstimate(0.06, (0.05, 0.07), "m^4/s^2")
    result = CableDiagnosis(
        verdict="named",
        sentence="A sentence.",
        effects=(
            NamedEffect(
                "bending_stiffness",
                None,
                {"ratio": ParameterEstimate(3.0, (2.5, 3.5), ""), "stiffness_over_density_m4_per_s2": stiffness},
                {"along_cable_m": None, "time_s": None, "table_m": None},
            ),
        ),
        equivalent=(),
        ranking=(
            Ranked("quadratic_drag", None, -3.19, 30.0, "did not help"),
            Ranked("bending_stiffness", None, 0.9, 8.0, "kept"),
            Ranked("lumped_mass", None, -0.5, 40.0, "not judged"),
        ),
        quantities={
            "stiffness_over_density_m4_per_s2": stiffness,
            "constant_offset_m": ParameterEstimate(constant_offset(after, windows), None, "m"),
        },
        leftover_p=None,
        gap=gap_of(before, after, cable, noise, smallest_gap(noise, cable.windows)),
        where=where_of(log, windows, before, noise, smallest_gap(noise, windows), ()),
        next_motion=None,
        baselines={},
        caveats=(),
        log=log,
        nominal=nominal,
        explained=explained,
        noise_mm=np.full(windows.n_keypoints, 1e3 * noise),
        noise_correlation=np.zeros(0),
        seconds=1.0,
        settings={},
    )
    folder = tmp_path_factory.mktemp("space")
    return result, write_diagnosis_page(result, folder).read_text(encoding="utf-8"), verdict_json(result)


def test_a_ranking_whose_first_takes_away_less_than_the_next_says_why():
    first, second = Ranked("stiffness_profile", 0.99, -0.4, 19.0), Ranked("intrinsic_curvature", 0.01, 0.6, 10.0)
    unknown = diagnosis("unknown", effects=(), ranking=(first, second))
    assert "Every motion has equal weight" in ranking_note(unknown)
    assert "equal weight" not in ranking_note(dataclasses.replace(unknown, ranking=(second, first)))


def test_in_space_what_was_not_computed_is_null_and_not_on_the_page(space):
    result, page, verdict = space
    assert [entry["probability"] for entry in (*verdict["effects"], *verdict["ranking"])] == [None] * 4
    assert verdict["next_motion"] is None and verdict["gap"]["split"]["learnable"] is None
    where = result.where
    assert (where.bend_per_m, where.episode_p, where.keypoint_p) == (None, None, None)
    assert "robability" not in page and "n/a" not in page.split("<h3>Record")[0].replace("> n/a <", "")
    assert "No motion was evaluated" in page and "No motion of the library" not in page


def test_in_space_the_page_describes_the_search_the_noise_and_the_units(space):
    result, page, verdict = space
    figure = ranking_figure(result)
    assert figure is not None and len(figure.axes) == 1
    assert [text.get_text() for text in figure.axes[0].texts] == ["-319 %", "90 %", "-50 %"]
    names = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert names == ["quadratic drag, did not help", "bending stiffness, kept", "lumped mass, not judged"]
    assert page.index("<td>did not help") < page.index("<td>kept") < page.index("<td>not judged")
    assert [entry["outcome"] for entry in verdict["ranking"]] == ["did not help", "kept", "not judged"]
    assert "forward search" in page and "Every effect alone" not in page and "tried alone" not in page
    assert "-319 %" in page
    # 4 mm in each coordinate at the middle of the cable, always: root of the mean of (4 sin)^2 over six markers
    assert "constant offsets of keypoints 2.6 mm" in page
    assert page.count("0.060 m^4/s^2 (0.050 to 0.070)") == 2
    assert verdict["quantities"]["stiffness_over_density_m4_per_s2"]["ci90"] == [0.05, 0.07]
    assert recording_ends(result, np.arange(4)).tolist() == [2, 3]
    assert recording_ends(result, np.array([0, 1])).tolist() == []
    # sizes without a test: no statement on which files deviate
    assert "It is largest in file" in page and "of 4 only" not in page
    assert verdict["where"]["along_cable_mm"][4] == pytest.approx(30, rel=0.1)
    assert [row["horizon_s"] for row in verdict["where"]["per_horizon_mm"]] == [1.0, 2.0]


def test_what_was_not_computed_of_an_effect_is_said_in_the_chart_and_in_the_table():
    result = diagnosis()
    assert not np.isfinite(result.ranking[-1].held_out_shrinkage)
    figure = ranking_figure(result)
    assert figure is not None and [text.get_text() for text in figure.axes[1].texts] == ["97 %", "70 %", "n/a"]
    assert all(np.isfinite(text.get_position()).all() for ax in figure.axes for text in ax.texts)
    head, rows = next((head, rows) for title, head, rows in detail_tables(result) if title.startswith("All effects"))
    assert dict(zip(head, rows[-1], strict=True))["share removed"] == "n/a"


def test_the_worst_moment_is_a_sample_of_a_log_shorter_than_the_smoothing():
    result = diagnosis()
    samples = result.log.time.shape[1]
    short = dataclasses.replace(result.log, time=result.log.time * 0.2 / result.log.time.max())
    episode, sample = worst_moment(dataclasses.replace(result, log=short))
    assert 0 <= episode < len(result.log.time) and 0 <= sample < samples


def test_failed_write_leaves_the_verdict_that_was_there(tmp_path):
    path = write_verdict(tmp_path / "verdict.json", diagnosis())
    before = path.read_text(encoding="utf-8")
    broken = dataclasses.replace(diagnosis(), sentence=object())
    with pytest.raises(ValueError, match="no value that JSON has"):
        write_verdict(path, broken)
    assert path.read_text(encoding="utf-8") == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((0.31, "m", (0.29, 0.33)), "0.31 m (0.29 to 0.33)"),
        ((0.0093, "m", (0.0087, 0.01)), "9.3 mm (8.7 to 10.0)"),
        ((0.2695, "", (0.2654, 0.2739)), "0.270 (0.265 to 0.274)"),
        ((1, ""), "1"),
        ((float("nan"), "m"), "n/a"),
        ((12.0, "s"), "12.0 s"),
        ((1.2e-7, "N m^2", (1e-7, 1.4e-7)), "1.2e-07 N m^2 (1e-07 to 1.4e-07)"),
        ((0.3, "rad", (0.3, 0.3)), "0.300 rad (0.300 to 0.300)"),
    ],
)
def test_quantities_have_the_digits_that_their_intervals_support(arguments, words):
    assert quantity(*arguments) == words


def test_shares_are_never_rounded_to_certainty():
    assert share(0.994) == share(0.9999) == share(1.0) == "> 99 %" and share(0.99) == "99 %"
    assert share(0.001) == share(0.009) == "< 1 %" and share(0.01) == "1 %" and share(0.0) == share(-1e-4) == "0 %"


def test_places_in_words():
    assert effect_place(CURVED) == "0.20 to 0.42 m from gripper 0"
    held = dataclasses.replace(CURVED, parameters={"gripper": ParameterEstimate(1, None, "")})
    assert effect_place(held) == "at gripper 1"


@pytest.mark.parametrize(("shrinkage", "confirmed"), [(None, True), (0.9, True), (0.01, False), (-0.3, False)])
def test_a_name_that_unseen_motions_do_not_confirm_is_said_to_be_fitted(shrinkage, confirmed):
    effect = NamedEffect("friction_patch", 0.99, {}, {})
    said = verdict_sentence("named", [effect], (), 0.93, shrinkage)
    share = 93 if shrinkage is None or not confirmed else 90
    assert said.startswith(f"The gap comes from friction patch, which explains {share} % of it.")
    assert ("unconfirmed: on motions left out of the fit" in said) == (not confirmed)


def test_the_figure_has_keypoints_and_times_where_they_are():
    """Uneven keypoints, one of them never observed, and a clock that does not begin at zero."""
    made = diagnosis()
    marks = np.linspace(0.0, 1.0, POINTS) ** 2
    keypoints = np.array(made.log.keypoints)
    keypoints[:, :, 4] = np.nan
    meta = {**made.log.meta, "keypoint_arclength_m": marks.tolist()}
    log = dataclasses.replace(made.log, keypoints=keypoints, time=made.log.time + 50.0, meta=meta)
    changed = dataclasses.replace(made, log=log, where=localise(log, made.nominal, np.full(POINTS, 1e-3)))
    figure = where_figure(changed)
    maps = [collection for ax in figure.axes for collection in ax.collections if hasattr(collection, "get_coordinates")]
    assert len(maps) >= len(log.episode_length)
    for cells in maps[: len(log.episode_length)]:
        corners = cells.get_coordinates()
        time, along = corners[0, :, 0], corners[:, 0, 1]
        assert time[0] == pytest.approx(50.0, abs=0.1) and (along[:-1] < marks).all() and (marks < along[1:]).all()
    texts = [text.get_text() for text in figure.axes[0].texts]
    assert "nan" not in " ".join(texts) and np.isnan(changed.where.along_cable_mm[4])


@pytest.mark.parametrize("length", [0.3, 3.0])
def test_a_point_of_the_cable_is_marked_as_broadly_on_every_cable(length):
    made = diagnosis(effects=(MARKS,))
    made.log.meta["keypoint_arclength_m"] = np.linspace(0.0, length, POINTS).tolist()
    strip = where_figure(made).axes[0]
    for line, index in zip(strip.lines, MARKS.parameters["index"].value, strict=True):
        middle = index / (POINTS - 1)
        np.testing.assert_allclose(line.get_xdata(), length * np.array([middle - 0.01, middle + 0.01]), rtol=1e-9)


def test_errors_of_hundredths_of_a_millimetre_are_not_drawn_as_zero():
    gap = dataclasses.replace(NO_GAP, noise_floor_mm=0.031, horizons_mm={1.0: (0.043, 0.043)}, ahead_mm={})
    figure = shrinkage_figure(diagnosis("none", gap=gap))
    assert {text.get_text() for text in figure.axes[0].texts} == {"0.04"}
    (legend,) = figure.legends
    assert "noise of the recording, 0.03 mm" in [text.get_text() for text in legend.get_texts()]


def test_a_motion_that_a_long_cable_does_not_end_in_time_is_said_to_be_cut():
    ends = {}
    for length in (1.0, 3.0):
        cable = Cable(length=length)
        pose = safe_motions(Discretisation(cable), straight_start(cable))["translation"]
        ends[length] = instruction(dataclasses.replace(following("translation", (), 0.6), poses=pose))
    assert ends[1.0].endswith("hold, and go back.")
    assert ends[3.0] == f"{ends[1.0]} At the speed that is allowed, the first 30 s of it were judged; it takes longer."


@pytest.mark.parametrize(("length", "bar"), [(0.3, "5 cm"), (3.0, "50 cm")])
def test_the_motion_to_record_next_has_a_scale_bar_of_the_cables_size(length, bar):
    made = following("mirror", (), 0.6)
    pose, shapes = made.poses * [length, length, 1.0], {k: length * p for k, p in made.shapes.items()}
    figure = motion_figure(dataclasses.replace(made, poses=pose, shapes=shapes))
    assert figure is not None and bar in [text.get_text() for ax in figure.axes for text in ax.texts]
