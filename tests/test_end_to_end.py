"""From nothing to a shaped cable with the commands of the README, on a tiny configuration."""

import json

import numpy as np

from cablejax.cli import main
from cablejax.gaplog import read_gap_log


def result_of(arguments: list[str], capsys) -> dict:
    assert main([*arguments, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_simulate_train_and_shape(tmp_path, capsys):
    data, model, out = (str(tmp_path / name) for name in ("data.zarr", "model", "run"))
    made = result_of(["simulate", "--out", data, "--trajectories", "3", "--steps", "21", "--links", "9"], capsys)
    assert made["complete"] == 3

    small = ["--preset", "smoke", "--steps", "4", "--batch", "2", "--latent", "8", "--message-passing", "1"]
    trained = result_of(["train", "--data", data, "--out", model, "--held-out", "0.3", *small], capsys)
    assert trained["steps"] == 4

    shaping = [
        "--target",
        "U",
        "--method",
        "residual",
        "--steps",
        "2",
        "--links",
        "12",
        "--solver",
        "projected-gradient",
    ]
    summary = result_of(["shape", "--weights", model, "--out", out, *shaping], capsys)
    shaped = summary["shapes"]["U"]
    assert shaped["terminal_error_cm"] < 0.7 * shaped["initial_error_cm"]

    log = read_gap_log(tmp_path / "run" / "log.npz")
    assert log.meta["motion"] == ["approach_u_residual"]
    commands = log.gripper_command[0, : log.episode_length[0]]
    assert np.linalg.norm(commands * [1.0, 1.0, 0.15], axis=-1).max() <= 0.05 + 1e-6
    ends = log.keypoints[0, : log.episode_length[0], [0, -1]].swapaxes(0, 1)
    np.testing.assert_allclose(ends, log.gripper_pose[0, : log.episode_length[0], :, :2], atol=1e-3)
