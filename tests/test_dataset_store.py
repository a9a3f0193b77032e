"""The store keeps what was written, whatever happens in between, and says so when it cannot."""

import dataclasses
import errno
import hashlib
import json
import os
import shutil
import tempfile
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cablejax.cable import Cable, Discretisation
from cablejax.dataset.opening import open_or_create, open_store
from cablejax.dataset.schema import Block, DatasetConfig, Randomisation, digest_of_config
from cablejax.dataset.store import Store
from cablejax.simulate.motions import MotionConfig
from file_cases import tree

SMALL = DatasetConfig(
    n_trajectories=7, n_steps=2, shard_size=3, discretisation=Discretisation(Cable(n_keypoints=4), n_links=5)
)


def block(config: DatasetConfig, shard: int) -> Block:
    """Content that depends on (seed, trajectory) only, like a simulation's."""
    arrays = {}
    for name, (shape, dtype) in config.array_shapes().items():
        rngs = [np.random.default_rng([config.seed, row, len(name)]) for row in config.shard_rows(shard)]
        arrays[name] = np.stack([100 * rng.random(shape) for rng in rngs]).astype(dtype)
    return Block(**arrays)


def complete(store: Store) -> list[int]:
    """What generation does: makes every shard that is not intact. Returns those it made."""
    made = [shard for shard in range(store.config.n_shards) if store.status(shard) != "complete"]
    for shard in made:
        store.write_shard(shard, block(store.config, shard))
    return made


def chunk_files(path: Path, config: DatasetConfig) -> list[Path]:
    """Files in the order in which they are written."""
    return [
        file
        for shard in range(config.n_shards)
        for name in (*config.array_shapes(), "digest")
        for file in [path / name / "c" / str(shard)]
        for file in ([file] if file.is_file() else sorted(file.rglob("*")))
        if file.is_file()
    ]


@settings(max_examples=25, deadline=None, derandomize=True)
@given(data=st.data())
def test_any_shard_size_count_and_kill_point_leave_the_same_content(data):
    config = dataclasses.replace(
        SMALL, n_trajectories=data.draw(st.integers(1, 9)), shard_size=data.draw(st.integers(1, 10))
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "data"
        store = open_or_create(path, config)
        complete(store)
        whole, files = tree(path), chunk_files(path, config)
        # Files appear whole and in order: a kill leaves the first ones, and perhaps the next under a passing name.
        written = data.draw(st.integers(0, len(files)), label="files written before the kill")
        for file in files[written:]:
            file.unlink()
        if written < len(files) and data.draw(st.booleans()):
            partial = files[written].with_suffix(".0123.partial")
            partial.write_bytes(whole[str(files[written].relative_to(path))][:5])
        # A power cut or a bad disk may also damage one file.
        if written and data.draw(st.booleans(), label="damaged"):
            victim = files[data.draw(st.integers(0, written - 1))]
            content = victim.read_bytes()
            at = data.draw(st.integers(0, len(content) - 1))
            victim.write_bytes(data.draw(st.sampled_from([content[:at], content[:at] + b"\xa5" + content[at + 1 :]])))

        resumed = open_or_create(path, config)
        complete(resumed)
        assert tree(path) == whole
        assert complete(resumed) == []
        info = open_store(path).info()
        assert info.complete and info.n_complete == config.n_trajectories
        # the content does not know how it was cut into shards
        one = dataclasses.replace(config, shard_size=config.n_trajectories)
        expected = block(one, 0)
        assert info.digest == hashlib.sha256(expected.digests().tobytes()).hexdigest()
        read = open_store(path).read()
        for field in dataclasses.fields(Block):
            np.testing.assert_array_equal(getattr(read, field.name), getattr(expected, field.name))


def test_rows_are_read_in_the_order_asked(tmp_path):
    store = open_or_create(tmp_path / "data", SMALL)
    complete(store)
    everything, rows = store.read(), np.array([6, 0, 4, 4])
    np.testing.assert_array_equal(store.read(rows).keypoints, everything.keypoints[rows])
    for wrong in ([7], [-1], []):
        with pytest.raises(ValueError, match=r"0\.\.6"):
            store.read(wrong)


def test_incomplete_store_tells_how_far_it_is(tmp_path):
    store = open_or_create(tmp_path / "data", SMALL)
    store.write_shard(1, block(SMALL, 1))
    info = store.info()
    assert (info.n_complete, info.complete, info.digest) == (3, False, None)
    assert [store.status(shard) for shard in range(3)] == ["missing", "complete", "missing"]
    with pytest.raises(ValueError, match=r"Shard 0 .*not been generated"):
        store.read()
    assert len(store.read([3, 5])) == 2


@pytest.mark.parametrize("name", ["keypoints", "parameters", "digest"])
def test_truncated_shard_is_refused_by_name_and_made_again(tmp_path, name):
    path = tmp_path / "data"
    store = open_or_create(path, SMALL)
    complete(store)
    whole = tree(path)
    victim = next(file for file in (path / name / "c" / "1").rglob("*") if file.is_file())
    victim.write_bytes(victim.read_bytes()[:-7])
    with pytest.raises(ValueError, match=r"Shard 1 .*trajectories 3\.\.5.*again"):
        open_store(path).read()
    assert complete(open_or_create(path, SMALL)) == [1]
    assert tree(path) == whole


def test_a_failed_write_leaves_no_shard_that_looks_whole(tmp_path):
    path = tmp_path / "data"
    store = open_or_create(path, SMALL)
    complete(store)
    # the last of the data arrays cannot be written: the digests, old or new, must not vouch for the shard
    shutil.rmtree(path / "attempts" / "c")
    (path / "attempts" / "c").write_text("in the way")
    with pytest.raises(OSError):
        store.write_shard(1, block(dataclasses.replace(SMALL, seed=9), 1))
    assert store.status(1) == "missing"
    (path / "attempts" / "c").unlink()
    assert complete(store) == [0, 1, 2]  # attempts of 0 and 2 were lost too
    assert store.info().complete


def test_a_store_that_is_removed_meanwhile_says_so(tmp_path):
    store = open_or_create(tmp_path / "data", SMALL)
    shutil.rmtree(tmp_path / "data")
    with pytest.raises(ValueError, match=r"data no longer has keypoints: was it removed\?"):
        store.write_shard(0, block(SMALL, 0))


def test_a_full_disk_is_told_with_the_store(tmp_path, monkeypatch):
    store = open_or_create(tmp_path / "data", SMALL)

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Store, "_array", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*data'"):
        store.write_shard(0, block(SMALL, 0))


def test_lost_data_file_is_noticed(tmp_path):
    # Zarr reads a missing chunk as zeros
    path = tmp_path / "data"
    store = open_or_create(path, SMALL)
    complete(store)
    shutil.rmtree(path / "gripper_twist" / "c" / "2")
    with pytest.raises(ValueError, match=r"Shard 2 .*checksums"):
        open_store(path).read()


def edit_json(file: Path, **changes) -> None:
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))


def edit_codec(file: Path, **changes) -> None:
    (codec,) = json.loads(file.read_text())["codecs"]
    edit_json(file, codecs=[{**codec, "configuration": {**codec["configuration"], **changes}}])


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: (path / "keypoints" / "zarr.json").unlink(),
        lambda path: (path / "digest" / "zarr.json").unlink(),
        lambda path: (path / "attempts" / "zarr.json").write_text("{"),
        lambda path: edit_json(path / "attempts" / "zarr.json", shape=[0]),
        lambda path: edit_json(path / "keypoints" / "zarr.json", data_type="float64"),
        lambda path: edit_codec(path / "keypoints" / "zarr.json", index_codecs=[]),
        lambda path: edit_codec(path / "keypoints" / "zarr.json", codecs=[]),
    ],
    ids=["no keypoints", "no digest", "cut", "shape", "type", "index codecs", "codecs"],
)
def test_a_damaged_description_is_refused_and_mended(tmp_path, damage):
    path = tmp_path / "data"
    complete(open_or_create(path, SMALL))
    digest = open_store(path).info().digest
    damage(path)
    with pytest.raises(ValueError, match=r"is damaged: .*Run the command that generated it again"):
        open_store(path)
    store = open_or_create(path, SMALL)
    assert [store.status(shard) for shard in range(3)] == ["complete"] * 3
    assert open_store(path).info().digest == digest and [file.name for file in tmp_path.iterdir()] == ["data"]


@pytest.mark.parametrize("attributes", [[], None, "x", 1])
def test_root_attributes_that_are_no_object_are_refused_and_left_alone(tmp_path, attributes):
    path = tmp_path / "data"
    complete(open_or_create(path, SMALL))
    edit_json(path / "zarr.json", attributes=attributes)
    before = tree(path)
    for opens in (open_store, lambda path: open_or_create(path, SMALL)):
        with pytest.raises(ValueError, match=r"data.*(damaged|no data set|attributes)"):
            opens(path)
    assert tree(path) == before


def test_another_configuration_is_refused_with_the_difference(tmp_path):
    path = tmp_path / "data"
    complete(open_or_create(path, SMALL))
    whole = tree(path)
    other = dataclasses.replace(SMALL, seed=1, discretisation=dataclasses.replace(SMALL.discretisation, n_links=6))
    with pytest.raises(
        ValueError, match=r"discretisation.n_links is 5 in the store and 6 here; seed is 0 in the store and 1"
    ):
        open_or_create(path, other)
    assert tree(path) == whole


def test_another_schema_version_is_refused(tmp_path):
    path = tmp_path / "data"
    open_or_create(path, SMALL)
    meta = json.loads((path / "zarr.json").read_text())
    for version, words in (
        (9, "or older: a newer version"),
        (1, "version 1 has the cable None"),
        ("x", "another kind"),
    ):
        meta["attributes"]["schema"] = f"cablejax-dataset/{version}"
        (path / "zarr.json").write_text(json.dumps(meta))
        for opens in (open_store, lambda path: open_or_create(path, SMALL)):
            with pytest.raises(ValueError, match=words):
                opens(path)


def test_versions_are_not_mixed(tmp_path):
    path = tmp_path / "data"
    store = open_or_create(path, SMALL)
    meta = json.loads((path / "zarr.json").read_text())
    meta["attributes"]["versions"]["mujoco"] = "0.0.1"
    (path / "zarr.json").write_text(json.dumps(meta))
    with pytest.raises(ValueError, match=r"mujoco is '0.0.1' in the store"):
        open_or_create(path, SMALL)
    complete(store)
    assert open_or_create(path, SMALL).info().complete  # nothing is left to be mixed


@pytest.mark.parametrize("mounted", [False, True])
def test_an_empty_folder_that_is_a_link_or_mounted_is_filled(tmp_path, monkeypatch, mounted):
    """Nothing can be renamed to where another file system is mounted."""
    disk, path = tmp_path / "disk", tmp_path / "data"
    disk.mkdir()
    path.symlink_to(disk)
    if mounted:
        monkeypatch.setattr(Path, "rename", Mock(side_effect=OSError(errno.EBUSY, "Device or resource busy")))
    store = open_or_create(path, SMALL)
    monkeypatch.undo()
    complete(store)
    complete(open_or_create(tmp_path / "other", SMALL))
    assert path.is_symlink() and tree(disk) == tree(tmp_path / "other")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["data", "disk", "other"]


def test_a_mounted_folder_that_a_kill_left_half_described_is_filled(tmp_path, monkeypatch):
    path = tmp_path / "data"
    complete(open_or_create(tmp_path / "other", SMALL))
    open_or_create(path, SMALL)
    (path / "zarr.json").unlink()  # the last to be written
    (path / "gripper_twist" / "zarr.json").rename(path / "gripper_twist" / "zarr.json.part")
    monkeypatch.setattr(Path, "rename", Mock(side_effect=OSError(errno.EBUSY, "Device or resource busy")))
    store = open_or_create(path, SMALL)
    monkeypatch.undo()
    complete(store)
    assert tree(path) == tree(tmp_path / "other")


def test_a_folder_of_other_data_sets_is_not_filled(tmp_path):
    open_or_create(tmp_path / "runs" / "a", SMALL)
    with pytest.raises(ValueError, match="holds files other than a data set"):
        open_or_create(tmp_path / "runs", SMALL)


def test_altered_or_damaged_configuration_is_noticed(tmp_path):
    path = tmp_path / "data"
    open_or_create(path, SMALL)
    text = (path / "zarr.json").read_text()
    (path / "zarr.json").write_text(text.replace('"seed": 0', '"seed": 3'))
    with pytest.raises(ValueError, match="altered"):
        open_store(path)
    (path / "zarr.json").write_text(text[: len(text) // 2])
    with pytest.raises(ValueError, match="damaged"):
        open_store(path)


def rewrite_config(path: Path, change) -> None:
    """What another version of the package would have recorded."""
    meta = json.loads((path / "zarr.json").read_text())
    change(meta["attributes"]["config"])
    meta["attributes"]["config_digest"] = digest_of_config(meta["attributes"]["config"])
    (path / "zarr.json").write_text(json.dumps(meta))


def test_a_store_from_before_an_option_existed_is_read_but_not_continued(tmp_path):
    path = tmp_path / "data"
    complete(open_or_create(path, SMALL))
    rewrite_config(path, lambda config: config["discretisation"]["cable"].pop("damping_time"))
    assert open_store(path).config == SMALL and len(open_store(path).read()) == 7
    with pytest.raises(ValueError, match=r"discretisation.cable.damping_time is 'absent' in the store"):
        open_or_create(path, SMALL)


def test_a_store_from_a_version_with_other_options_is_refused(tmp_path):
    path = tmp_path / "data"
    open_or_create(path, SMALL)
    rewrite_config(path, lambda config: config["motion"].update(teleport=True))
    with pytest.raises(ValueError, match="MotionConfig has the unknown teleport"):
        open_store(path)


def test_a_folder_that_is_something_else_is_left_alone(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="holds files other than a data set"):
        open_or_create(tmp_path, SMALL)
    with pytest.raises(ValueError, match="is a file"):
        open_or_create(tmp_path / "notes.txt", SMALL)
    with pytest.raises(ValueError, match="holds no data set"):
        open_store(tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["notes.txt"]
    (tmp_path / "empty").mkdir()
    assert open_or_create(tmp_path / "empty", SMALL).info().n_complete == 0


def test_a_block_of_the_wrong_shape_is_refused(tmp_path):
    store = open_or_create(tmp_path / "data", SMALL)
    with pytest.raises(ValueError, match=r"Shard 2: keypoints is float32\[3, .*expected float32\[1, "):
        store.write_shard(2, block(SMALL, 0))
    with pytest.raises(ValueError, match=r"shards 0\.\.2"):
        store.read_shard(3)


def test_configuration_survives_the_store(tmp_path):
    config = dataclasses.replace(
        SMALL, randomisation=Randomisation(stiffness=(0.1, 3.0)), motion=MotionConfig(start="random")
    )
    open_or_create(tmp_path / "data", config)
    assert open_store(tmp_path / "data").config == config
