"""Files are there whole or not at all, with the mode that the user's other files have."""

import os

import pytest
from flax import nnx

from cablejax import whole_file as whole_file_module
from cablejax.commands.options import output_folder
from cablejax.dynamics.networks import GNS
from cablejax.dynamics.run_folder import claim_folder
from cablejax.dynamics.weights import save_weights
from cablejax.whole_file import draft_folder, holds_anything, whole_file
from dynamics_cases import SMALL


def test_a_block_that_is_left_early_changes_nothing(tmp_path):
    path = tmp_path / "a.txt"
    with whole_file(path) as stream:
        stream.write(b"one")
    with pytest.raises(KeyboardInterrupt), whole_file(path) as stream:
        stream.write(b"two")
        raise KeyboardInterrupt
    assert path.read_bytes() == b"one" and list(tmp_path.iterdir()) == [path]


def test_a_writer_that_comes_as_another_ends_does_not_touch_its_file(tmp_path, monkeypatch):
    path, opened = tmp_path / "a.txt", []

    def lock(place, _):
        if not opened:  # another process writes the file between the opening and the lock
            opened.append(place)
            with whole_file(path) as stream:
                stream.write(b"first")

    monkeypatch.setattr(whole_file_module, "_lock", lock)
    with pytest.raises(ValueError, match="Another process has just written"), whole_file(path) as stream:
        stream.write(b"second")
    assert path.read_bytes() == b"first" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_weights_have_the_mode_of_other_files(umask, tmp_path):
    path = tmp_path / "weights.safetensors"
    before = os.umask(umask)
    try:
        save_weights(path, SMALL, nnx.split(GNS(SMALL, nnx.Rngs(0)))[1], {})
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == 0o666 & ~umask


def test_what_kills_left_of_drafts_is_removed_once_it_is_old(tmp_path):
    for name in (".a.old.draft", ".a.new.draft", ".b.old.draft"):
        (tmp_path / name / "data").mkdir(parents=True)
        if "old" in name:
            os.utime(tmp_path / name, (0, 0))
    with draft_folder(tmp_path / "a") as draft:
        draft.mkdir()
    assert {path.name for path in tmp_path.iterdir()} == {".a.new.draft", ".b.old.draft"}


def test_a_draft_of_a_file_is_nothing(tmp_path):
    (tmp_path / "log.npz.part").touch()
    assert not holds_anything(tmp_path)
    output_folder(tmp_path, overwrite=False)
    claim_folder(tmp_path, {"config": {}, "data": ""}, overwrite=False)
    assert holds_anything(tmp_path)
