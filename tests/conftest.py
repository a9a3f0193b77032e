"""What all tests share."""

from __future__ import annotations

import gc
import pathlib

import jax
import pytest

_MAPS = pathlib.Path("/proc/self/maps")
_MANY = 25_000
"""Linux gives a process 65,530 memory mappings, and aborts a compilation that wants more; a test module makes up to
20,000."""


@pytest.fixture(scope="module", autouse=True)
def compiled_programs_are_dropped_when_there_are_many():
    """Every compiled program holds mappings, and one process runs hundreds of tests."""
    yield
    if _MAPS.exists() and len(_MAPS.read_text().splitlines()) > _MANY:
        jax.clear_caches()
        gc.collect()
