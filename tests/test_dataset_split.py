"""Data sets are split, and those larger than memory stream through a buffer, always in the same order."""

import dataclasses
import itertools
from typing import Any

import jax
import numpy as np
import pytest

from cablejax.cable import Cable, Discretisation
from cablejax.control.cable_inputs import inputs_of_data, inputs_of_weights
from cablejax.dataset.opening import open_or_create
from cablejax.dataset.schema import Block, DatasetConfig, config_to_json
from cablejax.dataset.split import known_motions, read_split, split
from cablejax.dataset.streaming import StreamedData, blocks_of
from cablejax.dataset.windows import concatenate, read_trajectories
from cablejax.effects.given import parse_effect


@pytest.mark.parametrize(("count", "held_out"), [(2, 0.05), (2, 0.99), (20, 0.05), (1000, 0.05), (7, 0.5)])
def test_split_is_a_partition_with_both_parts(count, held_out):
    train, rest = split(count, held_out)
    np.testing.assert_array_equal(np.concatenate([train, rest]), np.arange(count))
    assert len(train) >= 1 and len(rest) >= 1
    assert len(rest) <= max(1, held_out * count) and len(rest) > held_out * count - 1


def test_split_of_the_released_models_data():
    assert [len(split(count)[1]) for count in (896, 704, 320)] == [44, 35, 16]


def test_split_refuses_what_it_cannot_do():
    with pytest.raises(ValueError, match="held_out is 1"):
        split(10, 1.0)
    with pytest.raises(ValueError, match="1 trajectories"):
        split(1)


def filled(path, config: DatasetConfig, shards: int | None = None):
    """A store whose first shards hold random numbers."""
    store, rng = open_or_create(path, config), np.random.default_rng(config.seed)
    for shard in range(config.n_shards if shards is None else shards):
        size = len(config.shard_rows(shard))
        content = {n: rng.standard_normal((size, *s)).astype(d) for n, (s, d) in config.array_shapes().items()}
        content["parameters"] = np.abs(content["parameters"])
        store.write_shard(shard, Block(**content))
    return store


CONFIG = DatasetConfig(
    n_trajectories=4, n_steps=2, shard_size=2, discretisation=Discretisation(Cable(n_keypoints=4), n_links=5)
)
ARRAYS = CONFIG.array_shapes()


def test_several_stores_are_split_each_and_trained_on_one_after_the_other(tmp_path):
    stores = [filled(tmp_path / str(k), dataclasses.replace(CONFIG, seed=k)) for k in range(2)]
    training, held_out = read_split([tmp_path / "0", stores[1]], 0.3)
    expected = concatenate([read_trajectories(store, range(3)) for store in stores])
    jax.tree.map(np.testing.assert_array_equal, training, expected)
    assert len(held_out) == 2
    for part, store in zip(held_out, stores, strict=True):
        jax.tree.map(np.testing.assert_array_equal, part, read_trajectories(store, [3]))


def test_what_is_held_out_of_one_store_is_not_trained_on_in_another(tmp_path):
    content = {n: np.random.default_rng(3).uniform(1, 2, (8, *s)).astype(d) for n, (s, d) in ARRAYS.items()}

    def of(name: str, count: int):
        store = open_or_create(tmp_path / name, dataclasses.replace(CONFIG, n_trajectories=count))
        for shard in range(count // 2):
            rows = slice(2 * shard, 2 * shard + 2)
            store.write_shard(shard, Block(**{n: a[rows] for n, a in content.items()}))
        return store

    few, many = of("few", 4), of("many", 8)
    with pytest.raises(
        ValueError, match=r"1 of the 1 trajectories held out of .*few are training trajectories of .*many"
    ):
        read_split([few, many], 0.3)
    read_split([few, few], 0.3)  # twice the weight, and the same are held out


def test_what_is_held_out_but_moves_like_what_is_trained_on_is_said(tmp_path):
    softer = dataclasses.replace(CONFIG, n_trajectories=8, effects=(parse_effect("bending_stiffness:ratio=0.5"),))
    few, many = open_or_create(tmp_path / "few", CONFIG), open_or_create(tmp_path / "many", softer)
    (said,) = known_motions([few, many], [1, 2])
    assert said.startswith(
        f"1 of the 1 trajectories held out of {few.path} have motions that are trained on in {many.path}"
    )
    assert known_motions([few, open_or_create(tmp_path / "b", dataclasses.replace(softer, seed=5))], [1, 2]) == []
    # those of the model to start from
    before = {"name": "free", "config": config_to_json(softer), "held_out": 2}
    unknown: list[Any] = [{**before, "config": {"schema": "of a version that nobody knows"}}, {}, "free", None]
    (said,) = known_motions([few], [1], [before, *unknown])
    assert "trained on in free, of the model to start from" in said
    assert known_motions([few], [1], [{**before, "held_out": 5}]) == []


def test_a_conditioned_model_to_start_from_may_still_believe_the_cables_that_it_knows(tmp_path):
    store = filled(tmp_path / "a", CONFIG)
    own = inputs_of_data([store], 0.3)
    more = own.also_of("gns-conditioned")
    known = np.array(inputs_of_weights("gns-conditioned", CONFIG.cable).limits)
    assert more.mean == own.mean == own.also_of("gns-reference").mean
    low, high = np.array(own.limits).T
    np.testing.assert_array_equal(
        more.limits, np.stack([np.minimum(low, known[:, 0]), np.maximum(high, known[:, 1])], 1)
    )
    assert own.also_of("gns-reference").limits == own.limits
    # of its own cables, whatever these are
    stiffer = dataclasses.replace(CONFIG.cable, bending_stiffness=20 * CONFIG.cable.bending_stiffness)
    other = filled(
        tmp_path / "b", dataclasses.replace(CONFIG, discretisation=Discretisation(stiffer, n_links=5, timestep=1e-3))
    )
    (softest, _), _ = inputs_of_data([other], 0.3).also_of("gns-conditioned").limits
    assert softest == known[0, 0]


def test_stores_that_do_not_belong_together_are_refused(tmp_path):
    filled(tmp_path / "a", CONFIG)
    filled(tmp_path / "short", dataclasses.replace(CONFIG, n_steps=3))
    filled(tmp_path / "half", CONFIG, shards=1)
    with pytest.raises(ValueError, match="same cable and protocol"):
        read_split([tmp_path / "a", tmp_path / "short"])
    with pytest.raises(ValueError, match="holds 2 of 4 trajectories"):
        read_split([tmp_path / "half"])
    with pytest.raises(ValueError, match="No data set given"):
        read_split([])


@pytest.fixture(scope="module")
def streamed(tmp_path_factory) -> StreamedData:
    """Two stores of 4 and 7 trajectories, of which 3 and 5 are trained on: three of them in two blocks."""
    folder = tmp_path_factory.mktemp("streamed")
    configs = [CONFIG, dataclasses.replace(CONFIG, n_trajectories=7, shard_size=3, seed=1)]
    stores = [filled(folder / str(k), config) for k, config in enumerate(configs)]
    training, held_out = read_split(stores, 0.3, buffer=5)
    assert [len(part.gripper_twist) for part in held_out] == [1, 2]
    assert isinstance(training, StreamedData)
    return training


def test_blocks_hold_every_trajectory_and_are_of_one_size(streamed):
    assert streamed.buffer == 2
    assert streamed.blocks == ((0, range(2)), (0, range(1, 3)), (1, range(2)), (1, range(2, 4)), (1, range(3, 5)))
    assert blocks_of([np.arange(4, 8)], 4) == ((0, range(4, 8)),)


def test_each_pass_brings_every_block_in_an_order_of_its_own(streamed):
    whole = concatenate([read_trajectories(streamed.stores[k], np.asarray(rows)) for k, rows in streamed.blocks])
    count, orders = len(streamed.blocks), set()
    for first in (0, count, 2 * count):
        blocks = [streamed.block(number) for number in range(first, first + count)]
        kinds = [next(i for i in range(count) if (whole.keypoints[2 * i] == b.keypoints[0]).all()) for b in blocks]
        assert sorted(kinds) == [*range(count)]
        orders.add(tuple(kinds))
    assert len(orders) == 3


@pytest.mark.parametrize("first", [0, 3, 8])
def test_the_buffer_at_a_turn_does_not_depend_on_where_one_began(streamed, first):
    turns = streamed.turns(first, lambda part: jax.tree.map(jax.numpy.asarray, part))
    for turn, buffer in enumerate(itertools.islice(turns, 6), start=first):
        jax.tree.map(np.testing.assert_array_equal, buffer, streamed.at(turn))
    before, after = streamed.at(first), streamed.at(first + 1)
    changed = (before.keypoints != after.keypoints).any(axis=(1, 2, 3))
    assert changed.sum() <= 2, "one block gives way"


def test_a_buffer_with_room_for_all_reads_all_and_too_small_a_one_is_refused(streamed):
    whole, _ = read_split(streamed.stores, 0.3)
    roomy, _ = read_split(streamed.stores, 0.3, buffer=8)
    jax.tree.map(np.testing.assert_array_equal, roomy, whole)
    with pytest.raises(ValueError, match=r"buffer of 3 trajectories is too small: .*blocks of 2.*Give at least 4"):
        read_split(streamed.stores, 0.3, buffer=3)


def test_what_decides_the_buffer_is_its_identity(streamed):
    def differs(other: StreamedData) -> bool:
        return any(
            (a.shape != b.shape) or (a != b).any() for a, b in zip(streamed.identity, other.identity, strict=True)
        )

    assert not differs(dataclasses.replace(streamed))
    assert differs(dataclasses.replace(streamed, seed=1)) and differs(dataclasses.replace(streamed, buffer=3))


def test_a_damaged_shard_ends_the_stream_with_its_name(tmp_path):
    store = filled(tmp_path / "data", dataclasses.replace(CONFIG, n_trajectories=8))
    training, _ = read_split([store], 0.3, buffer=4)
    assert isinstance(training, StreamedData)
    for file in (tmp_path / "data" / "keypoints" / "c").rglob("*"):
        if file.is_file():
            file.write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"Shard \d of .*data .*cannot be decoded"):
        next(training.turns(0, lambda part: part))
