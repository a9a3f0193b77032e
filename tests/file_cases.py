"""Contents of folders, and damaged files."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np


def tree(path: Path) -> dict[str, bytes]:
    """Content of every file under a folder, by its path there."""
    return {str(file.relative_to(path)): file.read_bytes() for file in sorted(path.rglob("*")) if file.is_file()}


def with_other_bytes(whole: bytes, count: int) -> Iterator[bytes]:
    """A file's content, again and again with up to three of its bytes changed."""
    rng = np.random.default_rng(0)
    for _ in range(count):
        broken = bytearray(whole)
        for place in rng.integers(0, len(whole), 3):
            broken[place] ^= int(rng.integers(1, 256))
        yield bytes(broken)
