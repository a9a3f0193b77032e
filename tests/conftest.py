"""What all tests share."""

from __future__ import annotations

import gc
import os
import pathlib

# Tests compile far more than they compute: code that LLVM did not optimise is there in two thirds of the time, and
# differs by rounding only. It has to be said before JAX starts; programs that tests start inherit it.
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0"

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
