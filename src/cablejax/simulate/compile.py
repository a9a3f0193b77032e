"""Compiler options and precision of simulator functions, and batches spread over devices."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import ParamSpec, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

AXIS = "cable"
"""Of devices, over which a batch is spread."""

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def compiler_options() -> dict[str, bool]:
    """Options for `jax.jit(f, compiler_options=...)` around anything that contains an MJX rollout.

    XLA's CPU fusion emitters of jaxlib 0.10 recompute the kinematic chain exponentially: 12 links run 500 times
    slower. Later versions and other platforms need nothing.
    """
    if jax.default_backend() == "cpu" and jax.__version_info__ < (0, 11):
        return {"xla_cpu_use_fusion_emitters": False}
    return {}


def on_devices(
    batch: _Result,
    devices: Sequence[jax.Device],  # pyright: ignore[reportInvalidTypeForm]
    each: int,
) -> _Result:
    """The same arrays with `each` rows on every device, filled up with copies of the last row."""
    split = NamedSharding(Mesh(np.array(devices), (AXIS,)), PartitionSpec(AXIS))

    def spread(leaf):
        return jax.device_put(np.asarray(leaf)[np.minimum(np.arange(each * len(devices)), len(leaf) - 1)], split)

    return jax.tree.map(spread, batch)


def full_precision(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Traces a simulator's function with matrix products in the precision of their arguments.

    JAX's default on a GPU rounds single-precision factors to TF32, ten bits: keypoints of a cable of 1 m are then a
    quarter of a millimetre off.
    """

    @functools.wraps(function)
    def traced(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return traced
