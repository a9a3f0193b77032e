"""`cablejax shape` and `cablejax demo` on a short run of a coarse plant: what they write, refuse and resume."""

import dataclasses
import json
import re

import numpy as np
import pytest

from cablejax.cable import Cable
from cablejax.cable_file import write_cable
from cablejax.cli import main
from cablejax.commands import runs
from cablejax.control.targets import straight_start
from cablejax.diagnose.motion_file import commands_log
from cablejax.gaplog import episodes_of, read_gap_log, stack_episodes, write_gap_log
from cli_cases import small_model

SHAPE_KEYS = {
    "initial_error_cm",
    "terminal_error_cm",
    "terminal_error_without_residual_cm",
    "settling_time_s",
    "mpc_ms_p50",
    "mpc_ms_p95",
}


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    return small_model(tmp_path_factory.mktemp("model"))


def shape_arguments(weights, out) -> list[str]:
    small = ["--steps", "2", "--links", "12", "--target", "U"]
    return ["shape", "--weights", str(weights), "--out", str(out), *small]


@pytest.mark.slow
def test_shape_is_resumed_where_it_was_interrupted_and_writes_everything(weights, tmp_path, capsys, monkeypatch):
    out = tmp_path / "run"
    done = []
    real = runs.shape_once

    def interrupted_in_the_second_run(*args, method, **kwargs):
        if done:
            raise KeyboardInterrupt
        done.append(method)
        return real(*args, method=method, **kwargs)

    monkeypatch.setattr(runs, "shape_once", interrupted_in_the_second_run)
    assert main(shape_arguments(weights, out)) == 130
    assert "Run the same command again" in capsys.readouterr().err
    assert not (out / "summary.json").exists()

    def counted(*args, method, **kwargs):
        done.append(method)
        return real(*args, method=method, **kwargs)

    monkeypatch.setattr(runs, "shape_once", counted)
    assert main([*shape_arguments(weights, out), "--json"]) == 0
    assert done == ["residual", "direct"]
    summary = json.loads(capsys.readouterr().out)
    assert summary == json.loads((out / "summary.json").read_text())
    assert set(summary) == {"shapes", "total_s"} and set(summary["shapes"]["U"]) == SHAPE_KEYS
    assert sorted(path.name for path in out.iterdir()) == ["demo.gif", "log.npz", "report.html", "summary.json"]

    log = read_gap_log(out / "log.npz")
    assert log.meta["motion"] == ["approach_u_residual", "approach_u_direct"]
    target = json.loads((out / "report.html").read_text().split('id="runs">')[1].split("</script>")[0])
    wanted = np.reshape(target["shapes"][0]["target"], (-1, 2))[::8] * 1e-4
    last = log.keypoints[0, log.episode_length[0] - 1]
    error = 100 * np.sqrt(((last - wanted) ** 2).sum(-1).mean())
    assert error == pytest.approx(summary["shapes"]["U"]["terminal_error_cm"], abs=0.02)
    assert summary["shapes"]["U"]["terminal_error_cm"] < summary["shapes"]["U"]["initial_error_cm"]


def test_results_are_not_overwritten_unasked(weights, tmp_path, capsys):
    (tmp_path / "summary.json").write_text("mine")
    assert main(shape_arguments(weights, tmp_path)) == 2
    assert "exists and is not empty" in capsys.readouterr().err
    assert (tmp_path / "summary.json").read_text() == "mine"


def test_a_motion_that_is_played_leaves_no_page_of_an_earlier_run_next_to_its_log(tmp_path):
    motion, out = tmp_path / "motion.npz", tmp_path / "run"
    write_gap_log(motion, commands_log({"rest": np.repeat(straight_start(Cable())[None], 4, axis=0)}, 0.5, Cable()))
    out.mkdir()
    for name in ("report.html", "summary.json", "demo.gif", "notes.txt"):
        (out / name).write_text("of another run")
    assert main(["shape", "--motion", str(motion), "--links", "8", "--out", str(out), "--overwrite"]) == 0
    assert sorted(path.name for path in out.iterdir()) == ["log.npz", "notes.txt"]


def test_a_motion_at_thirty_hertz_is_played_and_one_without_commands_refused(tmp_path, capsys):
    poses = np.repeat(straight_start(Cable())[None], 7, axis=0)
    poses[:, 1, 0] -= 0.01 * np.arange(7) / 6
    log = commands_log({"closer": poses}, 1 / 30, Cable())
    write_gap_log(tmp_path / "motion.npz", log)
    write_gap_log(tmp_path / "still.npz", dataclasses.replace(log, gripper_command=np.zeros_like(log.gripper_command)))
    play = ["shape", "--links", "8", "--out", str(tmp_path / "run"), "--motion"]
    assert main([*play, str(tmp_path / "motion.npz")]) == 0
    played = read_gap_log(tmp_path / "run" / "log.npz")
    np.testing.assert_allclose(played.time, log.time, atol=1e-8)
    np.testing.assert_allclose(played.gripper_pose, log.gripper_pose, atol=1e-4)
    assert main([*play, str(tmp_path / "still.npz"), "--overwrite"]) == 2
    assert "The motion has no commands, but its grippers move by 0.01 m" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("rates", "message"), [((3, 6), ""), ((25, 30), "episodes at 25 to 30 samples a second.*chosen")]
)
def test_episodes_of_other_rates_are_played_where_one_time_step_fits(rates, message, tmp_path, capsys):
    poses = np.repeat(straight_start(Cable())[None], 3, axis=0)
    logs = [commands_log({"rest": poses}, 1 / rate, Cable()) for rate in rates]
    log = stack_episodes([one for log in logs for one in episodes_of(log)], {**logs[0].meta, "motion": ["rest"] * 2})
    write_gap_log(tmp_path / "motion.npz", log)
    play = ["shape", "--links", "8", "--out", str(tmp_path / "run"), "--motion", str(tmp_path / "motion.npz")]
    assert main(play) == (2 if message else 0)
    said = capsys.readouterr().err
    assert re.search(message, said) if message else "samples a second" not in said
    assert (tmp_path / "run").exists() is not bool(message)


def test_a_motion_that_cannot_be_played_leaves_no_empty_folder(tmp_path, capsys):
    motion, out = tmp_path / "motion.npz", tmp_path / "run"
    write_gap_log(motion, commands_log({"rest": np.repeat(straight_start(Cable())[None], 4, axis=0)}, 0.5, Cable()))
    longer = tmp_path / "longer.toml"
    write_cable(longer, Cable(length=2.0))
    for option, value in (("--cable", "nothing.toml"), ("--links", "2"), ("--cable", str(longer))):
        assert main(["shape", "--motion", str(motion), option, value, "--out", str(out)]) == 2
        assert value in capsys.readouterr().err and not out.exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--target", "Q"], "Q"),
        (["--target", "missing.csv"], "missing.csv"),
        (["--weights", "nothing"], "nothing"),
        (["--steps", "0"], "--steps is 0"),
        (["--links", "2"], "n_links is 2"),
        (["--plant-effect", "bending_stiffness:ratio=-1"], "ratio is -1"),
        (["--plant-effect", "stiffness:ratio=2"], "no effect 'stiffness'"),
        (["--plant-effect", "none", "--plant-effect", "linear_density:ratio=2"], "give either"),
        (["--cable", "missing.toml"], "There is no file or folder missing.toml"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_bad_input_is_reported_before_anything_is_written(change, message, weights, tmp_path, capsys):
    assert main([*shape_arguments(weights, tmp_path / "run"), *change]) == 2
    shown = capsys.readouterr().err
    assert message in shown and "Traceback" not in shown
    assert not (tmp_path / "run").exists()


def test_targets_of_another_cable_are_refused(weights, tmp_path, capsys):
    line = np.stack([np.linspace(0.0, 2.0, 13), np.zeros(13)], axis=1)
    for name, points, message in (("long", line, "2 m long"), ("few", line[:5] / 2, "5 keypoints")):
        np.savez(tmp_path / f"{name}.npz", keypoints=points)
        arguments = [*shape_arguments(weights, tmp_path / "run"), "--target", str(tmp_path / f"{name}.npz")]
        assert main(arguments) == 2
        assert message in capsys.readouterr().err


@pytest.mark.slow
def test_demo_tells_its_story_in_a_table(weights, tmp_path, capsys):
    out = tmp_path / "demo"
    arguments = ["demo", "--weights", str(weights), "--out", str(out), "--steps", "1", "--links", "12", "--shapes", "S"]
    assert main(arguments) == 0
    shown = capsys.readouterr()
    assert shown.out.startswith("shape") and "\nS " in shown.out and "report.html" in shown.out
    assert "with online residual" in shown.err and "without residual" in shown.err
    assert set(json.loads((out / "summary.json").read_text())["shapes"]) == {"S"}
    assert "--shapes S --steps 1 --links 12" in (out / "report.html").read_text()


@pytest.mark.slow
def test_bench_mpc_times_the_control_call(weights, capsys):
    few = ["--solvers", "two-trials", "--batches", "2", "--repeats", "3"]
    assert main(["bench", "mpc", "--weights", str(weights), *few, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert 0 < result["p50_ms"] <= result["p95_ms"] < 1e3 * max(result["first_call_s"], 60.0)
    assert set(result["solvers"]) == {"two-trials"} and result["solver"] == "two-trials"
    assert result["p50_ms"] == result["solvers"]["two-trials"]["p50_ms"]
    assert set(result["batched"]) == {"2"}
    assert result["batched"]["2"]["plans_per_second"] == pytest.approx(2e3 / result["batched"]["2"]["ms"])


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (["--repeats", "0"], "--repeats is 0"),
        (["--batches", "2", "0"], "--batches is 0"),
        (["--horizon", "-1"], "--horizon is -1"),
        (["--solvers"], "expected at least one solver"),
    ],
    ids=str,
)
def test_bench_mpc_refuses_what_cannot_be_timed(wrong, message, capsys):
    assert main(["bench", "mpc", *wrong]) == 2
    assert message in capsys.readouterr().err
