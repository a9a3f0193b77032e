"""Perception on the command line."""

import json

import pytest

from cablejax.cli import main
from cablejax.gaplog import read_gap_log
from cli_cases import small_model
from perceive_cases import CAPACITY


def test_bench_perception_times_a_frame(capsys):
    assert main(["bench", "perception", "--points", str(CAPACITY), "--repeats", "3", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert 0 < result["p50_ms"] <= result["p95_ms"] and result["first_frame_ms"] > 0
    assert result["frames_per_second"] == pytest.approx(1e3 / result["p50_ms"])


def arguments(folder, *more):
    weights = small_model(folder / "model")
    return ["shape", "--weights", str(weights), "--out", str(folder / "run"), "--perception", "cloud", *more]


def test_impossible_noise_is_reported_before_anything_is_written(tmp_path, capsys):
    assert main(arguments(tmp_path, "--noise-mm", "-1")) == 2
    assert "--noise-mm is -1" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_cable_is_shaped_by_what_a_camera_sees(tmp_path, capsys):
    short = ["--steps", "2", "--links", "12", "--target", "U", "--method", "direct", "--json"]
    assert main(arguments(tmp_path, *short)) == 0
    summary = json.loads(capsys.readouterr().out)["shapes"]["U"]
    assert summary["terminal_error_without_residual_cm"] < summary["initial_error_cm"]
    log = read_gap_log(tmp_path / "run" / "log.npz")
    assert "depth camera" in log.meta["source"]
