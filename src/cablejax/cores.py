"""Counts the processor cores that this process may use."""

from __future__ import annotations

import os


def available_cores() -> int:
    """Number of cores: those that the process is bound to where the system binds processes, otherwise all."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
