"""Open-loop accuracy of a network compared with baselines that learn nothing, as numbers and as tables.

Windows in which the cable snaps through count apart: there the error is that of guessing when it happens, decimetres
instead of millimetres, and a few of them decide a root mean square.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from flax import nnx

from cablejax.dataset.windows import concatenate
from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.evaluate import (
    HORIZONS,
    OpenLoopError,
    evaluation_windows,
    no_motion,
    prior_motion,
    snapping,
    summarise,
    window_errors,
)
from cablejax.text_file import markdown_table
from cablejax.types import Trajectory

MODEL = "network"
"""Name of the network among the predictors."""
GROUPS = ("all windows", "no snap-through", "snap-through")
"""Windows by whether the cable snaps through in them."""


@dataclasses.dataclass(frozen=True)
class ErrorReport:
    """Open-loop errors of a network and of the baselines on held-out trajectories.

    Attributes:
        errors: by group of windows (`GROUPS`), then by predictor, over all data sets.
        by_data: of the network in the windows without snap-through, by data set.
    """

    errors: dict[str, dict[str, OpenLoopError]]
    by_data: dict[str, OpenLoopError]

    def snapping_fraction(self) -> tuple[float, ...]:
        """Fraction of the windows with a snap-through, per horizon."""
        everything, snapped = (self.errors[group][MODEL].starts for group in (GROUPS[0], GROUPS[2]))
        return tuple(a / b for a, b in zip(snapped, everything, strict=True))

    def to_json(self) -> dict[str, Any]:
        """The report as a JSON object; undefined numbers are null."""
        return {
            "errors": {
                group: {name: _fields(error) for name, error in predictors.items()}
                for group, predictors in self.errors.items()
            },
            "network_without_snap_through_by_data": {name: _fields(error) for name, error in self.by_data.items()},
        }

    def markdown(self) -> list[str]:
        """Tables, line by line."""
        lines = []
        for group, predictors in self.errors.items():
            rows = [
                [name, *_row(error, k)]
                for k in range(len(predictors[MODEL].horizons))
                for name, error in predictors.items()
            ]
            lines += ["", f"### {group.capitalize()}", "", *markdown_table([["predictor", *_COLUMNS], *rows])]
        rows = [[name, *_row(error, k)] for name, error in self.by_data.items() for k in range(len(error.horizons))]
        title = "### The network by data set, no snap-through"
        return [*lines[1:], "", title, "", *markdown_table([["data set", *_COLUMNS], *rows])]


def error_report(
    model: tuple[nnx.GraphDef, nnx.State],
    held_out: Mapping[str, Trajectory],
    config: ModelConfig,
    *,
    horizons: Sequence[int] = HORIZONS,
    stride: int = 10,
) -> ErrorReport:
    """Rolls a network and the floors from every `stride`-th sample of the held-out trajectories of several data sets.

    Args:
        model: network as `(graphdef, weights)`.
        held_out: trajectories by name of the data set, all of the same length.
        config: of the network.
        horizons: steps after which errors are reported; those longer than the trajectories are left out.
        stride: samples between start points.
    """
    data = concatenate(list(held_out.values()))
    horizons = tuple(h for h in horizons if h <= data.gripper_twist.shape[1])
    steps = max(horizons)
    windows = evaluation_windows(data, config, steps=steps, stride=stride)
    snapped = snapping(data, steps=steps, stride=stride, interval=config.interval, length=config.length)
    predictors = {
        MODEL: model,
        "static prior": prior_motion(config, "static"),
        "rigid interpolation": prior_motion(config, "rigid"),
        "no motion": no_motion,
    }
    errors = {name: window_errors(predictor, windows, config) for name, predictor in predictors.items()}
    counts = dict(zip(GROUPS, (np.ones_like(snapped), ~snapped, snapped), strict=True))
    sizes = [len(part.gripper_twist) for part in held_out.values()]
    owner = np.repeat(np.arange(len(sizes)), sizes).repeat(len(snapped) // sum(sizes))
    return ErrorReport(
        errors={
            group: {name: summarise(e, windows, horizons=horizons, count=count) for name, e in errors.items()}
            for group, count in counts.items()
        },
        by_data={
            name: summarise(errors[MODEL], windows, horizons=horizons, count=~snapped & (owner == k)[:, None])
            for k, name in enumerate(held_out)
        },
    )


_COLUMNS = ["steps", "windows", "RMSE [cm]", "mean [cm]", "median [cm]", "90 %", "95 %", "99 %", "RMSE / motion"]


def _row(error: OpenLoopError, k: int) -> list[str]:
    numbers = [getattr(error, f"{name}_cm")[k] for name in ("rmse", "mean", "median", "p90", "p95", "p99")]
    shown = [f"{value:.4f}" if math.isfinite(value) else "" for value in (*numbers, error.relative[k])]
    return [str(error.horizons[k]), str(error.starts[k]), *shown]


def _fields(error: OpenLoopError) -> dict[str, Any]:
    fields = dataclasses.asdict(error) | {"relative": error.relative}
    return {name: [v if math.isfinite(v) else None for v in values] for name, values in fields.items()}
