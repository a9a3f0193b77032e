"""Point positions from PCD files, the format of the Point Cloud Library, version 0.7, ascii and binary."""

from __future__ import annotations

import pathlib

import numpy as np
from jaxtyping import Float

from cablejax.limits import shown
from cablejax.text_file import read_bytes

_KINDS = {"F": "f", "I": "i", "U": "u"}


def read_pcd(path: pathlib.Path) -> Float[np.ndarray, "S 3"]:
    """Positions x, y, z in the order of the file, float32, NaN where the file has none, shape [S, 3].

    Other fields are passed over, and so is the viewpoint: the positions are taken as they stand.

    Raises:
        ValueError: the file is not a PCD file, is compressed, cut short, or has no x, y and z.
    """
    content = read_bytes(path)
    header, start = _header(path, content)
    try:
        names = header["FIELDS"]
        counts = [int(value) for value in header.get("COUNT", ["1"] * len(names))]
        sizes = [int(value) for value in header["SIZE"]]
        kinds = [_KINDS[value] for value in header["TYPE"]]
        points = int(header["POINTS"][0])
        if points < 0 or min(counts) < 1:
            raise ValueError(f"{points} points of {min(counts)} values")
        encoding = header["DATA"][0].lower()
        columns = [
            (f"{index}", f"<{kind}{size}", (count,))
            for index, (kind, size, count) in enumerate(zip(kinds, sizes, counts, strict=True))
        ]
        layout = np.dtype(columns)
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise ValueError(f"{path} has a PCD header that is incomplete or contradicts itself: {error}.") from None
    if len(columns) != len(names) or not {"x", "y", "z"} <= set(names):
        raise ValueError(
            f"{path} has the fields {' '.join(names)}, expected x, y and z among them, each with its type."
        )
    if encoding == "binary":
        size = points * layout.itemsize
        if len(content) - start < size:
            raise ValueError(f"{path} is cut short: {len(content) - start} bytes of points, expected {size}.")
        table = np.frombuffer(content, layout, count=points, offset=start)
        return np.stack([table[str(names.index(axis))][:, 0] for axis in "xyz"], axis=1).astype(np.float32)
    if encoding == "ascii":
        column = np.cumsum([0, *counts])
        rows = [line.split() for line in content[start:].decode("ascii", "replace").splitlines() if line.strip()]
        if len(rows) < points or any(len(row) < column[-1] for row in rows[:points]):
            raise ValueError(f"{path} is cut short: expected {points} rows of {column[-1]} values.")
        try:
            values = [[float(row[column[names.index(axis)]]) for axis in "xyz"] for row in rows[:points]]
        except ValueError as error:
            raise ValueError(f"{path} has a point that is not a number: {shown(str(error))}") from None
        return np.array(values).reshape(points, 3).astype(np.float32)
    raise ValueError(
        f"{path} has DATA {encoding}, expected ascii or binary: convert it with pcl_convert_pcd_ascii_binary."
    )


def _header(path: pathlib.Path, content: bytes) -> tuple[dict[str, list[str]], int]:
    """Entries of the header, and where the points begin."""
    entries: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in entries:
        end = content.find(b"\n", start)
        if end < 0 or start > 4096:
            raise ValueError(f"{path} is not a PCD file: it has no line that begins with DATA.")
        words = content[start:end].decode("ascii", "replace").split()
        start = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0]] = words[1:]
    return entries, start
