"""Provenance of a result: package versions and the machine."""

from __future__ import annotations

import importlib.metadata
import os
import platform

import cablejax
from cablejax.compiled_programs import processor_lines

_PACKAGES = ("jax", "jaxlib", "flax", "mujoco", "mujoco-mjx", "optimistix", "numpy")


def versions() -> str:
    """Versions of this package and of those that decide its numbers, in words."""
    others = (f"{name} {importlib.metadata.version(name)}" for name in _PACKAGES)
    return ", ".join([f"cablejax {cablejax.__version__}", f"Python {platform.python_version()}", *others])


def machine() -> str:
    """The processor, the number of cores this process may use, and the system, in words."""
    named = (line.partition(":")[2].strip() for line in processor_lines() if line.startswith("model name"))
    model = next(named, platform.processor() or platform.machine())
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return f"{model}, {cores} cores, {platform.system()}"
