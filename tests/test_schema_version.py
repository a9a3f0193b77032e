"""Versions of file formats: files that earlier versions wrote are read, and those of later ones refused with advice."""

import dataclasses
import json
import pathlib
import zipfile

import numpy as np
import pytest

from cablejax.cable import Cable
from cablejax.cable_file import cable_text, read_cable
from cablejax.commands.resuming import unfinished
from cablejax.dataset.drawing import draw
from cablejax.dataset.opening import open_or_create, open_store
from cablejax.dynamics.run_folder import claim_folder
from cablejax.dynamics.weights import cable_of_weights, load_weights
from cablejax.effects.verdicts import effects_of_verdict, posterior_of_verdict
from cablejax.gaplog import read_gap_log, write_gap_log
from cablejax.text_file import version_of

# What was written by the last commit before schema 2 of the data sets.
OLD = pathlib.Path(__file__).parent / "old_files"


@pytest.fixture
def old_store(tmp_path):
    with zipfile.ZipFile(OLD / "dataset-1.zip") as archive:
        archive.extractall(tmp_path / "data")
    return tmp_path / "data"


def test_a_data_set_of_version_1_is_read(old_store):
    store = open_store(old_store)
    config, rows = store.config, range(2)
    assert (config.discretisation.n_links, config.cable, config.n_steps, config.seed) == (5, Cable(), 4, 3)
    assert store.info().complete
    block = store.read(rows)
    assert block.keypoints.shape == (2, 5, 13, 2) and np.isfinite(block.keypoints).all()
    for row in rows:  # the configuration means what it did
        np.testing.assert_array_equal(draw(config, row).gripper_twist, block.gripper_twist[row])
    with pytest.raises(ValueError, match="effects is 'absent' in the store"):
        open_or_create(old_store, config)  # unfinished work is finished by the version that began it


def test_weights_of_before_are_read():
    config, _, _ = load_weights(OLD / "weights-1.safetensors")
    assert (config.latent, config.message_passing) == (8, 1)
    assert cable_of_weights(OLD / "weights-1.safetensors") == Cable()


def test_a_log_of_before_is_read():
    log = read_gap_log(OLD / "gap-log-1.npz")
    assert log.keypoints.shape[2:] == (13, 2) and log.episode_length.tolist() == [log.time.shape[1]]


def test_a_cable_file_and_a_training_without_version_are_of_version_1(tmp_path):
    text = cable_text(Cable())
    (tmp_path / "cable.toml").write_text("".join(line for line in text.splitlines(True) if "schema" not in line))
    assert read_cable(tmp_path / "cable.toml") == Cable() and "cablejax-cable/1" in text
    run = {"config": {"seed": 0}, "data": "a"}
    (tmp_path / "run.json").write_text(json.dumps(run))
    claim_folder(tmp_path, run, overwrite=False)


@pytest.mark.parametrize("file", ["data set", "weights", "log", "verdict", "cable", "training", "parts"])
def test_a_newer_version_is_refused(file, tmp_path, old_store):
    def store():
        meta = json.loads((old_store / "zarr.json").read_text())
        meta["attributes"]["schema"] = "cablejax-dataset/3"
        (old_store / "zarr.json").write_text(json.dumps(meta))
        open_store(old_store)

    def weights():
        content = (OLD / "weights-1.safetensors").read_bytes()
        (tmp_path / "x.safetensors").write_bytes(content.replace(b"cablejax-weights/1", b"cablejax-weights/7"))
        load_weights(tmp_path / "x.safetensors")

    def log():
        known = read_gap_log(OLD / "gap-log-1.npz")
        write_gap_log(
            tmp_path / "log.npz", dataclasses.replace(known, meta=known.meta | {"schema": "cablejax-gap-log/2"})
        )

    def verdict():
        (tmp_path / "verdict.json").write_text(json.dumps({"schema": "cablejax-verdict/2", "effects": []}))
        effects_of_verdict(tmp_path / "verdict.json")

    def cable():
        (tmp_path / "cable.toml").write_text(cable_text(Cable()).replace("cablejax-cable/1", "cablejax-cable/2"))
        read_cable(tmp_path / "cable.toml")

    def training():
        run = {"config": {}, "data": "a"}
        (tmp_path / "run.json").write_text(json.dumps({"schema": "cablejax-training/2", **run}))
        claim_folder(tmp_path, run, overwrite=True)

    def parts():
        (tmp_path / "parts").mkdir()
        (tmp_path / "parts" / "settings.json").write_text(json.dumps({"schema": "cablejax-parts/2"}))
        with unfinished(tmp_path, {}, overwrite=True):
            pass

    read = {
        "data set": store,
        "weights": weights,
        "log": log,
        "verdict": verdict,
        "cable": cable,
        "training": training,
        "parts": parts,
    }[file]
    with pytest.raises(ValueError, match=r"has schema 'cablejax-.*expected 'cablejax-.*newer version of cablejax.*pip"):
        read()


@pytest.mark.parametrize(
    "schema", [None, 3, "", "toy", "toy/", "toy/0", "toy/-1", "toy/1.5", "toy/٣", "other/1", "toy/1/2"]
)
def test_what_is_no_version_is_another_kind_of_file(schema):
    with pytest.raises(ValueError, match=r"^x\.json has schema .*, expected 'toy/3': is it another kind of file"):
        version_of(schema, "toy/3", "x.json")


def test_versions_up_to_the_known_one_are_returned():
    assert [version_of(f"toy/{number}", "toy/3", "x") for number in (1, 2, 3)] == [1, 2, 3]


def test_places_of_a_verdict_are_about_where_its_grippers_were(tmp_path):
    """For motions about the origin; what is added to a simulation of the log itself stays where it is."""

    def read(place):
        parameters = {"x_m": {"value": 4.7}, "y_m": {"value": 0.2}, "radius_m": {"value": 0.03}}
        effects = [
            {"name": "obstacle", "parameters": parameters},
            {"name": "bending_stiffness", "parameters": {"ratio": {"value": 2.0}}},
        ]
        draw = [{"name": "obstacle", "parameters": {"x_m": 4.8, "y_m": 0.2, "radius_m": 0.03}}]
        verdict = {"schema": "cablejax-verdict/1", "effects": effects, "place_m": place, "posterior": [draw]}
        (tmp_path / "verdict.json").write_text(json.dumps(verdict))
        obstacle, stiffness = effects_of_verdict(tmp_path / "verdict.json")
        assert dict(obstacle.parameters)["x_m"] == 4.7 and dict(stiffness.parameters) == {"ratio": 2.0}
        ((drawn,),) = posterior_of_verdict(tmp_path / "verdict.json")
        return [dict(drawn.parameters)[name] for name in ("x_m", "y_m", "radius_m")]

    assert read([4.5, -0.1]) == pytest.approx([0.3, 0.3, 0.03])
    assert read([504.5, -2000.1])[:2] == pytest.approx([-499.7, 2000.3]), "far from the origin of its frame"
    assert read(None) == [4.8, 0.2, 0.03], "of an older version"
    with pytest.raises(ValueError, match=r"place_m is \[0.0\], expected x and y in metres"):
        read([0.0])


@pytest.mark.parametrize(("dimension", "what"), [(3, "a cable in space"), (None, "something other than a cable on")])
def test_a_verdict_on_something_else_is_refused(dimension, what, tmp_path):
    """Also where the parameters have the same names: the damping of a cable in space is one in time, too."""
    effect = {"name": "bending_damping", "parameters": {"time_s": {"value": 0.3, "unit": "s"}}}
    verdict = {"schema": "cablejax-verdict/1", "verdict": "named", "effects": [effect], "dimension": dimension}
    (tmp_path / "verdict.json").write_text(json.dumps(verdict))
    for read in (effects_of_verdict, posterior_of_verdict):
        with pytest.raises(ValueError, match=f"is the verdict on {what}"):
            read(tmp_path / "verdict.json")


def test_a_verdict_in_other_units_is_refused(tmp_path):
    def read(unit):
        parameters = {"mass_kg": {"value": 20.0, "unit": unit}, "centre_m": {"value": 0.3, "unit": "m"}}
        verdict = {"schema": "cablejax-verdict/1", "effects": [{"name": "lumped_mass", "parameters": parameters}]}
        (tmp_path / "verdict.json").write_text(json.dumps(verdict))
        return effects_of_verdict(tmp_path / "verdict.json")

    with pytest.raises(ValueError, match="lumped_mass has mass_kg in 'g', expected 'kg'"):
        read("g")
    assert read("kg") == read(None)


@pytest.mark.parametrize(("index", "counts"), [([], "0 and 2"), ([3], "1 and 2"), ([3, 4, 5], "2 and 3")])
def test_a_verdict_whose_pieces_do_not_fit_together_is_refused(index, counts, tmp_path):
    """Of empty lists no effect was left, without a word."""

    def read(index, offset):
        parameters = {"index": {"value": index}, "offset_m": {"value": offset, "unit": "m"}}
        verdict = {"schema": "cablejax-verdict/1", "effects": [{"name": "keypoint_bias", "parameters": parameters}]}
        (tmp_path / "verdict.json").write_text(json.dumps(verdict))
        return effects_of_verdict(tmp_path / "verdict.json")

    with pytest.raises(ValueError, match=f"'keypoint_bias' has lists of {counts} values, expected lists of one length"):
        read(index, [0.01, 0.02])
    with pytest.raises(ValueError, match="has lists of 0 values"):
        read([], [])
    assert len(read([3, 4], [0.01, 0.02])) == 2
