"""Weights on disk come back bit for bit, and what is not such a file is refused by name."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from flax import nnx
from safetensors import safe_open
from safetensors.numpy import save_file

from cablejax.dynamics import weights as files
from cablejax.dynamics.config import ModelConfig, Normalisation
from cablejax.dynamics.model import apply
from cablejax.dynamics.networks import GNS
from cablejax.dynamics.weights import (
    WeightsError,
    load_info,
    load_weights,
    released_names,
    save_weights,
)
from dynamics_cases import SMALL, arched_history, network

CONFIG = dataclasses.replace(SMALL, normalisation=Normalisation(residual=0.0123))
INFO = {"data": [{"name": "a", "digest": "00"}], "training": {"seed": 3}}


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / files.FILE_NAME
    save_weights(path, CONFIG, network(CONFIG)[1], INFO)
    return path


def altered(path, tensors=lambda t: t, content=lambda c: c):
    """The file with other tensors or another description."""
    with safe_open(path, framework="numpy") as file:
        described = json.loads(file.metadata()["cablejax"])
        found = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    save_file(tensors(found), path, metadata={"cablejax": json.dumps(content(described))})
    return path


def test_weights_survive_bit_for_bit(saved):
    graphdef, weights = network(CONFIG)
    for source in (saved, str(saved), saved.parent):
        config, found_def, found = load_weights(source)
        assert config == CONFIG and found_def == graphdef
        assert jax.tree.structure(found) == jax.tree.structure(weights)
        jax.tree.map(np.testing.assert_array_equal, found, weights)
    assert load_info(saved) == INFO
    history, twist = arched_history(CONFIG), np.full((2, 3), 0.01, np.float32)
    predict = jax.jit(lambda weights: apply((graphdef, weights), history, twist))
    np.testing.assert_array_equal(predict(found), predict(weights))
    assert [file.name for file in saved.parent.iterdir()] == [saved.name], "nothing half-written is left"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: {k: v for k, v in t.items() if k != "decoder.rest.0.bias"}, "decoder.rest.0.bias is missing"),
        (lambda t: t | {"spare": np.zeros(2, np.float32)}, "spare is unknown"),
        (lambda t: t | {"decoder.rest.0.bias": np.zeros(3, np.float32)}, r"float32\[3\], expected float32\[2\]"),
        (lambda t: t | {"decoder.rest.0.bias": np.zeros(2, np.float64)}, r"float64\[2\], expected float32\[2\]"),
        (lambda t: t | {"decoder.rest.0.bias": np.full(2, np.nan, np.float32)}, "NaN"),
    ],
    ids=["missing", "extra", "misshapen", "other dtype", "not finite"],
)
def test_tensors_that_do_not_fit_are_refused(saved, change, message):
    with pytest.raises(WeightsError, match=message):
        load_weights(altered(saved, tensors=change))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda c: c | {"schema": "cablejax-weights/2"},
            "schema 'cablejax-weights/2', expected 'cablejax-weights/1' or older",
        ),
        (lambda c: c | {"config": c["config"] | {"heads": 4}}, "does not know.*heads"),
        (lambda c: c | {"config": c["config"] | {"latent": 0}}, "impossible configuration.*latent is 0"),
        (lambda c: {"schema": c["schema"]}, "without its info"),
        (lambda c: [], "schema None"),
    ],
    ids=["schema", "unknown field", "impossible", "no config", "no object"],
)
def test_descriptions_that_do_not_fit_are_refused(saved, change, message):
    with pytest.raises(WeightsError, match=message):
        load_weights(altered(saved, content=change))


def test_a_flipped_bit_is_found_wherever_it_is(saved):
    whole, rng = saved.read_bytes(), np.random.default_rng(0)
    for place in rng.integers(8, len(whole), 40):
        broken = bytearray(whole)
        broken[place] ^= 1 << rng.integers(8)
        saved.write_bytes(broken)
        with pytest.raises(WeightsError, match=saved.name):
            load_weights(saved)
    saved.write_bytes(whole)
    scaled = altered(saved, tensors=lambda t: t | {"decoder.rest.0.bias": t["decoder.rest.0.bias"] + np.float32(0.1)})
    with pytest.raises(WeightsError, match=r"does not match its digest.*run the training's command again"):
        load_weights(scaled)
    # files of earlier versions have none
    load_weights(altered(saved, content=lambda c: {name: part for name, part in c.items() if name != "digest"}))


def test_a_file_that_is_something_else_is_refused(tmp_path, saved):
    (tmp_path / "text.safetensors").write_text("not tensors")
    (tmp_path / "cut.safetensors").write_bytes(saved.read_bytes()[:-100])
    save_file({"x": np.zeros(1)}, tmp_path / "foreign.safetensors")
    for name, message in (("text", "no safetensors file"), ("cut", "damaged"), ("foreign", "schema None")):
        with pytest.raises(WeightsError, match=message):
            load_weights(tmp_path / f"{name}.safetensors")
    with pytest.raises(WeightsError, match="There is no weights file"):
        load_weights(tmp_path / "absent.safetensors")
    (tmp_path / "run").mkdir()
    with pytest.raises(WeightsError, match="is its training complete"):
        load_weights(tmp_path / "run")


def test_a_file_that_is_too_large_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "w.safetensors"
    with path.open("wb") as file:
        file.truncate(2**32 + 1)  # takes no place on the disk
    for read in (load_weights, load_info):
        with pytest.raises(WeightsError, match=r"The size of .*w\.safetensors is 4294967297, expected .* bytes"):
            read(path)


def test_weights_of_another_network_are_not_saved(tmp_path):
    other = network(dataclasses.replace(CONFIG, latent=4))[1]
    with pytest.raises(WeightsError, match="expected float32"):
        save_weights(tmp_path / "x.safetensors", CONFIG, other, {})
    with pytest.raises(ValueError, match="JSON"):
        save_weights(tmp_path / "x.safetensors", CONFIG, network(CONFIG)[1], {"loss": float("nan")})
    assert list(tmp_path.iterdir()) == []


def test_released_models_are_found_by_name(saved, monkeypatch):
    monkeypatch.setattr(files.importlib.resources, "files", lambda package: saved.parent.parent)
    folder = saved.parent.parent / "weights"
    saved.parent.rename(folder)
    (folder / saved.name).rename(folder / "mine.safetensors")
    assert released_names() == ("mine",)
    assert load_weights("mine")[0] == CONFIG
    with pytest.raises(
        WeightsError, match=r"'other' here, and no model is released under that name \(released: mine\)"
    ):
        load_weights("other")


def test_whatever_this_package_releases_can_be_loaded():
    for name in released_names():
        config, graphdef, weights = load_weights(name)
        assert isinstance(config, ModelConfig)
        assert nnx.split(nnx.eval_shape(lambda config=config: GNS(config, nnx.Rngs(0))))[0] == graphdef
        assert {"data", "training", "versions", "machine"} <= load_info(name).keys()
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(weights))
