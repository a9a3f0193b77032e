"""Measures the learned model's open-loop error on held-out trajectories.

The file of the weights lists the data sets that they were trained on, and how many trajectories of each were held out.
The held-out trajectories are read from the stores given, or simulated again: a trajectory depends on its number and
seed alone.

    python experiments/03_model_error.py --out docs/results/model_error.md
    python experiments/03_model_error.py --weights runs/train --data runs/random.zarr runs/straight.zarr runs/free.zarr
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from pathlib import Path

os.environ.setdefault("NPROC", "4")

import numpy as np

from cablejax.dataset.generate import make_engine, simulate
from cablejax.dataset.opening import open_store
from cablejax.dataset.parallel import DeviceParallel
from cablejax.dataset.schema import DatasetConfig, config_from_json
from cablejax.dataset.windows import concatenate, read_trajectories, trajectory_of
from cablejax.dynamics.error_report import MODEL, error_report
from cablejax.dynamics.evaluate import SNAP_FACTOR, SNAP_MARGIN
from cablejax.dynamics.weights import load_info, load_weights
from cablejax.types import Trajectory
from pages import page_of_results, publish

TOGETHER = 8


def simulated(config: DatasetConfig, rows: range) -> Trajectory:
    """Some trajectories of a data set, generated again."""
    # The shard size does not change a trajectory: one each, so that any row can be made alone.
    config = dataclasses.replace(config, shard_size=1)
    engine, parts = make_engine(config), []
    together = engine.width if isinstance(engine, DeviceParallel) else TOGETHER
    for first in range(rows.start, rows.stop, together):
        wanted = range(first, min(first + together, rows.stop))
        blocks = simulate(config, engine, wanted)
        parts += [trajectory_of(config, block, [row]) for row, block in zip(wanted, blocks, strict=True)]
        print(f"{len(parts)} of {len(rows)} simulated", file=sys.stderr, flush=True)
    return concatenate(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", default="gns-reference", help="released name, weights file or training's folder")
    parser.add_argument("--data", nargs="*", default=[], help="the stores that the weights were trained on, in order")
    parser.add_argument("--stride", type=int, default=10, help="samples between start points")
    parser.add_argument("--limit", type=int, help="use at most this many held-out trajectories of each data set")
    parser.add_argument("--out", type=Path, help="write the page there as Markdown")
    options = parser.parse_args()
    config, graphdef, weights = load_weights(options.weights)
    sets = load_info(options.weights)["data"]
    if options.data and len(options.data) != len(sets):
        parser.error(f"--data names {len(options.data)} stores, but the weights were trained on {len(sets)}")

    held_out = {}
    for k, one in enumerate(sets):
        data = config_from_json(DatasetConfig, one["config"])
        count = one["held_out"] if options.limit is None else min(options.limit, one["held_out"])
        rows = range(data.n_trajectories - count, data.n_trajectories)
        if options.data:
            store = open_store(options.data[k])
            if store.info().digest != one["digest"]:
                parser.error(f"{options.data[k]} is not the data set {one['name']} that the weights were trained on")
            held_out[one["name"]] = read_trajectories(store, np.asarray(rows))
        else:
            held_out[one["name"]] = simulated(data, rows)

    report = error_report((graphdef, weights), held_out, config, stride=options.stride)
    horizons = report.errors["all windows"][MODEL].horizons
    snaps = ", ".join(f"{100 * f:.1f} % ({h})" for h, f in zip(horizons, report.snapping_fraction(), strict=True))
    sizes = ", ".join(f"{len(part.gripper_twist)} {name}" for name, part in held_out.items())
    page = page_of_results(
        "Open-loop error of the learned model",
        "`python experiments/03_model_error.py --out docs/results/model_error.md`",
        [
            f"Held-out trajectories: {sizes}; a window starts at every {options.stride}. sample. The model sees "
            f"{config.history} samples and then only the commands. The error of a shape is the root mean square "
            "distance of its keypoints from the simulated ones; the columns are its root mean square, mean, median "
            "and percentiles over windows, and its root mean square divided by that of the cable's movement.",
            "",
            "Predictors: the network; the static prior that it corrects, alone; the rigid interpolation of the "
            "grippers' motion; and no motion.",
            "",
            "A window counts as a snap-through if in one of its steps, or in the two before it, some keypoint of the "
            f"true cable moves further than {SNAP_FACTOR:g} times the weighted motion of both grippers plus "
            f"{100 * SNAP_MARGIN:g} cm. Windows with one, after so many steps: {snaps}.",
            "",
            *report.markdown(),
        ],
    )
    publish(page, options.out)


if __name__ == "__main__":
    main()
