"""Command lines in a model card make what they say, and name no local folder."""

import dataclasses
import pathlib
import shlex

import pytest
import tyro

from cablejax.cable import Cable, Discretisation
from cablejax.commands.reproduce import command_line, simulate_command
from cablejax.commands.simulate import Simulate
from cablejax.commands.train import Train
from cablejax.dataset.schema import DatasetConfig, Randomisation
from cablejax.simulate.motions import MotionConfig


@pytest.mark.parametrize(
    "config",
    [
        DatasetConfig(),
        DatasetConfig(n_trajectories=896, seed=1, motion=MotionConfig(start="random")),
        DatasetConfig(n_trajectories=320, seed=2, motion=MotionConfig(max_amplification=1e3)),
        DatasetConfig(
            n_steps=7, engine="mjx", discretisation=Discretisation(Cable(friction_coefficient=0.0), n_links=17)
        ),
        DatasetConfig(
            randomisation=Randomisation(stiffness=(0.1, 3.0)),
            discretisation=Discretisation(Cable(bending_stiffness=0.05)),
        ),
    ],
    ids=["default", "random", "free", "mjx", "stiffness"],
)
def test_the_command_of_a_data_set_asks_for_that_data_set(config):
    words = shlex.split(simulate_command(config, "name.zarr"))
    assert words[:2] == ["cablejax", "simulate"]
    parsed = tyro.cli(Simulate, args=words[2:], config=(tyro.conf.FlagCreatePairsOff,))
    assert parsed.dataset_config() == config
    assert parsed.out.name == "name.zarr" or config == DatasetConfig()


def test_a_data_set_beyond_the_options_says_so():
    config = DatasetConfig(discretisation=Discretisation(Cable(damping_time=0.3)))
    assert simulate_command(config, "name.zarr").startswith("# name.zarr: ")


def test_only_what_was_changed_is_said_and_no_local_folder():
    folders = tuple(pathlib.Path("/home/somebody") / name for name in ("a.zarr", "b.zarr"))
    train = Train(data=folders, out=pathlib.Path("/tmp/mine"), held_out=0.1, json=True, device="cpu")
    assert command_line(train, "train") == "cablejax train --data a.zarr b.zarr --out mine --held-out 0.1"
    assert command_line(dataclasses.replace(Train(), pretrain=5), "train") == "cablejax train --pretrain 5"
