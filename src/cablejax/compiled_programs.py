"""Keeps compiled programs between runs: those of JAX on the command line, and those of numba."""

from __future__ import annotations

import hashlib
import os
import pathlib
import platform
import sys
from collections.abc import Callable
from typing import Any

FOLDER = "CABLEJAX_CACHE"
"""Environment variable that names the folder for compiled programs; empty = keep none."""

LARGEST_BYTES = 1024**3
"""Beyond this size the programs that were not used for longest go. A diagnosis keeps about 15 MB, a shaping 5 MB."""

LEAST_SECONDS = 0.5
"""Programs that compile faster than this are not kept."""


def keep_compiled_programs() -> pathlib.Path | None:
    """Makes JAX keep its compiled programs on disk and load them in later runs.

    The folder is `$CABLEJAX_CACHE`, or `cablejax` in the user's cache folder, with a folder inside for each kind of
    processor: code compiled for one may hold instructions that another lacks. JAX itself distinguishes programs,
    versions and compiler flags. What the user has set for JAX, such as `JAX_COMPILATION_CACHE_DIR`, stays as it is.

    Returns:
        The folder; None where nothing is kept by this call: the user has decided, JAX has been imported and so belongs
        to somebody else, or the folder cannot be written to or the user has no home.
    """
    chosen = os.environ.get(FOLDER)
    if chosen == "" or "jax" in sys.modules or "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return None
    base = pathlib.Path(chosen) if chosen else _user_cache() / "cablejax"
    try:
        folder = base.expanduser().absolute() / f"programs-{_processor()}"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # RuntimeError: the user has no home
        return None
    if not os.access(folder, os.W_OK):
        return None
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    os.environ.setdefault("JAX_COMPILATION_CACHE_MAX_SIZE", str(LARGEST_BYTES))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", str(LEAST_SECONDS))
    return folder


def kept_on_disk(function: Callable[..., Any]) -> Any:
    """The function compiled by numba, which keeps it next to its file or in the user's cache folder.

    Where neither can be written to, as for a service without a home, it is compiled in each process.
    """
    import numba

    try:
        return numba.njit(nogil=True, cache=True)(function)
    except RuntimeError:  # numba finds no folder
        return numba.njit(nogil=True)(function)


def _user_cache() -> pathlib.Path:
    """The user's cache folder by the XDG base directory specification; a relative `XDG_CACHE_HOME` does not count."""
    named = pathlib.Path(os.environ.get("XDG_CACHE_HOME", ""))
    return named if named.is_absolute() else pathlib.Path("~/.cache")


def processor_lines() -> list[str]:
    """The system's description of its processors; empty where it has none."""
    cpuinfo = pathlib.Path("/proc/cpuinfo")
    return cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines() if cpuinfo.is_file() else []


def _processor() -> str:
    """A digest of the processor's model and instructions."""
    telling = {line for line in processor_lines() if line.startswith(("model name", "flags", "Features", "CPU part"))}
    return hashlib.sha256("\n".join([platform.machine(), *sorted(telling)]).encode()).hexdigest()[:12]
