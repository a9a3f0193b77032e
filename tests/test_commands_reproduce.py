"""Command lines in a model card make what they say, and name no local folder."""

import dataclasses
import json
import pathlib
import shlex
import types

import pytest
import tyro

from cablejax.cable import Cable, Discretisation
from cablejax.cable_file import cable_to_fields, write_cable
from cablejax.commands.cable import find_cable
from cablejax.commands.reproduce import command_line, simulate_command
from cablejax.commands.runs import known_from
from cablejax.commands.simulate import Simulate
from cablejax.commands.train import Train
from cablejax.control.shaping import load_model
from cablejax.dataset.schema import DatasetConfig, Randomisation
from cablejax.dynamics.train_config import PRESETS
from cablejax.effects.given import parse_effect
from cablejax.simulate.motions import MotionConfig

LONG = Cable(length=1.5, linear_density=0.05, bending_stiffness=0.05, n_keypoints=17)


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
            discretisation=Discretisation(LONG, timestep=0.1),
            motion=MotionConfig.for_length(1.5),
        ),
        DatasetConfig(
            engine="chain",
            effects=(
                parse_effect("bending_stiffness:ratio=1.2345678901234567"),
                parse_effect("friction_patch:x_m=0.1,y_m=-0.2,radius_m=0.05,coefficient=0.4"),
            ),
        ),
    ],
    ids=["default", "random", "free", "mjx", "cable and time step", "effects"],
)
def test_the_command_of_a_data_set_asks_for_that_data_set(config, tmp_path):
    write_cable(tmp_path / "cable.toml", config.cable)
    words = shlex.split(simulate_command(config, "name.zarr"))
    assert words[:2] == ["cablejax", "simulate"]
    assert ("--cable" in words) == (config.cable != Cable())
    words = [str(tmp_path / word) if word == "cable.toml" else word for word in words]
    parsed = tyro.cli(Simulate, args=words[2:], config=(tyro.conf.FlagCreatePairsOff,))
    assert parsed.dataset_config() == config
    assert parsed.out.name == "name.zarr" or config == DatasetConfig()


def test_the_effects_of_a_verdict_are_added_to_those_given(tmp_path):
    verdict = {
        "schema": "cablejax-verdict/1",
        "verdict": "named",
        "effects": [{"name": "linear_density", "parameters": {"ratio": {"value": 1.5, "ci90": None, "unit": ""}}}],
    }
    (tmp_path / "verdict.json").write_text(json.dumps(verdict))
    words = ["--effect", "bending_stiffness:ratio=2", "--with", str(tmp_path / "verdict.json"), "--engine", "chain"]
    parsed = tyro.cli(Simulate, args=words, config=(tyro.conf.FlagCreatePairsOff,)).dataset_config()
    assert list(map(str, parsed.effects)) == ["bending_stiffness:ratio=2", "linear_density:ratio=1.5"]
    words = shlex.split(simulate_command(parsed, "name.zarr"))
    assert tyro.cli(Simulate, args=words[2:], config=(tyro.conf.FlagCreatePairsOff,)).dataset_config() == parsed


def test_the_cable_of_a_verdict_is_simulated_and_another_one_refused(tmp_path):
    """An effect is one of the cable to which it is added."""
    theirs = Cable(length=2.0, bending_stiffness=0.08, n_keypoints=9)
    named = {"name": "bending_stiffness", "parameters": {"ratio": {"value": 1.5, "ci90": None, "unit": ""}}}
    verdict = {"schema": "cablejax-verdict/1", "verdict": "named", "cable": cable_to_fields(theirs), "effects": [named]}
    path = tmp_path / "verdict.json"
    path.write_text(json.dumps(verdict))
    assert Simulate(with_=(path,)).dataset_config().cable == theirs
    assert find_cable(path) == theirs
    write_cable(tmp_path / "own.toml", dataclasses.replace(theirs, length=1.9))
    with pytest.raises(ValueError, match=r"another cable than this one \(length_m = 2, not 1.9\).*Leave --cable out"):
        Simulate(cable=tmp_path / "own.toml", with_=(path,)).dataset_config()
    with pytest.raises(ValueError, match=r"bending_stiffness_n_m2 = 0\.08, not 0\.02"):
        known_from(load_model("gns-reference"), (), (path,))


@pytest.mark.parametrize(("range_of", "field"), [("friction", "friction_coefficient"), ("damping", "damping_time")])
def test_factors_of_a_value_of_zero_are_refused(tmp_path, range_of, field):
    write_cable(tmp_path / "cable.toml", Cable(**{field: 0.0}))
    with pytest.raises(ValueError, match=f"--{range_of}-range is given, but the cable has no {range_of}"):
        Simulate(cable=tmp_path / "cable.toml", **{f"{range_of}_range": (0.5, 2.0)}).dataset_config()


def test_what_is_named_beside_an_unknown_cause_is_added_with_a_warning(tmp_path, capsys):
    named = {"name": "bending_stiffness", "parameters": {"ratio": {"value": 1.5, "ci90": None, "unit": ""}}}
    verdict = {"schema": "cablejax-verdict/1", "verdict": "named+unknown", "effects": [named]}
    path = tmp_path / "verdict.json"
    path.write_text(json.dumps(verdict))
    assert list(map(str, Simulate(with_=(path,)).dataset_config().effects)) == ["bending_stiffness:ratio=1.5"]
    assert "together with an unknown cause; about 27 % of such effects are causes" in capsys.readouterr().err
    path.write_text(json.dumps({**verdict, "verdict": "maybe"}))
    with pytest.raises(ValueError, match=r"verdict is 'maybe', expected none, named, ambiguous"):
        Simulate(with_=(path,)).dataset_config()


def test_a_verdicts_draws_are_dealt_out_to_the_trajectories(tmp_path):
    def drawn(name, **values):
        return [{"name": name, "parameters": values}]

    fields = {"effects": [{"name": "linear_density", "parameters": {"ratio": {"value": 1.5}}}]}
    draws = [drawn("linear_density", ratio=1.4), drawn("table_friction", coefficient=0.3)]
    for name, posterior in (("one", draws), ("old", None), ("damaged", [[{"name": "linear_density"}]])):
        verdict = {"schema": "cablejax-verdict/1", "verdict": "ambiguous", **fields, "posterior": posterior}
        (tmp_path / f"{name}.json").write_text(json.dumps(verdict))
    config = Simulate(with_=(tmp_path / "one.json", tmp_path / "old.json")).dataset_config()
    assert config.effects == ()
    assert [list(map(str, config.effects_of(i))) for i in range(3)] == [
        ["linear_density:ratio=1.4", "linear_density:ratio=1.5"],
        ["table_friction:coefficient=0.3", "linear_density:ratio=1.5"],
        ["linear_density:ratio=1.4", "linear_density:ratio=1.5"],
    ]
    assert simulate_command(config, "name.zarr").startswith("# name.zarr: ")
    with pytest.raises(ValueError, match=r"damaged\.json: posterior is not of the verdict's format"):
        Simulate(with_=(tmp_path / "damaged.json",)).dataset_config()


def test_a_data_set_beyond_the_options_says_so():
    config = DatasetConfig(interval=2.0)
    assert simulate_command(config, "name.zarr").startswith("# name.zarr: ")


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("steps", [1, 2, 3, 7, 1000])
def test_a_training_has_as_many_steps_as_asked_for(preset, steps):
    store = types.SimpleNamespace(config=DatasetConfig())
    config = Train(preset=preset, steps=steps)._config(store, flips=True)  # pyright: ignore[reportArgumentType]
    assert config.total_steps == steps and all(phase.steps > 0 for phase in config.phases)


def test_only_what_was_changed_is_said_and_no_local_folder():
    folders = tuple(pathlib.Path("/home/somebody") / name for name in ("a.zarr", "b.zarr"))
    train = Train(data=folders, out=pathlib.Path("/tmp/mine"), held_out=0.1, json=True, device="cpu")
    assert command_line(train, "train") == "cablejax train --data a.zarr b.zarr --out mine --held-out 0.1"
    assert command_line(dataclasses.replace(Train(), latent=5), "train") == "cablejax train --latent 5"
    from_mine = dataclasses.replace(Train(), start_from="/home/somebody/train")
    assert command_line(from_mine, "train") == "cablejax train --start-from train"
