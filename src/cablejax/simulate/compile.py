"""Compiler options for simulator functions."""

from __future__ import annotations

import jax


def compiler_options() -> dict[str, bool]:
    """Options for `jax.jit(f, compiler_options=...)` around anything that contains an MJX rollout.

    XLA's CPU fusion emitters of jaxlib 0.10 recompute the kinematic chain exponentially: 12 links run 500 times
    slower. Later versions and other platforms need nothing.
    """
    if jax.default_backend() == "cpu" and jax.__version_info__ < (0, 11):
        return {"xla_cpu_use_fusion_emitters": False}
    return {}
