"""Reads a pickle of number arrays without running anything in it.

A pickle is a program: unpickling one from the internet with the standard loader can start any other. Here its
opcodes are checked first, and the few names that a pickled array needs stand for classes of this file which only
collect bytes. NumPy sees nothing but a checked type, a checked shape and a buffer of the right size.
"""

from __future__ import annotations

import io
import math
import os
import pickle
import pickletools
from collections.abc import Callable
from typing import Any

import numpy as np

from cablejax.text_file import read_bytes

MOST_DEPTH, MOST_ENTRIES = 3, 10_000
"""How deep lists may hold each other, and how long one may be."""

# Containers, numbers, strings, the memo, and the four opcodes that call something: which names they may call is
# decided in `_Unpickler.find_class`. Not here: PERSID, EXT, INST, OBJ and NEWOBJ, which no array needs.
_OPCODES = frozenset((
    "PROTO", "FRAME", "STOP", "MARK", "POP", "POP_MARK", "DUP", "MEMOIZE", "PUT", "BINPUT", "LONG_BINPUT",
    "GET", "BINGET", "LONG_BINGET", "NONE", "NEWTRUE", "NEWFALSE", "INT", "LONG", "LONG1", "LONG4", "BININT",
    "BININT1", "BININT2", "FLOAT", "BINFLOAT", "STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE",
    "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8",
    "TUPLE", "EMPTY_TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "LIST", "EMPTY_LIST", "APPEND", "APPENDS", "DICT",
    "EMPTY_DICT", "SETITEM", "SETITEMS", "GLOBAL", "STACK_GLOBAL", "REDUCE", "BUILD",
))  # fmt: skip


class UnsafePickleError(ValueError):
    """A pickle that holds, or asks for, anything but containers and arrays of numbers."""


class _Type:
    """Stands for `numpy.dtype` of a plain number."""

    def __init__(self, name: Any, align: Any = False, copy: Any = True):
        if isinstance(name, bytes):
            name = name.decode("latin1")
        try:
            self.dtype = np.dtype(name) if isinstance(name, str) and len(name) <= 3 else None
        except TypeError:
            self.dtype = None
        if self.dtype is None or self.dtype.kind not in "fiub":
            raise UnsafePickleError(
                f"it has an array of type {name!r}, expected floating point numbers, integers or truth values; arrays "
                "of objects are not read."
            )

    def __setstate__(self, state: Any) -> None:
        order = state[1] if isinstance(state, tuple) and len(state) > 1 else None
        order = order.decode("latin1") if isinstance(order, bytes) else order
        if order not in ("<", ">", "|", "="):
            raise UnsafePickleError(f"it has a number type with the byte order {order!r}, expected '<', '>' or '|'.")
        assert self.dtype is not None
        self.dtype = self.dtype.newbyteorder(order)


class _Array:
    """Stands for `numpy.ndarray`, between its construction and its state."""

    def __init__(self):
        self.value: np.ndarray | None = None

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            raise UnsafePickleError("it has an array without the five parts of one.")
        _, shape, kind, fortran, data = state
        self.value = _from_buffer(data, kind, shape, "F" if fortran is True else "C")


def _from_buffer(data: Any, kind: Any, shape: Any, order: Any = "C") -> np.ndarray:
    if isinstance(data, str):  # written by Python 2, or by protocol 2
        data = _encode(data, "latin1")
    if not isinstance(kind, _Type) or not isinstance(data, (bytes, bytearray)):
        raise UnsafePickleError(
            f"it has an array whose numbers are a {type(data).__name__}, expected bytes; arrays of objects are not "
            "read."
        )
    if not isinstance(shape, tuple) or not all(isinstance(n, int) and n >= 0 for n in shape) or len(shape) > 8:
        raise UnsafePickleError(f"it has an array of shape {shape!r}, expected a few integers >= 0.")
    dtype = kind.dtype
    assert dtype is not None
    if len(data) != math.prod(shape) * dtype.itemsize:
        raise UnsafePickleError(f"it has an array of shape {shape} and type {dtype} in {len(data)} bytes.")
    return np.frombuffer(bytes(data), dtype).reshape(shape, order="F" if order == "F" else "C")


def _reconstruct(subtype: Any, shape: Any, code: Any) -> _Array:
    if subtype is not _NAMES["numpy", "ndarray"]:
        raise UnsafePickleError("it builds an array of another class than numpy.ndarray.")
    return _Array()


def _encode(text: Any, encoding: Any = "latin1") -> bytes:
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise UnsafePickleError(
            f"it encodes a {type(text).__name__} as {encoding!r}, expected bytes written as latin1."
        )
    return text.encode("latin1")


def _no_bytes(*arguments: Any) -> bytes:
    """Old protocols write no bytes, those of an empty array, as a call of `bytes`."""
    if arguments:
        raise UnsafePickleError("it builds bytes from something else.")
    return b""


class _Name:
    """Stand-in for a name in a pickle: may be called, but its attributes, unlike a function's, cannot be set."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., Any]):
        self._function = function

    def __call__(self, *arguments: Any) -> Any:
        return self._function(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise UnsafePickleError("it changes a function.")


_NAMES: dict[tuple[str, str], _Name] = {
    ("numpy", "ndarray"): _Name(_Array),
    ("numpy", "dtype"): _Name(_Type),
    ("_codecs", "encode"): _Name(_encode),
    ("__builtin__", "bytes"): _Name(_no_bytes),
    **{
        (f"{core}.{module}", name): _Name(function)
        for core in ("numpy.core", "numpy._core")
        for module, name, function in (
            ("multiarray", "_reconstruct", _reconstruct),
            ("multiarray", "scalar", lambda kind, data: _from_buffer(data, kind, ())),
            ("numeric", "_frombuffer", _from_buffer),
        )
    },
}


class _Unpickler(pickle.Unpickler):
    def find_class(self, module_name: str, global_name: str, /) -> Any:
        try:
            return _NAMES[module_name, global_name]
        except KeyError:
            raise UnsafePickleError(
                f"it refers to {module_name}.{global_name}, which no array of numbers needs: the file may try to run "
                "code."
            ) from None

    def persistent_load(self, pid: Any, /) -> Any:
        raise UnsafePickleError("it refers to an object outside the file.")


def read_pickle(path: str | os.PathLike[str]) -> Any:
    """Reads a pickle of arrays of numbers, by themselves or in lists, tuples and dictionaries.

    Nothing that the file names is imported or called.

    Returns:
        What was pickled, with read-only arrays; numbers and strings as they are.

    Raises:
        UnsafePickleError: the file asks for anything else; says for what.
        ValueError: the file is no pickle, or see `read_bytes`.
        FileNotFoundError: there is no such file.
    """
    data = read_bytes(path)
    refused = f"{path} was not read: "
    try:
        _check_opcodes(data)
        return _finished(_Unpickler(io.BytesIO(data), encoding="latin1").load(), MOST_DEPTH)
    except UnsafePickleError as error:
        raise UnsafePickleError(refused + str(error)) from None
    except Exception as error:  # a damaged pickle can fail anywhere in the loader, with any kind of error
        raise ValueError(
            f"{refused}it is no pickle, or a damaged one ({type(error).__name__}: {error}). "
            "Copy it again, or leave it out."
        ) from None


def _check_opcodes(data: bytes) -> None:
    for count, (opcode, argument, position) in enumerate(pickletools.genops(data)):
        if opcode.name not in _OPCODES:
            raise UnsafePickleError(
                f"it has the opcode {opcode.name} at byte {position}, which no array of numbers needs."
            )
        # The loader reserves as many places in its memo as the largest index, whatever the size of the file.
        if opcode.name in ("PUT", "BINPUT", "LONG_BINPUT") and int(str(argument)) > count:
            raise UnsafePickleError(f"it numbers its objects up to {argument} at byte {position}, far beyond its size.")


def _finished(value: Any, depth: int) -> Any:
    """The value with arrays in the place of what stood for them."""
    if isinstance(value, _Array):
        if value.value is None:
            raise UnsafePickleError("it has an array without numbers.")
        return value.value
    if isinstance(value, (list, tuple, dict)):
        # Lists that hold each other grow as a power of their depth, or without end.
        if depth == 0 or len(value) > MOST_ENTRIES:
            raise UnsafePickleError(
                f"it has containers more than {MOST_DEPTH} deep, or of more than {MOST_ENTRIES} entries; expected "
                "arrays, or lists of them."
            )
        if isinstance(value, dict):
            return {_finished(key, 0): _finished(entry, depth - 1) for key, entry in value.items()}
        return type(value)(_finished(entry, depth - 1) for entry in value)
    if isinstance(value, (_Type, _Name)):
        raise UnsafePickleError("it holds a type or a function, expected arrays of numbers.")
    return value
