"""What all tests share."""

from __future__ import annotations

import atexit
import gc
import itertools
import os
import pathlib
import shutil
import tempfile

# Tests compile far more than they compute: code that LLVM did not optimise is there in two thirds of the time, and
# differs by rounding only. It has to be said before JAX starts; programs that tests start inherit it. The diagnosis
# asks for optimised code all the same (`diagnose.playback`).
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0"

# One program is compiled once for all workers and all that tests start: this file is loaded first by the process that
# starts the workers, and they inherit what it sets. With a bound on its size JAX locks the folder.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    _programs = tempfile.mkdtemp(prefix="cablejax-tests-")
    atexit.register(shutil.rmtree, _programs, ignore_errors=True)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _programs
    os.environ["JAX_COMPILATION_CACHE_MAX_SIZE"] = str(4 * 1024**3)
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.3"

import jax
import pytest

_MAPS = pathlib.Path("/proc/self/maps")
_MANY, _SOME = 40_000, 10
"""Linux gives a process 65,530 memory mappings, and aborts a compilation that wants more; so few tests make less than
the rest of them. What is dropped has to be compiled again, so not more often than needed."""
_run = itertools.count(1)


@pytest.fixture(autouse=True)
def compiled_programs_are_dropped_when_there_are_many():
    """Every compiled program holds mappings, and one process runs hundreds of tests."""
    yield
    if next(_run) % _SOME == 0 and _MAPS.exists() and _MAPS.read_bytes().count(b"\n") > _MANY:
        jax.clear_caches()
        gc.collect()
