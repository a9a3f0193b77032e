"""Reads `.npz` files of plain arrays: nothing is unpickled, and a damaged file raises `NpzError`."""

from __future__ import annotations

import lzma
import os
import pathlib
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Sequence

import numpy as np

from cablejax.limits import require

# What the decompressors and NumPy raise on a file that is damaged, encrypted, or holds Python objects. A damaged header
# may ask for more memory than there is.
_UNREADABLE = (
    ValueError, TypeError, KeyError, OSError, EOFError, RuntimeError, MemoryError, OverflowError, SyntaxError,
    struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error, lzma.LZMAError,
)  # fmt: skip
_BEGIN = b"PK\x03\x04"
"""First bytes of an archive."""


class NpzError(ValueError):
    """An `.npz` file that is damaged, in another format, or lacks an array."""


def read_npz(
    path: str | os.PathLike[str], required: Sequence[str], optional: Sequence[str] = (), *, text: Sequence[str] = ()
) -> dict[str, np.ndarray]:
    """The named arrays of an `.npz` file; other arrays are ignored.

    Args:
        path: the file.
        required: names of arrays that must be there.
        optional: names of arrays that are read where they are there.
        text: those of both that may hold text; all others hold real numbers or truth values.

    Raises:
        NpzError: the file is a folder or no `.npz`, cannot be read, is too large when decompressed, lacks a required
            array, or holds something else under one of these names.
        FileNotFoundError: there is no such file.
    """
    path = pathlib.Path(path)
    if path.is_dir():
        raise NpzError(f"{path} is a folder, expected an .npz file.")
    if not path.is_file():
        raise FileNotFoundError(f"There is no file {path}.")
    if not zipfile.is_zipfile(path):
        with path.open("rb") as stream:
            begun = stream.read(len(_BEGIN)) == _BEGIN
        raise NpzError(f"{path} is {'cut off: make it again.' if begun else 'no .npz archive.'}")
    try:
        # NumPy leaves a file open that it opened itself and could not read
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            there = sorted(archive.files)
            size = sum(archive.zip.getinfo(member).file_size for member in archive.zip.namelist())
            require(size, "array_bytes", "The size of its arrays")
            arrays = {name: archive[name] for name in (*required, *optional) if name in there}
    except _UNREADABLE as error:
        raise NpzError(f"{path} could not be read: {_reason(error)}") from error
    for name, array in arrays.items():
        # a member that is no array comes as its bytes
        if not isinstance(array, np.ndarray) or array.dtype.kind not in ("biufU" if name in text else "biuf"):
            came = f"values of type {array.dtype}" if isinstance(array, np.ndarray) else "no array"
            expected = "real numbers or text" if name in text else "real numbers"
            raise NpzError(f"{path} holds {came} under {name}, expected an array of {expected}.")
    if missing := [name for name in required if name not in arrays]:
        raise NpzError(f"{path} lacks {', '.join(missing)}, it has {', '.join(there) or 'nothing'}.")
    return arrays


def _reason(error: Exception) -> str:
    """NumPy advises to unpickle what it will not read; nobody should."""
    return "it holds Python objects, expected plain arrays." if "pickle" in str(error) else f"{error}."
