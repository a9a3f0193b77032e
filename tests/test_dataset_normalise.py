"""Streamed statistics equal those of all samples at once."""

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cablejax.dataset.normalise import Moments, Statistics, statistics
from cablejax.dataset.schema import Block, DatasetConfig
from cablejax.dataset.store import open_or_create
from cablejax.simulate import CableConfig


@settings(deadline=None, derandomize=True)
@given(
    samples=arrays(np.float64, st.tuples(st.integers(2, 30), st.just(3)), elements=st.floats(-1e3, 1e3)),
    cut=st.integers(1, 29),
)
def test_merged_moments_are_those_of_the_whole(samples, cut):
    cut = min(cut, len(samples) - 1)
    merged = Moments.of(samples[:cut]).merge(Moments.of(samples[cut:]))
    assert merged.count == len(samples)
    np.testing.assert_allclose(merged.mean, samples.mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(merged.std, samples.std(axis=0), atol=1e-6)
    assert merged.rms == pytest.approx(np.sqrt(np.mean(samples**2)), abs=1e-6)


@pytest.fixture
def store(tmp_path):
    config = DatasetConfig(n_trajectories=7, n_steps=4, shard_size=3, cable=CableConfig(n_links=5, n_keypoints=4))
    store = open_or_create(tmp_path / "data", config)
    rng = np.random.default_rng(0)
    for shard in range(config.n_shards):
        size = len(config.shard_rows(shard))
        content = {n: rng.normal(2.0, 3.0, (size, *s)).astype(d) for n, (s, d) in config.array_shapes().items()}
        store.write_shard(shard, Block(**content))
    return store


def test_statistics_over_shards_and_rows(store):
    rows = [0, 2, 3, 6]
    found, block = statistics(store, rows), store.read(rows)
    displacement = np.diff(block.keypoints.astype(np.float64), axis=1)
    expected = {
        "displacement": displacement,
        "acceleration": np.diff(displacement, axis=1),
        "neighbour": np.diff(block.keypoints.astype(np.float64), axis=2),
        "twist": block.gripper_twist.astype(np.float64),
    }
    for name, samples in expected.items():
        flat, moments = samples.reshape(-1, samples.shape[-1]), getattr(found, name)
        assert moments.count == len(flat)
        np.testing.assert_allclose(moments.mean, flat.mean(axis=0), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(moments.std, flat.std(axis=0), rtol=1e-5)


def test_statistics_survive_json(store):
    found = statistics(store.path)
    again = Statistics.from_json(json.loads(json.dumps(found.to_json())))
    for field in dataclasses.fields(Statistics):
        np.testing.assert_array_equal(getattr(again, field.name).std, getattr(found, field.name).std)
    with pytest.raises(ValueError, match="lack displacement"):
        Statistics.from_json({name: value for name, value in found.to_json().items() if name != "displacement"})


def test_statistics_need_rows_and_two_steps(store, tmp_path):
    with pytest.raises(ValueError, match="at least one trajectory"):
        statistics(store, [])
    with pytest.raises(ValueError, match=r"0\.\.6"):
        statistics(store, [9])
    short = open_or_create(tmp_path / "short", dataclasses.replace(store.config, n_steps=1))
    with pytest.raises(ValueError, match="1 step per trajectory"):
        statistics(short)
