"""`cablejax diagnose` as a person or a script meets it."""

import dataclasses
import json
import pathlib

import numpy as np
import pytest

import spatial_cases
from cablejax.cli import main
from cablejax.commands import diagnose
from cablejax.gaplog import read_gap_log, write_gap_log
from diagnose_cases import record

ONLY = ["--only", "gripper_rotation_offset", "bending_stiffness", "keypoint_bias"]
OFFSET = ("gripper_rotation_offset", 0, (0.08,))
VERDICT = {
    "schema", "verdict", "effects", "equivalent", "ranking", "gap", "where", "next_motion", "sentence", "caveats",
    "seconds",
}  # fmt: skip
GAP = {
    "horizon_s", "before_rmse_mm", "noise_floor_mm", "after_rmse_mm", "shrinkage", "shrinkage_ci90",
    "held_out_episodes",
}  # fmt: skip


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> pathlib.Path:
    return write_gap_log(tmp_path_factory.mktemp("logs") / "offset.npz", record(OFFSET))


@pytest.fixture(scope="module")
def report(log, tmp_path_factory) -> pathlib.Path:
    folder = tmp_path_factory.mktemp("diagnosis") / "report"
    assert main(["diagnose", str(log), "--out", str(folder), *ONLY]) == 0
    return folder


def test_verdict_follows_the_format(report):
    verdict = json.loads((report / "verdict.json").read_text())
    assert verdict["schema"] == "cablejax-verdict/1" and set(verdict) >= VERDICT
    assert verdict["verdict"] == "named"
    (effect,) = verdict["effects"]
    assert effect["name"] == "gripper_rotation_offset" and 0.5 < effect["probability"] <= 1
    assert effect["parameters"]["gripper"]["value"] == 0
    angle = effect["parameters"]["angle_rad"]
    assert angle["unit"] == "rad" and angle["ci90"][0] < angle["value"] < angle["ci90"][1]
    assert angle["value"] == pytest.approx(0.08, abs=0.004)
    assert effect["location"] == {"along_cable_m": [0.0, 0.0], "time_s": None, "table_m": None}
    assert {entry["name"] for entry in verdict["ranking"]} == set(ONLY[1:])
    assert all(set(entry) >= {"name", "probability", "held_out_shrinkage"} for entry in verdict["ranking"])
    gap = verdict["gap"]
    assert set(gap) >= GAP and gap["held_out_episodes"] == [0, 1, 2, 3]
    assert gap["before_rmse_mm"] > gap["after_rmse_mm"] >= 0.9 * gap["noise_floor_mm"] > 0
    assert 0.9 < gap["shrinkage"] <= 1
    assert gap["shrinkage"] > 0.99, "of motions that no fit has seen"
    assert "explains more than 99 % of it" in verdict["sentence"]
    where = verdict["where"]
    assert len(where["along_cable_mm"]) == 13 and len(where["per_episode_mm"]) == 4 and where["regimes"]


def test_report_stands_alone_and_says_the_verdict(report):
    page = (report / "report.html").read_text()
    assert "rotation offset" in page
    assert 'src="http' not in page and "<script src" not in page


def test_what_is_there_stays_by_default(log, tmp_path, capsys):
    mine = tmp_path / "mine.txt"
    mine.write_text("keep me")
    assert main(["diagnose", str(log), "--out", str(tmp_path), *ONLY]) == 2
    said = capsys.readouterr().err
    assert "is not empty" in said and "--overwrite" in said
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.slow
def test_recordings_of_one_set_up_are_diagnosed_together(log, report, tmp_path, capsys):
    whole, halves = read_gap_log(log), []
    for name, rows in (("first", slice(0, 2)), ("second", slice(2, 4))):
        arrays = {
            field.name: getattr(whole, field.name)[rows] for field in dataclasses.fields(whole) if field.name != "meta"
        }
        meta = {**whole.meta, "motion": whole.meta["motion"][rows]}
        halves.append(str(write_gap_log(tmp_path / f"{name}.npz", type(whole)(meta=meta, **arrays))))
    folder = tmp_path / "report"
    assert main(["diagnose", *halves, "--out", str(folder), *ONLY]) == 0
    together, alone = (json.loads((f / "verdict.json").read_text()) for f in (folder, report))
    for field in ("verdict", "effects", "gap", "ranking"):
        assert together[field] == alone[field], field
    assert [one["name"] for one in together["rounds"]] == halves and not together["rounds_contradict"]
    assert alone["rounds"] is None
    assert "What each recording added" in (folder / "report.html").read_text()
    capsys.readouterr()
    assert main(["diagnose", halves[0], halves[0], "--out", str(tmp_path / "twice")]) == 2
    assert "share an episode with identical samples" in capsys.readouterr().err


@pytest.mark.slow
def test_script_gets_json_and_replaces_a_report_on_request(log, tmp_path, capsys):
    (tmp_path / "verdict.json").write_text("of yesterday")
    assert main(["diagnose", str(log), "--out", str(tmp_path), "--overwrite", "--json", *ONLY]) == 0
    shown = capsys.readouterr()
    summary = json.loads(shown.out)
    assert summary["verdict"] == "named" and pathlib.Path(summary["report"]).is_file()
    assert json.loads((tmp_path / "verdict.json").read_text())["verdict"] == "named"
    assert "screening 3 effects" in shown.err, "progress goes to stderr"


def test_goes_on_after_ctrl_c_with_half_a_report(log, tmp_path, capsys, monkeypatch):
    def half_written(log, folder, *, state, **_):
        (folder / "verdict.json").write_text("{}")
        state.write_text("{}")
        raise KeyboardInterrupt

    arguments = ["diagnose", str(log), "--out", str(tmp_path), *ONLY]
    with monkeypatch.context() as patch:
        patch.setattr(diagnose, "diagnose_and_report", half_written)
        assert main(arguments) == 130
        assert "Run the same command again" in capsys.readouterr().err
        assert main(arguments) == 130, "it begins anew"
        assert main([*arguments[:-1]]) == 2, "another diagnosis is not mixed with it"
    assert "holds an unfinished run with other options (" in capsys.readouterr().err
    assert (tmp_path / "parts" / "state.json").exists()


def refused(arguments, capsys) -> str:
    assert main(["diagnose", *map(str, arguments)]) == 2
    shown = capsys.readouterr()
    assert shown.out == "" and shown.err.startswith("cablejax: ") and shown.err.count("\n") == 1
    return shown.err


def test_unknown_effect_is_refused_with_the_known_ones(log, tmp_path, capsys):
    said = refused([log, "--out", tmp_path / "report", "--only", "gremlins"], capsys)
    assert "'gremlins'" in said and "bending_stiffness" in said
    assert not (tmp_path / "report").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--only", "obstacle"], "'obstacle'"),
        (["--only", "viscous_drag", "actuation_lag"], "'actuation_lag'"),
        (["--commissioning", "LOG"], "leave it out"),
        (["--bounds", "bounds.toml"], "leave it out"),
    ],
    ids=["effect", "arms", "commissioning", "bounds"],
)
def test_a_log_in_space_is_not_asked_for_what_only_the_plane_has(options, message, tmp_path, capsys):
    path = write_gap_log(tmp_path / "space.npz", spatial_cases.recording())
    options = [path if option == "LOG" else option for option in options]
    said = refused([path, "--out", tmp_path / "report", *options], capsys)
    assert message in said and "in space" in said
    assert not (tmp_path / "report").exists()


def test_a_log_in_space_is_searched_for_the_effects_of_space(tmp_path, monkeypatch):
    path, asked = write_gap_log(tmp_path / "space.npz", spatial_cases.recording()), []

    def stopped(log, *, only, **_):
        asked.append(only)
        raise ValueError("enough")

    monkeypatch.setattr("cablejax.spatial.diagnose.diagnose_space", stopped)
    assert main(["diagnose", str(path), "--out", str(tmp_path / "a"), "--only", "quadratic_drag"]) == 2
    assert main(["diagnose", str(path), "--out", str(tmp_path / "b")]) == 2
    assert asked == [("quadratic_drag",), None]


@pytest.mark.slow
def test_motion_is_designed_within_bounds_and_played_on_the_plant(log, tmp_path):
    bounds = tmp_path / "bounds.toml"
    bounds.write_text("workspace_m = [[-0.4, -0.5], [1.3, 0.7]]\nduration_s = 26\n")
    out, played = tmp_path / "report", tmp_path / "played"
    assert main(["diagnose", str(log), "--bounds", str(bounds), "--out", str(out), *ONLY]) == 0
    verdict = json.loads((out / "verdict.json").read_text())
    worth = verdict["next_motion_worth"]
    assert verdict["next_motion"] == "designed" and worth["search_ended"] in ("clear", "settled", "budget")
    assert worth["information_nats"] == max(worth["alternatives_nats"].values()) > 0
    assert "designed motion" in (out / "report.html").read_text() and (out / "next_motion.gif").stat().st_size > 1000
    plant = ["--plant-effect", "none", "--links", "12", "--noise-mm", "0.5"]
    arguments = ["shape", "--motion", str(out / "next_motion.npz"), *plant, "--out", str(played)]
    assert main(arguments) == 0
    done, asked = read_gap_log(played / "log.npz"), read_gap_log(out / "next_motion.npz")
    assert done.meta["motion"] == ["designed"] and done.meta["cable"] == asked.meta["cable"]
    np.testing.assert_allclose(done.gripper_pose, asked.gripper_pose, atol=2e-5)
    assert np.isfinite(done.keypoints).all() and done.time[0, -1] <= 26
    assert main(arguments) == 2, "what is there stays"


def test_bounds_that_exclude_every_motion_are_refused(log, tmp_path, capsys):
    bounds = tmp_path / "bounds.toml"
    bounds.write_text("workspace_m = [[5, 5], [6, 6]]\n")
    said = refused([log, "--bounds", bounds, "--out", tmp_path / "report"], capsys)
    assert "workspace excludes" in said and "Relax the first" in said


@pytest.mark.slow
def test_motion_that_was_not_executed_as_commanded_is_reported(tmp_path):
    moved = record(OFFSET)
    moved.gripper_command[:, 30:60, 0, 1] += 0.02
    path = write_gap_log(tmp_path / "moved.npz", moved)
    assert main(["diagnose", str(path), "--out", str(tmp_path / "report"), *ONLY]) == 0
    verdict = json.loads((tmp_path / "report" / "verdict.json").read_text())
    assert any("not executed as commanded" in text and "60 mm" in text for text in verdict["caveats"])
    # the cable itself is explained, and what is left is no unknown cause of the cable's
    assert verdict["verdict"] == "named+unknown" and verdict["effects"][0]["name"] == "gripper_rotation_offset"
    assert verdict["sentence"].startswith("With the measured poses: The gap comes from gripper rotation offset")
    assert "arms do not follow their commands" in verdict["sentence"] and verdict["leftover_p"] is None
    assert "are causes" not in (tmp_path / "report" / "report.html").read_text()


def test_an_exported_log_is_to_be_imported_first(tmp_path, capsys):
    (tmp_path / "a log.mcap").write_bytes(b"\x89MCAP0\r\n")
    for name, command in (("a log.mcap", "cablejax import mcap '"), (".", "cablejax import lerobot ")):
        assert main(["diagnose", str(tmp_path / name)]) == 2
        assert command in capsys.readouterr().err


def test_missing_file_is_refused(tmp_path, capsys):
    assert "nowhere.npz" in refused([tmp_path / "nowhere.npz", "--out", tmp_path / "report"], capsys)
    assert not (tmp_path / "report").exists()


def test_other_file_is_refused(tmp_path, capsys):
    other = tmp_path / "other.npz"
    np.savez(other, something=np.zeros(3))
    assert "lacks time" in refused([other, "--out", tmp_path / "report"], capsys)
    text = tmp_path / "notes.txt"
    text.write_text("not a log")
    assert "is no .npz archive" in refused([text, "--out", tmp_path / "report"], capsys)
    assert not (tmp_path / "report").exists()


def test_file_in_the_place_of_the_folder_is_refused(log, tmp_path, capsys):
    taken = tmp_path / "taken"
    taken.write_text("")
    assert "expected a folder" in refused([log, "--out", taken], capsys)


def test_log_without_noise_is_taken_with_a_caveat(tmp_path):
    path = write_gap_log(tmp_path / "clean.npz", still())
    assert main(["diagnose", str(path), "--out", str(tmp_path / "report"), *ONLY]) == 0
    verdict = json.loads((tmp_path / "report" / "verdict.json").read_text())
    assert verdict["verdict"] == "none" and any("no noise" in text for text in verdict["caveats"])


def still():
    """A log that a simulator wrote without a camera's noise, at rest."""
    log = record(noise_mm=0.0)
    log.keypoints[:] = log.keypoints[:, :1]
    log.gripper_pose[:] = log.gripper_pose[:, :1]
    log.gripper_command[:] = 0.0
    return log
