"""Compiled programs are kept between runs of the command line, where the user has not decided otherwise."""

import json
import os
import subprocess
import sys

import numba
import pytest

from cablejax import compiled_programs
from cablejax.compiled_programs import FOLDER, keep_compiled_programs, kept_on_disk

PROGRAM = """
import json
from cablejax.compiled_programs import keep_compiled_programs
folder = keep_compiled_programs()
import jax
from jax import monitoring
events = []
monitoring.register_event_listener(lambda name, **_: events.append(name))
value = jax.jit(lambda x: jax.numpy.sin(x) @ x)(jax.numpy.ones(3))
hits = events.count("/jax/compilation_cache/cache_hits")
print(json.dumps([str(folder), hits, float(value)]))
"""


@pytest.fixture
def undecided(monkeypatch, tmp_path):
    """A process in which neither the user nor JAX has decided anything; the tests' own run has."""
    for name in ("JAX_COMPILATION_CACHE_DIR", "JAX_COMPILATION_CACHE_MAX_SIZE", FOLDER):
        monkeypatch.setenv(name, "")  # so that what a test sets is undone
        monkeypatch.delenv(name)
    monkeypatch.delitem(sys.modules, "jax")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return monkeypatch


def test_a_second_process_takes_what_the_first_compiled(tmp_path):
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment |= {FOLDER: str(tmp_path), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}

    def run() -> tuple[str, int, float]:
        done = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert "machine" not in done.stderr  # XLA's complaint about code for another processor
        return tuple(json.loads(done.stdout))

    first, second = run(), run()
    assert first[0] == second[0] and first[0].startswith(str(tmp_path))
    assert first[1] == 0 < second[1] and first[2] == second[2]


def test_the_folder_is_the_users_bounded_and_apart_for_each_processor(undecided, tmp_path):
    folder = keep_compiled_programs()
    assert folder is not None and folder.is_dir() and folder.parent == tmp_path / "cache" / "cablejax"
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == str(folder)
    assert int(os.environ["JAX_COMPILATION_CACHE_MAX_SIZE"]) == compiled_programs.LARGEST_BYTES
    undecided.delenv("JAX_COMPILATION_CACHE_DIR")
    undecided.setattr(compiled_programs.platform, "machine", lambda: "another")
    assert keep_compiled_programs() != folder


@pytest.mark.parametrize("decision", [{FOLDER: ""}, {"JAX_COMPILATION_CACHE_DIR": "/elsewhere"}])
def test_what_the_user_has_decided_stays(undecided, tmp_path, decision):
    for name, value in decision.items():
        undecided.setenv(name, value)
    assert keep_compiled_programs() is None
    assert os.environ.get("JAX_COMPILATION_CACHE_DIR") == decision.get("JAX_COMPILATION_CACHE_DIR")
    assert not (tmp_path / "cache").exists()


def test_a_program_that_has_imported_jax_is_left_alone(undecided):
    undecided.setitem(sys.modules, "jax", object())
    assert keep_compiled_programs() is None


def test_a_folder_that_cannot_be_made_is_no_error(undecided, tmp_path):
    (tmp_path / "file").write_text("")
    undecided.setenv(FOLDER, str(tmp_path / "file"))
    assert keep_compiled_programs() is None and "JAX_COMPILATION_CACHE_DIR" not in os.environ


def test_a_user_without_a_home_is_no_error(undecided):
    undecided.setenv(FOLDER, "~nobody_of_this_name/cache")
    assert keep_compiled_programs() is None and "JAX_COMPILATION_CACHE_DIR" not in os.environ


def test_numba_compiles_where_nothing_can_be_kept(monkeypatch):
    """As for a service without a home, and a package that another user installed."""

    def njit(*function, cache=False, **options):
        if cache is True:
            raise RuntimeError("cannot cache function 'double': no locator available")
        return numba_njit(*function, **options)

    numba_njit = numba.njit
    monkeypatch.setattr(numba, "njit", njit)
    assert kept_on_disk(lambda x: 2 * x)(21) == 42
