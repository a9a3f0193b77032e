"""Pickles: arrays come out as they went in, and nothing that a pickle says is run."""

import builtins
import collections
import os
import pathlib
import pickle
import subprocess

import numpy as np
import pytest

from cablejax.recordings.pickles import UnsafePickleError, read_pickle

PROTOCOLS = range(pickle.HIGHEST_PROTOCOL + 1)
NUMBERS = np.random.default_rng(0).normal(size=(5, 3, 4))


class Gadget:
    """Pickles as a call of anything."""

    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


def written(folder: pathlib.Path, value, protocol: int = 4) -> pathlib.Path:
    path = folder / "block.pkl"
    path.write_bytes(value if isinstance(value, bytes) else pickle.dumps(value, protocol))
    return path


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize(
    "array",
    [
        NUMBERS,
        NUMBERS.astype(np.float32),
        np.asfortranarray(NUMBERS),
        NUMBERS[:, ::2],
        NUMBERS.astype(">f8"),
        NUMBERS > 0,
        np.arange(6).reshape(2, 3),
        np.zeros((0, 3)),
    ],
    ids=["float64", "float32", "fortran", "strided", "big-endian", "bool", "int", "empty"],
)
def test_arrays_come_out_as_they_went_in(tmp_path, array, protocol):
    back = read_pickle(written(tmp_path, array, protocol))
    assert back.dtype == array.dtype and back.shape == array.shape
    np.testing.assert_array_equal(back, array)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_containers_and_scalars_come_out_as_they_went_in(tmp_path, protocol):
    value = {"blocks": list(NUMBERS), "dt": 0.01, "one": NUMBERS[0, 0, 0], "names": ("a", 3, None, True)}
    back = read_pickle(written(tmp_path, value, protocol))
    assert back["dt"] == 0.01 and back["names"] == value["names"] and back["one"] == value["one"]
    np.testing.assert_array_equal(np.array(back["blocks"]), NUMBERS)


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize(
    "gadget",
    [
        lambda mark: Gadget(os.system, f"touch {mark}"),
        lambda mark: Gadget(subprocess.check_call, ["touch", str(mark)]),
        lambda mark: Gadget(builtins.eval, f"open({str(mark)!r}, 'w').close()"),
        lambda mark: Gadget(builtins.exec, f"open({str(mark)!r}, 'w').close()"),
        lambda mark: Gadget(builtins.open, str(mark), "w"),
        lambda mark: Gadget(getattr, mark, "touch"),
        lambda mark: Gadget(pathlib.Path.touch, mark),
        lambda mark: Gadget(np.save, str(mark), 1.0),
        lambda mark: [NUMBERS, Gadget(os.system, f"touch {mark}")],
        lambda mark: np.array([Gadget(os.system, f"touch {mark}"), 1.0], object),
    ],
    ids=["system", "subprocess", "eval", "exec", "open", "getattr", "method", "numpy", "beside arrays", "object array"],
)
def test_nothing_is_run(tmp_path, gadget, protocol):
    mark = tmp_path / "ran"
    path = written(tmp_path, gadget(mark), protocol)
    with pytest.raises(UnsafePickleError, match=r"refers to|arrays of objects|opcode"):
        read_pickle(path)
    assert [file.name for file in tmp_path.iterdir()] == ["block.pkl"]


@pytest.mark.parametrize(
    "pickled",
    [
        b"cos\nsystem\n(S'true'\ntR.",
        b"c__builtin__\neval\n(S'1'\ntR.",
        b"(S'true'\nios\nsystem\n.",  # INST
        b"(cos\nsystem\nS'true'\no.",  # OBJ
        b"\x80\x02cos\nsystem\nU\x04true\x85\x81.",  # NEWOBJ
        b"\x80\x02\x82\x01.",  # EXT1
        b"Pobject\n.",  # PERSID
        b"cnumpy\nload\n(S'x.npy'\ntR.",
        b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\ndtype\n(I0\ntS'b'\ntR.",
        b"cnumpy.core.multiarray\n_reconstruct\n(ccollections\nCounter\n(I0\ntS'b'\ntR.",
        b"cnumpy\ndtype\n(S'O8'\nI0\nI1\ntR.",
        b"cnumpy\ndtype\n(S'V16'\nI0\nI1\ntR.",
        b"cnumpy\nndarray\n.",
        b"cnumpy\nndarray\n(dS'x'\nI1\nsb.",  # BUILD on the class itself
        b"c_codecs\nencode\n(dS'x'\nI1\nsb.",  # BUILD on a function
        b"c_codecs\nencode\n(S'whoami'\nS'rot13'\ntR.",
        b"c__builtin__\nbytes\n(I1000000000\ntR.",
    ],
)
def test_pickles_by_hand_are_refused(tmp_path, pickled):
    with pytest.raises(ValueError, match=r"was not read"):
        read_pickle(written(tmp_path, pickled))


def test_a_type_or_other_class_is_refused(tmp_path):
    for value in (np.dtype("f8"), collections.Counter("ab"), np.array(["text"]), np.array(["2020"], "M8[D]"), {1, 2}):
        with pytest.raises(UnsafePickleError):
            read_pickle(written(tmp_path, value))


def test_small_files_cannot_ask_for_much_memory(tmp_path):
    huge = pickle.dumps(np.zeros(3), 4).replace(b"K\x03", b"K\xff")
    with pytest.raises(UnsafePickleError, match=r"shape \(255,\) and type float64 in 24 bytes"):
        read_pickle(written(tmp_path, huge))
    with pytest.raises(UnsafePickleError, match="far beyond its size"):
        read_pickle(written(tmp_path, b"\x80\x02]r\xff\xff\xff\x7f."))
    nested: list = []
    for _ in range(40):  # two to the power of 40, from a file of some hundred bytes
        nested = [nested, nested]
    with pytest.raises(UnsafePickleError, match="3 deep"):
        read_pickle(written(tmp_path, nested))
    endless: list = []
    endless.append(endless)
    with pytest.raises(UnsafePickleError, match="3 deep"):
        read_pickle(written(tmp_path, endless))


def test_what_is_no_pickle_is_reported(tmp_path):
    for data in (b"", b"\x93NUMPY", pickle.dumps(NUMBERS)[:200], b"\x80\x04]\x94h\x07a."):
        with pytest.raises(ValueError, match=r"no pickle, or a damaged one .*\. Copy it again, or leave it out"):
            read_pickle(written(tmp_path, data))
    with pytest.raises(FileNotFoundError, match="no file"):
        read_pickle(tmp_path / "absent.pkl")
