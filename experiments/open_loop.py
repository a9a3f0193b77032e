"""Open-loop errors of a model, in one call."""

from __future__ import annotations

from collections.abc import Sequence

from flax import nnx

from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.evaluate import HORIZONS, OpenLoopError, evaluation_windows, summarise, window_errors
from cablejax.dynamics.model import OneStepModel
from cablejax.types import Trajectory


def open_loop_error(
    model: OneStepModel | tuple[nnx.GraphDef, nnx.State],
    data: Trajectory,
    config: ModelConfig,
    *,
    horizons: Sequence[int] = HORIZONS,
    stride: int = 10,
) -> OpenLoopError:
    """Rolls `model` from every `stride`-th sample of every trajectory and summarises the errors.

    Args:
        model: one-step model, or a network as `(graphdef, weights)`.
        data: held-out trajectories, arrays [M, T + 1, N, 2], [M, T + 1, 2, 3], [M, T, 2, 3].
        config: of the graph: history, keypoints, interval.
        horizons: steps after which errors are reported.
        stride: samples between start points.
    """
    steps = max(horizons)
    windows = evaluation_windows(data, config, steps=steps, stride=stride)
    return summarise(window_errors(model, windows, config), windows, horizons=horizons)
