"""The README's way from a cable of one's own to a diagnosis, at a small size."""

import dataclasses
import html
import json

import numpy as np
import pytest

from cablejax.cable import Cable, Discretisation
from cablejax.cable_file import write_cable
from cablejax.cli import main
from cablejax.commands.cable import find_cable
from cablejax.commands.runs import plant_of
from cablejax.diagnose.safe_motions import safe_motions
from cablejax.dynamics.weights import load_info
from cablejax.effects.given import GivenEffect, parse_effect
from cablejax.gaplog import Episode, gap_log_from_episodes, read_gap_log, write_gap_log
from cablejax.simulate.plant import Plant, PlantConfig
from cablejax.types import GapLog

REST = 15
"""Samples at rest before each recorded motion."""

SMALL = ["--preset", "smoke", "--steps", "4", "--batch", "2", "--latent", "8", "--message-passing", "1"]
CABLE = Cable(length=1.5, linear_density=0.05, bending_stiffness=0.05, n_keypoints=17)


def result_of(arguments: list[str], capsys) -> dict:
    code = main([*arguments, "--json"])
    said = capsys.readouterr()
    assert code == 0, said.err
    return json.loads(said.out)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A cable file, a data set and a barely trained model of that cable."""
    folder = tmp_path_factory.mktemp("own")
    assert main(["cable", "--out", str(folder / "cable.toml")]) == 0
    assert find_cable(folder / "cable.toml") == Cable()
    write_cable(folder / "cable.toml", CABLE)
    data, model = str(folder / "data.zarr"), str(folder / "model")
    few = ["--trajectories", "3", "--steps", "21", "--links", "13"]
    assert main(["simulate", "--cable", str(folder / "cable.toml"), "--out", data, *few]) == 0
    assert main(["train", "--data", data, "--out", model, "--held-out", "0.3", *SMALL]) == 0
    return folder


def shaping(folder, name: str, *options: str) -> list[str]:
    fast = ["--method", "residual", "--solver", "projected-gradient", "--links", "16"]
    return ["shape", "--weights", str(folder / "model"), "--out", str(folder / name), *fast, *options]


def test_data_and_weights_hold_the_cable_and_the_card_says_how_to_make_them_again(folder):
    for source in ("data.zarr", "model"):
        assert find_cable(folder / source) == CABLE, source
    card = (folder / "model" / "card.md").read_text()
    assert "cablejax cable --from model --out cable.toml\ncablejax simulate --out data.zarr" in card
    assert "--cable cable.toml" in card


def test_data_whose_name_is_no_utf_8_are_trained_on(folder, capsys):
    data, out = folder / "caf\udce9.zarr", folder / "latin1"
    data.symlink_to("data.zarr")
    result_of(["train", "--data", str(data), "--out", str(out), "--held-out", "0.3", *SMALL], capsys)
    assert load_info(out)["data"][0]["name"] == "caf?"
    assert "caf?.zarr" in (out / "card.md").read_text()


def test_another_training_in_its_folder_is_told_apart_in_words(folder, capsys):
    train = ["train", "--data", str(folder / "data.zarr"), "--out", str(folder / "model"), "--held-out", "0.7", *SMALL]
    assert main(train) == 2
    assert (
        "differs in its data, what is held out of them, or the weights to start from (--data, --held-out"
        in capsys.readouterr().err
    )
    assert main([*train, "--conditioned"]) == 2
    said = capsys.readouterr().err
    assert "All cables of the data are equally stiff and rough" in said
    assert "differs in config.model.conditioned (False, now True), its data" in said


def test_the_page_says_what_the_plant_has_and_the_log_what_the_model_believes(folder, capsys):
    options = ["--target", "U", "--steps", "2", "--plant-effect", "bending_stiffness:ratio=0.8"]
    shaped = result_of(shaping(folder, "run", *options), capsys)["shapes"]["U"]
    assert shaped["terminal_error_cm"] < 0.9 * shaped["initial_error_cm"]

    page = html.unescape((folder / "run" / "report.html").read_text())
    assert "trained on a cable of 1.5 m with 17 keypoints, 0.05 kg/m and a bending stiffness of 0.05 N m^2" in page
    assert "The plant has bending stiffness 0.04 N m^2 (0.8 times the model's)." in page

    log = read_gap_log(folder / "run" / "log.npz")
    assert log.meta["motion"] == ["approach_u_residual"]
    assert find_cable(folder / "run" / "log.npz") == CABLE
    samples = log.episode_length[0]
    sizes = np.linalg.norm(log.gripper_command[0, :samples] * [1.0, 1.0, 0.15 * 1.5], axis=-1)
    assert 0.05 < sizes.max() <= 0.05 * 1.5 + 1e-6
    ends = log.keypoints[0, :samples, [0, -1]].swapaxes(0, 1)
    np.testing.assert_allclose(ends, log.gripper_pose[0, :samples, :, :2], atol=1e-3)
    steps = np.linalg.norm(np.diff(log.keypoints[0, 0], axis=0), axis=-1)
    assert log.keypoints.shape[2] == 17 and steps.sum() == pytest.approx(1.5, abs=0.01)


def test_a_plant_of_another_cable_is_compared_with_the_model_or_refused(folder, capsys):
    write_cable(folder / "heavy.toml", dataclasses.replace(CABLE, linear_density=0.15, diameter=0.02))
    options = ["--target", "U", "--steps", "1", "--plant-effect", "none", "--cable", str(folder / "heavy.toml")]
    result_of(shaping(folder, "heavy", *options), capsys)
    page = html.unescape((folder / "heavy" / "report.html").read_text())
    assert "mass per length 0.15 kg/m (3 times the model's) and diameter 0.02 m (2 times the model's)" in page
    assert find_cable(folder / "heavy" / "log.npz") == CABLE

    for name, other in (("short", Cable(n_keypoints=17)), ("few", Cable(length=1.5))):
        write_cable(folder / f"{name}.toml", other)
        assert main(shaping(folder, name, "--target", "U", "--cable", str(folder / f"{name}.toml"))) == 2
        said = capsys.readouterr().err
        assert f"17 keypoints on 1.5 m of cable, but the plant has {other.n_keypoints} on {other.length}" in said
        assert not (folder / name).exists()


def test_data_sets_of_different_cables_are_not_mixed(folder, capsys):
    write_cable(folder / "stiff.toml", dataclasses.replace(CABLE, bending_stiffness=0.1))
    few = ["--trajectories", "1", "--steps", "21", "--links", "13"]
    assert main(["simulate", "--cable", str(folder / "stiff.toml"), "--out", str(folder / "stiff.zarr"), *few]) == 0
    stores = [str(folder / "data.zarr"), str(folder / "stiff.zarr")]
    assert main(["train", "--data", *stores, "--out", str(folder / "mixed"), "--preset", "smoke"]) == 2
    assert "different cables: bending_stiffness_n_m2 is 0.1 and 0.05" in capsys.readouterr().err
    assert main(["train", "--data", stores[0], stores[0], "--out", str(folder / "mixed"), "--preset", "smoke"]) == 2
    assert "data.zarr twice: its trajectories would count twice" in capsys.readouterr().err


def test_an_effect_without_all_of_its_parameters_is_refused(folder, capsys):
    assert main(shaping(folder, "lag", "--plant-effect", "friction_patch:x_m=0")) == 2
    assert "friction_patch lacks y_m" in capsys.readouterr().err and not (folder / "lag").exists()


def recorded(effects: tuple[GivenEffect, ...], samples: int = 200) -> GapLog:
    """The plant of `shape` with that cable and these effects, moved through motions that tell causes apart.

    A controller with a barely trained network is too slow, and its few commands excite too little, for a diagnosis. The
    plant has as many links as by default: with 24, its own discretisation moves the keypoints by half a millimetre.
    """
    config = plant_of(CABLE, effects, links=PlantConfig().discretisation.n_links, seed=3, keypoint_noise=5e-4)
    first = np.array([[-0.6, 0.0, 0.4], [0.6, 0.0, -0.3]])
    episodes = []
    for name, pose in safe_motions(Discretisation(CABLE), first, samples).items():
        plant = Plant(config)
        seen = [plant.reset(pose[0])]
        twists = np.concatenate([np.zeros((REST, 2, 3)), np.diff(pose, axis=0) / 0.1])
        for twist in twists:
            seen += plant.record(twist, 0.1, samples=1)
        episodes.append(
            Episode(
                motion=name,
                time=np.array([one.time for one in seen]) - seen[0].time,
                keypoints=np.stack([one.keypoints for one in seen]),
                gripper_pose=np.stack([one.gripper_pose for one in seen]),
                gripper_command=np.concatenate([twists, np.zeros((1, 2, 3))]),
                hold=np.arange(len(seen)) <= REST,
            )
        )
    return gap_log_from_episodes(episodes, CABLE, source="the contact plant")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "verdict"), [(None, "none"), ("stiffness_profile:centre_m=0.5,width_m=0.4,ratio=0.3", "named")]
)
def test_the_diagnosis_judges_by_that_cable(effect, verdict, tmp_path, capsys):
    effects = () if effect is None else (parse_effect(effect),)
    write_gap_log(tmp_path / "log.npz", recorded(effects))
    found = result_of(["diagnose", str(tmp_path / "log.npz"), "--out", str(tmp_path / "report")], capsys)
    assert found["verdict"] == verdict, found
    assert [named["name"] for named in found["effects"]] == [one.name for one in effects]
    for one in effects:
        parameters = found["effects"][0]["parameters"]
        assert parameters["centre_m"]["value"] == pytest.approx(dict(one.parameters)["centre_m"], abs=0.1)
