"""A cable as a file: read back as written, refused with a reason, found in what it was made for, and said correctly."""

import dataclasses
import json
import pathlib

import numpy as np
import pytest

from cablejax.cable import Cable
from cablejax.cable_file import (
    KEYS,
    NUMBERS,
    cable_from_fields,
    cable_of_log,
    cable_text,
    cable_to_fields,
    read_cable,
    write_cable,
)
from cablejax.cli import main
from cablejax.commands.cable import find_cable
from cablejax.dataset.opening import open_or_create
from cablejax.dataset.schema import DatasetConfig
from cablejax.dynamics.weights import WeightsError, cable_of_weights
from cablejax.gaplog import Episode, gap_log_from_episodes, write_gap_log
from cli_cases import small_model

OTHER = Cable(
    length=1.5, diameter=0.008, linear_density=0.05, bending_stiffness=0.05, damping_time=0.0, rest_curvature=-0.3,
    friction_coefficient=0.2, n_keypoints=17,
)  # fmt: skip
MARKED = dataclasses.replace(OTHER, n_keypoints=4, marks=(0.0, 0.1, 1.0 / 3.0, 1.5))


@pytest.mark.parametrize("cable", [Cable(), OTHER, MARKED], ids=["reference", "other", "marked"])
def test_a_cable_is_read_as_it_was_written(cable, tmp_path):
    write_cable(tmp_path / "cable.toml", cable)
    assert read_cable(tmp_path / "cable.toml") == cable
    assert cable_from_fields(json.loads(json.dumps(cable_to_fields(cable))), "weights") == cable


def test_the_file_has_every_field_of_a_cable():
    assert set(KEYS) == {field.name for field in dataclasses.fields(Cable)}
    numbers = {field.name for field in dataclasses.fields(Cable) if isinstance(field.default, float)}
    assert {name for name, _ in NUMBERS.values()} == numbers


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"length_m": None, "length": 1.5}, "length without its unit: write length_m, in m"),
        ({"density": 0.08}, "unknown key 'density'. Did you mean linear_density_kg_per_m"),
        ({"diameter_mm": 10}, "Did you mean diameter_m"),
        ({"keypoint": 13}, r"unknown key 'keypoint'\. Did you mean keypoint"),
        ({"keypoint_arclength": [0.0, 1.0]}, "keypoint_arclength without its unit: write keypoint_arclength_m, in m"),
        ({"colour": "red"}, "Expected length_m, diameter_m"),
        ({"bending_stiffness_n_m2": None}, "lacks bending_stiffness_n_m2, the EI"),
        ({"length_m": -1.0}, "length_m is -1.0, expected a number from 0.01 to 100 m"),
        ({"length_m": 1500}, "length_m is 1500, expected a number from 0.01 to 100 m"),
        ({"bending_stiffness_n_m2": 1e30}, "bending_stiffness_n_m2 is 1e\\+30, expected a number from 1e-09"),
        (
            {"linear_density_kg_per_m": 80.0},
            r"is 80 kg/m at a diameter of 0.01 m.* 1.02e\+06 kg/m\^3, expected at most",
        ),
        ({"bending_stiffness_n_m2": 2e4}, r"is 20000 N m\^2 at a diameter of 0.01 m.* Pa, expected at most 1.5e\+12"),
        ({"friction_coefficient": 10**400}, "friction_coefficient is an integer of 1329 bits"),
        ({"diameter_m": "1 cm"}, "diameter_m is '1 cm'"),
        ({"bending_damping_s": True}, "bending_damping_s is True"),
        ({"linear_density_kg_per_m": float("nan")}, "linear_density_kg_per_m is nan"),
        ({"diameter_m": 0.9, "length_m": 0.5}, "longer than it is thick"),
        ({"keypoints": 1}, "keypoints is 1, expected a whole number from 2"),
        ({"keypoints": None}, "neither keypoints nor keypoint_arclength_m"),
        ({"keypoint_arclength_m": [0.0, 1.0]}, "has both"),
        ({"keypoints": None, "keypoint_arclength_m": [0.0, 0.5]}, "keypoint_arclength_m goes from 0 to 0.5 m"),
        ({"keypoints": None, "keypoint_arclength_m": 0.1}, "keypoint_arclength_m is 0.1, expected a list"),
        ({"grasp": ["pinned", "clamped"]}, "the only grasp simulated"),
        ({"grasp": "clamped"}, "grasp is 'clamped'"),
    ],
)
def test_what_is_no_cable_is_refused_by_the_name_of_its_key(changes, message):
    fields = {key: value for key, value in {**cable_to_fields(Cable()), **changes}.items() if value is not None}
    with pytest.raises(ValueError, match=message) as raised:
        cable_from_fields(fields, "cable.toml")
    assert str(raised.value).startswith("cable.toml") and len(str(raised.value)) < 400


@pytest.mark.parametrize(
    "content", [b"length_m = ", b"\xff\xfe", b"a=" + b"[" * 100_000], ids=["half", "bytes", "deep"]
)
def test_a_file_that_is_no_toml_is_refused(content, tmp_path):
    (tmp_path / "cable.toml").write_bytes(content)
    with pytest.raises(ValueError, match=r"cable could not be read.*(no TOML|not text).*cablejax cable --out"):
        read_cable(tmp_path / "cable.toml")
    for missing in (tmp_path, tmp_path / "none.toml"):
        with pytest.raises(ValueError, match="The cable could not be read"):
            read_cable(missing)


def at_rest(cable: Cable) -> Episode:
    """A straight cable that nobody moves."""
    points = np.stack([cable.keypoint_arclength, np.zeros(cable.n_keypoints)], axis=1)
    pose = np.array([[0.0, 0.0, 0.0], [cable.length, 0.0, 0.0]])
    return Episode(
        motion="rest",
        time=np.arange(3.0),
        keypoints=np.repeat(points[None], 3, axis=0),
        gripper_pose=np.repeat(pose[None], 3, axis=0),
        gripper_command=np.zeros((3, 2, 3)),
        hold=np.ones(3, bool),
    )


@pytest.mark.parametrize("cable", [OTHER, MARKED], ids=["other", "marked"])
def test_the_cable_is_found_in_files_and_logs(cable, tmp_path):
    write_cable(tmp_path / "cable.toml", cable)
    write_gap_log(tmp_path / "log.npz", gap_log_from_episodes([at_rest(cable)], cable, source="test"))
    for name in ("cable.toml", "log.npz"):
        assert find_cable(tmp_path / name) == cable, name


def test_a_log_whose_cable_cannot_be_simulated_is_refused_by_name(tmp_path):
    log = gap_log_from_episodes([at_rest(OTHER)], OTHER, source="test")
    log = dataclasses.replace(log, meta={**log.meta, "grasp": ["pinned", "clamped"]})
    write_gap_log(tmp_path / "pinned.npz", log)
    with pytest.raises(ValueError, match=r"pinned\.npz: .*grasp.*pinned"):
        find_cable(tmp_path / "pinned.npz")


def test_the_cable_of_an_old_verdict_is_that_of_its_log(tmp_path):
    """Verdicts did not state their cable before."""
    (tmp_path / "verdict.json").write_text('{"schema": "cablejax-verdict/1", "verdict": "none"}')
    write_gap_log(tmp_path / "log.npz", gap_log_from_episodes([at_rest(OTHER)], OTHER, source="test"))
    assert find_cable(tmp_path) == OTHER


def test_the_cable_is_found_in_stores_and_weights(tmp_path):
    chain = dataclasses.replace(DatasetConfig().discretisation, cable=OTHER)
    open_or_create(tmp_path / "data.zarr", DatasetConfig(n_trajectories=1, n_steps=1, discretisation=chain))
    model = small_model(tmp_path / "model", cable=OTHER)
    for source in (tmp_path / "data.zarr", model, model / "weights.safetensors"):
        assert find_cable(source) == OTHER, source


def test_released_weights_name_the_reference_cable():
    for name in ("gns-reference", "gns-conditioned", "gns-randomised", "gns-no-prior"):
        assert cable_of_weights(name) == Cable()


def test_weights_without_a_cable_say_so(tmp_path):
    from cablejax.dynamics.weights import FILE_NAME, load_weights, save_weights

    model = small_model(tmp_path / "model")
    config, _, weights = load_weights(model)
    for info in ({}, {"data": []}, {"data": [{"config": {"cable": 3}}]}):
        save_weights(model / FILE_NAME, config, weights, info)
        with pytest.raises(WeightsError, match="does not say which cable"):
            cable_of_weights(model)


def test_the_command_writes_the_reference_and_does_not_overwrite(tmp_path, capsys):
    out = tmp_path / "new" / "cable.toml"
    assert main(["cable", "--out", str(out)]) == 0
    assert out.read_text() == cable_text(Cable()) and "or keypoint_arclength_m = [0.0, ...] instead" in out.read_text()
    assert main(["cable", "--out", str(out)]) == 2
    assert "exists" in capsys.readouterr().err
    write_cable(out, OTHER)
    assert main(["cable", "--from", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == cable_to_fields(OTHER)
    assert main(["cable", "--from", "nothing"]) == 2
    assert "nothing" in capsys.readouterr().err
    assert pathlib.Path(out).read_text() == cable_text(OTHER)


def test_marks_of_a_log_that_nearly_reach_the_ends_are_those_of_the_ends():
    log = gap_log_from_episodes([at_rest(OTHER)], OTHER, source="test")
    marks = [round(float(s), 4) for s in log.meta["keypoint_arclength_m"]]
    log.meta["keypoint_arclength_m"] = [marks[0], *marks[1:-1], 0.9996 * OTHER.length]
    cable = cable_of_log(log)
    np.testing.assert_allclose(cable.keypoint_arclength, [*marks[:-1], OTHER.length])
