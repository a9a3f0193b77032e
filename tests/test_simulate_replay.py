"""Recordings of another program, a rod in absolute coordinates, replayed open loop from its gripper poses."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from cablejax.cable import Discretisation
from cablejax.cable_file import config_of_log
from cablejax.gaplog import read_gap_log
from cablejax.simulate import MjxEngine, ThreadedEngine
from recorded_replay import replay_episode

FOLDER = Path(os.environ.get("CABLEJAX_DATA", "absent")).parent / "gap-dev"


def no_effect_logs() -> list[str]:
    if not (FOLDER / "labels.json").exists():
        return []
    labels = json.loads((FOLDER / "labels.json").read_text())
    return [name for name, label in labels.items() if label["kind"] == "none"]


@pytest.mark.skipif(not no_effect_logs(), reason="$CABLEJAX_DATA is unset or has no gap-dev beside it")
@pytest.mark.parametrize("name", no_effect_logs())
def test_threaded_engine_replays_a_log_down_to_its_noise(name):
    log = read_gap_log(FOLDER / f"{name}.npz")
    noise = json.loads((FOLDER / "labels.json").read_text())[name]["noise_mm"] * 1e-3
    engine = ThreadedEngine(config_of_log(log))
    for episode, motion in enumerate(log.meta["motion"]):
        ratio = replay_episode(engine, log, episode).rmse / noise
        demanding = motion.endswith(("approach_s", "approach_z"))
        assert ratio <= (2.0 if demanding else 1.15), f"{motion}: {ratio:.3f} times the noise"


@pytest.mark.skipif(not no_effect_logs(), reason="$CABLEJAX_DATA is unset or has no gap-dev beside it")
def test_mjx_engine_replays_as_the_threaded_one_does():
    log = read_gap_log(FOLDER / f"{no_effect_logs()[0]}.npz")
    config = config_of_log(log)
    reference = replay_episode(ThreadedEngine(config), log, 0)
    replayed = replay_episode(MjxEngine(config), log, 0)
    assert np.abs(replayed.keypoints - reference.keypoints).max() <= 1e-4
    assert abs(replayed.rmse - reference.rmse) <= 1e-5


def test_configuration_comes_from_the_log(tmp_path):
    meta = {
        "schema": "cablejax-gap-log/1",
        "cable": {
            "length_m": 0.8,
            "diameter_m": 0.006,
            "linear_density_kg_per_m": 0.05,
            "bending_stiffness_n_m2": 0.01,
            "bending_damping_s": 0.2,
        },
        "table": {"friction_coefficient": 0.3},
    }
    from cablejax.types import GapLog

    log = GapLog(
        time=np.zeros((1, 2)),
        keypoints=np.zeros((1, 2, 9, 2)),
        gripper_pose=np.zeros((1, 2, 2, 3)),
        gripper_command=np.zeros((1, 2, 2, 3)),
        episode_length=np.array([2]),
        meta=meta,
    )
    config = config_of_log(log)
    assert (config.cable.length, config.cable.n_keypoints, config.cable.friction_coefficient) == (0.8, 9, 0.3)
    assert (config.cable.bending_stiffness, config.cable.damping_time, config.cable.linear_density) == (0.01, 0.2, 0.05)
    assert isinstance(config, Discretisation)
