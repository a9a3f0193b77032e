"""Rounds of recording and diagnosis on a plant: `cablejax study`."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from cablejax.cable import Cable
from cablejax.cli import main
from cablejax.commands.study import finished_rounds, remove_rounds
from cablejax.control.targets import make_target, straight_start
from cablejax.diagnose.diagnosis import Diagnosis, Gap, NamedEffect, Ranked
from cablejax.diagnose.motion_bounds import Bounds
from cablejax.diagnose.motion_file import commands_log
from cablejax.diagnose.safe_motions import there_and_back
from cablejax.diagnose.study import ended, first_recording, left_open
from cablejax.diagnose.verdict_json import read_verdict, write_verdict
from cablejax.gaplog import read_gap_log, write_gap_log
from cablejax.report.study_sheet import study_sheet

LONG = Cable(length=1.5, linear_density=0.05, bending_stiffness=0.05, n_keypoints=17)
GOALS = {letter: make_target(letter, LONG).gripper_pose for letter in ("U", "S", "Z")}


def found(name: str, alike: float | None = None) -> Diagnosis:
    """A diagnosis that names friction, and leaves density with this probability in its place."""
    effects = (
        ()
        if name in ("none", "unknown")
        else (NamedEffect("table_friction", 0.9, {}, {}, {} if alike is None else {"linear_density": alike}),)
    )
    return Diagnosis(
        verdict=name,  # pyright: ignore[reportArgumentType]
        sentence="",
        effects=effects,
        equivalent=() if alike is None else (("table_friction", "linear_density"),),
        ranking=(Ranked("table_friction", 0.9, 0.9, 0.1), Ranked("linear_density", alike, 0.9, 0.1)),
        leftover_p=None,
        gap=Gap(30.0, 5.0, 1.0, 1.0, 0.9, None, None, {}, (0,), {}),
        where=None,
        next_motion=None,
        baselines={},
        caveats=(),
        seconds=1.0,
        settings={},
    )


@pytest.mark.parametrize(
    ("one", "inseparable", "rounds_left", "why"),
    [
        (found("none"), None, 2, "clear"),
        (found("named"), False, 2, "clear"),
        (found("unknown"), None, 2, "unknown"),
        # the log shows too little of a gap that effects of the library would explain
        (dataclasses.replace(found("unknown"), undecided=True), False, 2, None),
        (dataclasses.replace(found("unknown"), undecided=True), False, 0, "rounds"),
        (dataclasses.replace(found("unknown"), undecided=True), True, 2, "inseparable"),
        (found("named+unknown"), False, 2, "unknown"),
        (found("ambiguous", 0.1), False, 2, None),
        (found("ambiguous", 0.1), False, 0, "rounds"),
        (found("ambiguous", 0.1), True, 2, "inseparable"),
        (found("ambiguous", 0.1), None, 2, "inseparable"),
        (found("ambiguous", 0.001), False, 2, "clear"),
    ],
)
def test_a_study_goes_on_only_where_a_motion_can_tell_more(one, inseparable, rounds_left, why):
    worth = None if inseparable is None else {"inseparable": inseparable}
    assert ended(one, worth, rounds_left=rounds_left) == why


def test_effects_that_act_together_are_no_alternatives():
    one = found("ambiguous", 0.1)
    curved = NamedEffect("intrinsic_curvature", 0.99, {}, {})
    both = dataclasses.replace(one, effects=(*one.effects, curved))
    page = study_sheet([one, both], [["U"], ["S"]], "inseparable", ())
    assert page.title == "After 2 recordings: table friction (or linear density) and intrinsic curvature"
    ((_, _, (first, second)),) = page.tables
    assert first[2] == "table friction or linear density" and second[2] in page.title
    assert left_open(both) == ("table_friction", "linear_density", "intrinsic_curvature")
    # one of each gripper, and a look-alike: not clear, though no more names are left than effects
    twice = dataclasses.replace(one, effects=one.effects * 2)
    assert ended(twice, {"inseparable": False}, rounds_left=2) is None


def test_the_page_of_a_study_without_a_gap_claims_no_cause_and_no_second_recording():
    page = study_sheet([found("none")], [["U"]], "clear", ())
    cards = {name: (value, note) for name, value, note in page.cards}
    assert cards["Verdict"] == ("no gap", "") and cards["Error"] == ("5.0 mm", "nothing is named")
    assert page.tables[0][2][0][3] == "5.0 mm" and page.following == ()
    named = study_sheet([found("named")] * 2, [["U"], ["S"]], "clear", ())
    assert dict((name, value) for name, value, _ in named.cards)["Error"] == "5.0 → 1.0 mm"
    assert named.following[-1] == "What each recording added: round_2/report.html"
    (axes, _) = named.figures[0][0].axes
    bar, full = axes.patches[0].get_width(), axes.get_xlim()[1] / 1.12
    assert bar / full == pytest.approx(0.9) and axes.texts[0].get_text() == "90 %", "as the number beside it says"


def test_first_recording_goes_to_the_goals_and_back_in_the_middle_of_the_workspace():
    bounds = Bounds(workspace=((1.0, 1.0), (3.4, 3.4)), speed=0.03)
    log = first_recording(LONG, straight_start(LONG), GOALS, bounds)
    assert log.meta["motion"] == ["U", "S", "Z"] and log.meta["cable"]["length_m"] == 1.5
    speed = np.linalg.norm(np.diff(log.gripper_pose[..., :2], axis=1), axis=-1) / np.diff(log.time)[..., None]
    assert speed.max() < 0.0301
    for poses, goal in zip(log.gripper_pose, GOALS.values(), strict=True):
        nearest = np.abs(poses - goal - [2.2, 2.2, 0.0])[..., :2].max(axis=(1, 2)).min()
        assert nearest < 1e-3
    np.testing.assert_allclose(log.gripper_pose[:, 0, :, :2].mean(axis=1), 2.2, atol=1e-6)


def test_bounds_without_room_are_refused():
    with pytest.raises(
        ValueError, match=r"\(U, S, Z\) keeps the bounds: workspace excludes 3.*Record a first motion of your own"
    ):
        first_recording(LONG, straight_start(LONG), GOALS, Bounds(workspace=((0.0, 0.0), (0.5, 0.5))))
    # the cable counts too, which sweeps farther than the grippers
    disc = Bounds(keep_out=((0.0, -0.45, 0.12),))
    with pytest.raises(ValueError, match="keep_out excludes 3"):
        first_recording(LONG, straight_start(LONG), GOALS, disc)
    low = Bounds(workspace=((-1.05, -0.45), (1.05, 0.45)))
    assert first_recording(LONG, straight_start(LONG), GOALS, low).meta["motion"] == ["Z"]
    narrow = Bounds(max_distance=0.9 * LONG.length)
    log = first_recording(LONG, straight_start(LONG), GOALS, narrow)
    apart = np.linalg.norm(log.gripper_pose[:, :, 1, :2] - log.gripper_pose[:, :, 0, :2], axis=-1)
    assert apart[:, 0].max() <= 0.9 * LONG.length + 1e-9 and len(log.episode_length) == len(GOALS)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--rounds", "0"], "--rounds is 0"),
        (["--noise-mm", "1e6"], "--noise-mm is 1000000.0"),
        (["--plant-effect", "magic:x=1"], "no effect 'magic'"),
        (["--plant-effect", "none", "--plant-effect", "linear_density:ratio=2"], "give either"),
        (["--bounds", "none.toml"], "none.toml"),
    ],
)
def test_bad_input_is_refused_before_anything_is_recorded(options, message, tmp_path, capsys):
    assert main(["study", *options, "--out", str(tmp_path / "study")]) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "study").exists()


def test_damaged_rounds_are_made_again_and_those_of_an_earlier_study_deleted(tmp_path, capsys):
    for number in (1, 2, 3):
        (tmp_path / f"round_{number}").mkdir()
        write_verdict(tmp_path / f"round_{number}" / "verdict.json", found("ambiguous", 0.1))
        commands = first_recording(LONG, straight_start(LONG), GOALS)
        write_gap_log(tmp_path / f"recording_{number}.npz", commands)
        write_gap_log(tmp_path / f"round_{number}" / "next_motion.npz", commands)
    (tmp_path / "report.html").write_text("of three rounds")
    state = tmp_path / "parts" / "state.json"
    assert finished_rounds(state) == 0 and capsys.readouterr().err == "", "none was begun"
    state.parent.mkdir()
    for text, rounds in (('{"rounds": 3}', 3), ('{"rounds": 4}', 3), ("[]", 0), ('{"rounds": "3"}', 0), ("{", 0)):
        state.write_text(text)
        assert finished_rounds(state) == rounds
        assert ("made again" in capsys.readouterr().err) == (rounds == 0 or "4" in text)
    state.write_text('{"rounds": 3}')
    (tmp_path / "recording_2.npz").write_bytes(b"cut off")
    assert finished_rounds(state) == 1 and "Round 2 was kept, but is damaged" in capsys.readouterr().err
    # a fourth round that a kill left without a verdict, and files of the user, who has no fifth
    (tmp_path / "round_4").mkdir()
    write_gap_log(tmp_path / "recording_4.npz", first_recording(LONG, straight_start(LONG), GOALS))
    (tmp_path / "recording_5.npz").write_text("mine")
    (tmp_path / "round_7").mkdir()
    remove_rounds(tmp_path, 1)
    kept = {path.name for path in tmp_path.iterdir()}
    assert kept == {"parts", "recording_1.npz", "round_1", "recording_5.npz", "round_7"}
    (tmp_path / "round_2").mkdir()
    (tmp_path / "round_2" / "photo.jpg").write_text("mine")
    remove_rounds(tmp_path, 1)
    assert (tmp_path / "round_2" / "photo.jpg").exists()


def test_a_study_that_goes_on_with_fewer_rounds_keeps_none_beyond_them(tmp_path, monkeypatch):
    begun, commands = [], commands_log({"U": np.repeat(straight_start(LONG)[None], 20, axis=0)}, 0.1, LONG)

    def play(_, commands, **__):
        if len(begun) == 2:
            raise KeyboardInterrupt
        begun.append(commands)
        return commands

    def diagnosed(log, folder, **_):
        write_verdict(folder / "verdict.json", found("ambiguous", 0.1))
        write_gap_log(folder / "next_motion.npz", log)
        return found("ambiguous", 0.1), folder / "report.html"

    monkeypatch.setattr("cablejax.diagnose.study.first_recording", lambda *_: commands)
    monkeypatch.setattr("cablejax.simulate.play.play", play)
    monkeypatch.setattr("cablejax.gaplog_join.joined", lambda recordings, _: recordings[-1])
    monkeypatch.setattr("cablejax.commands.diagnose.diagnose_and_report", diagnosed)
    monkeypatch.setattr("cablejax.diagnose.study.ended", lambda *_, rounds_left: None if rounds_left else "rounds")
    study = ["study", "--out", str(tmp_path), "--links", "16", "--rounds"]
    assert main([*study, "3"]) == 130 and (tmp_path / "round_2").exists()
    assert main([*study, "1"]) == 0
    assert len(json.loads((tmp_path / "summary.json").read_text())["rounds"]) == 1
    kept = {path.name for path in tmp_path.iterdir()}
    assert kept == {"recording_1.npz", "report.html", "round_1", "summary.json"}


@pytest.mark.slow
def test_a_study_ends_with_a_verdict_on_all_recordings_and_goes_on_after_a_kill(tmp_path, monkeypatch):
    out = tmp_path / "study"
    # a softer cable of 1 m: the first recording leaves several causes
    arguments = ["study", "--plant-effect", "bending_damping:time_s=1", "--rounds", "2", "--out", str(out)]
    diagnosed = []
    from cablejax.commands import diagnose

    real = diagnose.diagnose_and_report

    def counted(log, folder, **options):
        diagnosed.append(log.meta["motion"])
        return real(log, folder, **options)

    monkeypatch.setattr(diagnose, "diagnose_and_report", counted)

    def killed(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("cablejax.simulate.play.play", killed)
        assert main(arguments) == 130
    assert main(arguments) == 0 and len(diagnosed) >= 1
    summary = json.loads((out / "summary.json").read_text())
    rounds, worth = summary["rounds"], summary["verdict"]["next_motion_worth"]
    last = read_verdict(out / f"round_{len(rounds)}" / "verdict.json")
    assert summary["ended"] == ended(last, worth, rounds_left=2 - len(rounds))
    assert "bending_damping" in rounds[-1]["left_open"]
    assert diagnosed[-1] == [motion for one in rounds for motion in one["motions"]]
    recorded = [read_gap_log(out / f"recording_{k}.npz") for k in range(1, len(rounds) + 1)]
    assert [log.meta["motion"] for log in recorded] == [one["motions"] for one in rounds]
    page = (out / "report.html").read_text()
    assert f"round_{len(rounds)}/report.html" in page and "bending_damping" in page
    assert main(arguments) == 2, "what is there stays"


def test_a_first_recording_fits_into_short_motions_and_takes_as_long_as_slow_ones_need():
    start, goal = straight_start(LONG), GOALS["U"]
    short = there_and_back(start, goal, Bounds(duration=20.0))
    assert len(short) == 201
    slow = there_and_back(start, goal, Bounds(speed=0.01, turn_rate=0.1, duration=300.0))
    assert np.abs(slow - goal).max(axis=(1, 2)).min() < 1e-3
    np.testing.assert_allclose(slow[-1], start, atol=1e-6)


def test_a_first_recording_turns_the_short_way_round():
    """Grippers whose line passes the turn of the circle on the way."""
    start, goal = straight_start(LONG), GOALS["U"]

    def turned(pose: np.ndarray, angle: float) -> np.ndarray:
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        return np.concatenate([pose[:, :2] @ turn, pose[:, 2:] + angle], axis=1)

    ahead, behind = (
        there_and_back(turned(start, heading - 0.05), turned(goal, heading + 0.05), Bounds())
        for heading in (0.0, np.pi)
    )
    assert len(ahead) == len(behind)
    np.testing.assert_allclose(np.ptp(ahead[..., 2], axis=0), np.ptp(behind[..., 2], axis=0), atol=1e-6)
