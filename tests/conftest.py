"""What all tests share."""

from __future__ import annotations

import gc
import importlib.metadata
import itertools
import os
import pathlib

import pytest

from cablejax.compiled_programs import FOLDER, keep_compiled_programs

# Tests compile far more than they compute. Code that LLVM did not optimise, without the fusion emitters of jaxlib 0.10,
# takes a third of the time to compile and differs by rounding only. It has to be said before JAX starts; programs that
# tests start inherit it. The diagnosis asks for optimised code all the same (`diagnose.playback`).
_FLAGS = ["--xla_backend_optimization_level=0"]
if tuple(map(int, importlib.metadata.version("jaxlib").split(".")[:2])) < (0, 11):
    _FLAGS.append("--xla_cpu_use_fusion_emitters=false")
os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *_FLAGS])

# One thread for each of two workers, which fight for the processors otherwise.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# A program is compiled once for all workers, all that tests start, and later runs: this file is loaded first by the
# process that starts the workers, and they inherit what it sets.
os.environ.setdefault(FOLDER, str(pathlib.Path(__file__).parents[1] / ".pytest_cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")
keep_compiled_programs()

# Tracing makes many objects that live long, and looking through all of them at Python's usual rate takes a tenth of the
# time of the tests.
gc.set_threshold(200_000, 50, 100)

_MAPS = pathlib.Path("/proc/self/maps")
_MANY, _SOME = 40_000, 10
"""Linux gives a process 65,530 memory mappings, and aborts a compilation that wants more; so few tests make less than
the rest of them. What is dropped has to be compiled again, so not more often than needed."""
_run = itertools.count(1)


@pytest.fixture(autouse=True)
def compiled_programs_are_dropped_when_there_are_many():
    """Every compiled program holds mappings, and one process runs hundreds of tests."""
    yield
    import jax

    if next(_run) % _SOME == 0 and _MAPS.exists() and _MAPS.read_bytes().count(b"\n") > _MANY:
        jax.clear_caches()
        gc.collect()
