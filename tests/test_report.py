"""The report: what is drawn is where the cable was, and the page stands alone and says the numbers."""

import dataclasses
import html.parser
import json
import re

import numpy as np
import pytest
from PIL import Image

from cablejax.mpc import Action
from cablejax.report import figures
from cablejax.report.animation import write_gif
from cablejax.report.page import animation_data, headline, write_page
from cablejax.report.style import LIGHT, by_shape, cable_curve, common_window, gripper_outline
from report_cases import arc, demo_runs, run


def test_curve_follows_the_cable_between_its_keypoints():
    fine = arc(1.3, n=2001)
    curve = cable_curve(arc(1.3), np.array([[0, 0, -1.3], [0, 0, 1.3]]), n_points=101)
    distance = np.linalg.norm(curve[:, None] - fine[None], axis=-1).min(axis=1)
    assert distance.max() < 5e-4


def test_curve_leaves_the_gripper_along_its_direction():
    curve = cable_curve(arc(0.9), np.array([[0, 0, -0.9], [0, 0, 0.9]]), n_points=2001)
    first, last = curve[1] - curve[0], curve[-1] - curve[-2]
    assert np.arctan2(first[1], first[0]) == pytest.approx(-0.9, abs=5e-3)
    assert np.arctan2(last[1], last[0]) == pytest.approx(0.9, abs=5e-3)


def test_curve_bridges_missing_keypoints():
    points = arc(0.9)
    points[4] = np.nan
    assert np.isfinite(cable_curve(points)).all()


def test_windows_hold_every_cable_and_share_one_scale():
    runs = demo_runs()
    views = common_window(runs)
    sizes = {(round(x1 - x0, 9), round(y1 - y0, 9)) for x0, x1, y0, y1 in views.values()}
    assert len(sizes) == 1
    for (shape, _), one in runs.items():
        x0, x1, y0, y1 = views[shape]
        assert one.keypoints[..., 0].min() > x0 and one.keypoints[..., 0].max() < x1
        assert one.keypoints[..., 1].min() > y0 and one.keypoints[..., 1].max() < y1


@pytest.mark.parametrize(("length", "bar"), [(0.2, [0.05, "5 cm"]), (1.0, [0.2, "20 cm"]), (6.0, [1.0, "1 m"])])
def test_every_cable_is_drawn_alike(length, bar):
    """Grippers and margins go by the cable's length, and so does the scale bar."""

    def scaled(of):
        target = dataclasses.replace(of.target, keypoints=length * of.target.keypoints)
        pose = of.gripper_pose * [length, length, 1.0]
        return dataclasses.replace(of, target=target, keypoints=length * of.keypoints, gripper_pose=pose)

    reference = animation_data(demo_runs())
    data = animation_data({key: scaled(one) for key, one in demo_runs().items()})
    assert list(data["bar"]) == bar
    np.testing.assert_allclose(data["gripper"], length * np.array(reference["gripper"]))
    for shape, view in reference["view"].items():
        np.testing.assert_allclose(data["view"][shape], length * np.array(view))


@pytest.mark.parametrize("end", [0, 1])
def test_gripper_stands_behind_the_end_that_it_holds(end):
    theta = 0.7
    wrist = gripper_outline(np.array([0.2, -0.1, theta]), end, 1.0)[-1].mean(axis=0) - [0.2, -0.1]
    along = wrist @ [np.cos(theta), np.sin(theta)]
    assert np.sign(along) == (-1 if end == 0 else 1)


@pytest.mark.parametrize(
    "runs",
    [
        {("U", "residual"): run()},
        {("U", "residual"): run(n=2, short=0.5), ("U", "direct"): run(method="direct", n=2, short=0.5)},
    ],
    ids=["one method", "two methods, far from the goal"],
)
def test_figures_of_one_shape_have_room_for_their_legends(runs, tmp_path):
    for draw in (figures.final_shapes, figures.error_over_time, figures.residual_share, figures.motion_bound):
        draw(runs).savefig(tmp_path / "figure.svg")  # matplotlib warns where it has no room


@pytest.mark.parametrize(
    "draw",
    [figures.final_shapes, figures.error_over_time, figures.residual_share, figures.motion_bound, figures.snapshots],
)
def test_every_figure_has_its_panels_and_marks(draw, tmp_path):
    figure = draw(demo_runs())
    assert len(figure.axes) == (5 if draw is figures.snapshots else 2)
    figure.savefig(tmp_path / "figure.png")
    with Image.open(tmp_path / "figure.png") as picture:
        colours = {colour for _, colour in picture.convert("RGB").getcolors(1 << 24)}
    assert tuple(int(LIGHT.residual[i : i + 2], 16) for i in (1, 3, 5)) in colours


def test_error_figure_shows_the_errors():
    runs = demo_runs()
    panel = figures.error_over_time(runs).axes[0]
    drawn = {tuple(np.round(line.get_ydata(), 9)) for line in panel.lines if len(line.get_ydata()) > 2}
    assert drawn == {tuple(np.round(r.error_cm, 9)) for (shape, _), r in runs.items() if shape == "U"}


def test_where_the_cable_was_straightened_the_error_is_dotted_and_the_verdict_says_so():
    one = run(short=0.5)
    assert "straightened" not in one.verdict()
    action = np.append(np.repeat([Action.FOLLOW, Action.STRAIGHTEN], 4), np.nan)
    one = dataclasses.replace(one, action=action)
    panel = figures.error_over_time({("U", "residual"): one}).axes[0]
    (dotted,) = (line for line in panel.lines if line.get_color() == "white")
    np.testing.assert_array_equal(np.isfinite(dotted.get_ydata()), action == Action.STRAIGHTEN)
    assert any("for another try" in text.get_text() for text in panel.texts)
    assert one.verdict().endswith("It was being straightened for another try: more commands may reach the target.")


def test_share_is_blank_where_the_grippers_rested():
    one = run()
    pose = one.gripper_pose.copy()
    pose[5:] = pose[5]
    rested = {("U", "residual"): dataclasses.replace(one, gripper_pose=pose)}
    line = figures.residual_share(rested).axes[0].lines[0]
    np.testing.assert_array_equal(np.isfinite(line.get_ydata()), np.arange(9) < 5)


def test_gif_ends_on_the_last_sample_and_stays_small(tmp_path):
    write_gif(tmp_path / "demo.gif", demo_runs(), width=480, frames_per_second=4)
    assert (tmp_path / "demo.gif").stat().st_size < 3_000_000
    with Image.open(tmp_path / "demo.gif") as gif:
        assert gif.n_frames >= 3
        first = np.asarray(gif.convert("RGB"), dtype=int)
        gif.seek(gif.n_frames - 1)
        last = np.asarray(gif.convert("RGB"), dtype=int)
        assert gif.info["duration"] > 1000
    assert (last[0, 0] == 255).all()
    assert np.abs(first - last).sum(axis=-1).astype(bool).mean() > 0.01


class _Outside(html.parser.HTMLParser):
    """Collects what a page would fetch, and its scripts."""

    def __init__(self):
        super().__init__()
        self.fetched: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.fetched += [value for name, value in attrs if name in ("src", "href", "data") and value]

    def handle_data(self, data):
        self.text.append(data)


@pytest.fixture
def page(tmp_path):
    runs = demo_runs()
    write_gif(tmp_path / "demo.gif", runs, width=240, frames_per_second=2)
    shapes = {
        shape: {
            "initial_error_cm": 20.0,
            "terminal_error_cm": pair["residual"].terminal_error_cm,
            "terminal_error_without_residual_cm": pair["direct"].terminal_error_cm,
            "settling_time_s": None,
            "mpc_ms_p50": 100.0,
            "mpc_ms_p95": 120.0,
        }
        for shape, pair in by_shape(runs).items()
    }
    facts = {"seed": "7", "machine": "two <cores>"}
    write_page(
        tmp_path / "report.html",
        runs,
        shapes,
        about="A test & nothing else.",
        facts=facts,
        gif=tmp_path / "demo.gif",
    )
    return (tmp_path / "report.html").read_text(encoding="utf-8")


def test_page_needs_nothing_else(page):
    parser = _Outside()
    parser.feed(page)
    assert all(link.startswith(("data:", "#")) for link in parser.fetched)
    assert not re.search(r"@import|fetch\(|XMLHttpRequest|url\((?!#)", page)


def test_page_says_the_numbers(page):
    for one in demo_runs().values():
        assert f"{one.terminal_error_cm:.2f}" in page
    assert "two &lt;cores&gt;" in page and "A test &amp; nothing else." in page
    assert page.count("<svg") == 4
    assert "$" not in re.sub(r"<script>.*?</script>", "", page, flags=re.DOTALL)


def test_page_answers_a_strangers_questions_before_the_player(page):
    first = page.split('id="player"')[0]
    ends = [one.terminal_error_cm for (_, method), one in demo_runs().items() if method == "residual"]
    reached = f"{sum(end <= 1.0 for end in ends)} of {len(ends)} with online residual"
    for words in (
        "What is this?",
        "Does it work?",
        "On my cable?",
        reached,
        "cablejax shape --target Z --weights model",
    ):
        assert words in first


def test_pages_ids_are_unique(page):
    ids = re.findall(r'\bid="([^"]+)"', page)
    assert len(ids) == len(set(ids))


def test_page_carries_the_runs_for_its_player(page):
    data = json.loads(re.search(r'id="runs">(.*?)</script>', page, flags=re.DOTALL)[1])
    one = demo_runs()["U", "residual"]
    run_ = next(r for r in data["shapes"][0]["runs"] if r["method"] == "residual")
    np.testing.assert_allclose(np.reshape(run_["points"][-1], (-1, 2)) * 1e-4, one.keypoints[-1], atol=6e-5)


def test_missing_keypoints_reach_the_player_as_null():
    one = run()
    keypoints = one.keypoints.copy()
    keypoints[3, 5] = np.nan
    data = animation_data({("U", "residual"): dataclasses.replace(one, keypoints=keypoints)})
    assert data["shapes"][0]["runs"][0]["points"][3][10:12] == [None, None]


def test_headline_does_not_claim_what_the_residual_did_not_do():
    worse = {"residual": run("U", "residual", short=0.2), "direct": run("U", "direct", short=0.05)}
    title, _, ends = headline({"U": worse})
    assert title == f"The cable ends {worse['residual'].terminal_error_cm:.2f} cm away from U"
    assert f"{worse['direct'].terminal_error_cm:.2f}" in ends["direct"]


def test_headline_tells_reached_from_missed():
    runs = {"U": run("U"), "S": run("S", short=0.3), "Z": run("Z", short=0.02)}
    ends = [one.terminal_error_cm for one in runs.values()]
    title, *_ = headline({shape: {"residual": one} for shape, one in runs.items()})
    assert title == (
        f"The cable reaches U and Z to within {max(ends[0], ends[2]):.2f} cm, but it ends {ends[1]:.2f} cm away from S"
    )


def test_a_shape_name_cannot_break_the_page(tmp_path):
    runs = {("</script><b>", "residual"): run("</script><b>", "residual")}
    write_gif(tmp_path / "demo.gif", runs, width=120, frames_per_second=1)
    write_page(
        tmp_path / "report.html",
        runs,
        {},
        about="",
        facts={},
        gif=tmp_path / "demo.gif",
    )
    assert "</script><b>" not in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_a_shape_name_is_no_formula(tmp_path):
    runs = {("a$5_to_$9 <!--<script", "residual"): run("a$5_to_$9 <!--<script", "residual")}
    for draw in (figures.final_shapes, figures.error_over_time):
        draw(runs).savefig(tmp_path / "figure.svg")
    write_gif(tmp_path / "demo.gif", runs, width=120, frames_per_second=1)
    write_page(tmp_path / "report.html", runs, {}, about="", facts={}, gif=tmp_path / "demo.gif")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "a$5_to_$9" in page and "<!--<script" not in page


def test_a_report_of_no_runs_is_refused():
    with pytest.raises(ValueError, match="at least one run"):
        by_shape({})


def test_curve_of_a_cable_that_was_not_seen_is_empty():
    assert np.isnan(cable_curve(np.full((13, 2), np.nan), np.zeros((2, 3)), 49)).all()
    one = np.full((13, 2), np.nan)
    one[4] = 0.5
    np.testing.assert_array_equal(cable_curve(one, n_points=5), np.full((5, 2), 0.5))
