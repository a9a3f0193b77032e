"""Damaged `.npz` and JSON files, wherever they are read, raise an error."""

import contextlib
import json
import zipfile

import numpy as np
import pytest

from cablejax.control.targets import load_target
from cablejax.gaplog import read_gap_log
from cablejax.npz import NpzError, read_npz
from cablejax.perceive.recording import read_clouds
from cablejax.recordings.deform import read_deform
from cablejax.text_file import read_json, write_json
from file_cases import with_other_bytes
from real_cables.wires import read_wires

DEEP = "[" * 100_000


@pytest.fixture(params=["stored", "compressed"])
def archive(request, tmp_path):
    path = tmp_path / "a.npz"
    save = np.savez if request.param == "stored" else np.savez_compressed
    save(path, a=np.arange(300.0), b=np.zeros((3, 4), np.float32), text=np.array("words"))
    return path


def test_named_arrays_come_back_and_others_are_not_looked_at(tmp_path):
    np.savez(tmp_path / "a.npz", a=np.arange(3), objects=np.array([{}], dtype=object))
    assert read_npz(tmp_path / "a.npz", ["a"], ["b"])["a"].tolist() == [0, 1, 2]
    with pytest.raises(NpzError, match="lacks b, it has a, objects"):
        read_npz(tmp_path / "a.npz", ["a", "b"])
    with pytest.raises(NpzError, match="holds Python objects, expected plain arrays"):
        read_npz(tmp_path / "a.npz", ["objects"])
    with pytest.raises(FileNotFoundError, match="There is no file"):
        read_npz(tmp_path / "b.npz", ["a"])
    with pytest.raises(NpzError, match="is a folder, expected an"):
        read_npz(tmp_path, ["a"])


@pytest.mark.parametrize("content", [b"", b"garbage", b"\x93NUMPY"])
def test_a_member_that_is_no_array_is_refused(tmp_path, content):
    np.savez(tmp_path / "a.npz", a=np.arange(3))
    for name in ("b", "b.npy"):
        with zipfile.ZipFile(tmp_path / "a.npz") as whole, zipfile.ZipFile(tmp_path / f"{name}.npz", "w") as other:
            other.writestr("a.npy", whole.read("a.npy"))
            other.writestr(name, content)
        with pytest.raises(NpzError, match=rf"{name}\.npz (holds no array under b|could not be read)"):
            read_npz(tmp_path / f"{name}.npz", ["a", "b"])


def test_a_file_cut_off_anywhere_is_refused(archive):
    whole = archive.read_bytes()
    for length in range(0, len(whole), 17):
        archive.write_bytes(whole[:length])
        with pytest.raises(NpzError):
            read_npz(archive, ["a", "b", "text"])


def test_a_file_with_other_bytes_is_read_or_refused(archive):
    for broken in with_other_bytes(archive.read_bytes(), 400):
        archive.write_bytes(broken)
        with contextlib.suppress(NpzError):
            read_npz(archive, ["a", "b", "text"])


@pytest.mark.parametrize("read", [read_gap_log, load_target, read_clouds, read_wires, read_deform])
def test_every_reader_refuses_damaged_files(read, archive):
    whole = archive.read_bytes()
    for damaged in (whole[: len(whole) // 2], whole[:100] + bytes(100) + whole[200:], b"words", b""):
        archive.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"a\.npz"):
            read(archive)


def test_json_is_written_whole_and_read_with_a_message(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"x": 1.5})
    assert read_json(path) == {"x": 1.5} and [p.name for p in tmp_path.iterdir()] == ["a.json"]
    with pytest.raises(ValueError, match="JSON"):
        write_json(path, {"x": float("nan")})
    assert json.loads(path.read_text()) == {"x": 1.5}
    for text, message in (("", "is no JSON"), ('{"x": ', "is no JSON"), (DEEP, "nested too deep"), ("\xff", "no JSON")):
        path.write_text(text, encoding="latin1")
        with pytest.raises(ValueError, match=message):
            read_json(path)


def test_a_target_nested_too_deep_is_refused(tmp_path):
    (tmp_path / "a.json").write_text(DEEP)
    with pytest.raises(ValueError, match="nested too deep"):
        load_target(tmp_path / "a.json")
