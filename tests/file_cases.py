"""Damaged files."""

from collections.abc import Iterator

import numpy as np


def with_other_bytes(whole: bytes, count: int) -> Iterator[bytes]:
    """A file's content, again and again with up to three of its bytes changed."""
    rng = np.random.default_rng(0)
    for _ in range(count):
        broken = bytearray(whole)
        for place in rng.integers(0, len(whole), 3):
            broken[place] ^= int(rng.integers(1, 256))
        yield bytes(broken)
