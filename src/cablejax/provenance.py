"""Provenance of a result: package versions and the machine."""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Sequence

import cablejax
from cablejax.compiled_programs import processor_lines
from cablejax.cores import available_cores

_PACKAGES = ("jax", "jaxlib", "flax", "mujoco", "mujoco-mjx", "optimistix", "numpy")


def package_versions(packages: Sequence[str]) -> dict[str, str]:
    """Versions of cablejax and of some packages; "not installed" of those that are not."""
    versions = {"cablejax": cablejax.__version__}
    for name in packages:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions


def versions() -> str:
    """Versions of this package, of Python, and of the packages that decide its numbers, in words."""
    first, *others = (f"{name} {version}" for name, version in package_versions(_PACKAGES).items())
    return ", ".join([first, f"Python {platform.python_version()}", *others])


def machine() -> str:
    """The processor, the number of cores this process may use, and the system, in words."""
    named = (line.partition(":")[2].strip() for line in processor_lines() if line.startswith("model name"))
    model = next(named, platform.processor() or platform.machine())
    return f"{model}, {available_cores()} cores, {platform.system()}"
