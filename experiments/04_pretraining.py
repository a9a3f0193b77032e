"""Compares pretrained encoders (as auto-encoders) with end-to-end training, at a small size, on the same data.

python experiments/04_pretraining.py --out docs/results/pretraining.md
python experiments/04_pretraining.py --data runs/random.zarr
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import tempfile
import time
from pathlib import Path

os.environ.setdefault("NPROC", "4")

import numpy as np

from autoencoder import PretrainConfig, pretrain
from cablejax.dataset.generate import generate
from cablejax.dataset.schema import DatasetConfig
from cablejax.dataset.windows import read_trajectories
from cablejax.dynamics.evaluate import OpenLoopError, prior_motion
from cablejax.dynamics.train import train
from cablejax.dynamics.train_config import PRESETS
from cablejax.simulate.motions import MotionConfig
from open_loop import open_loop_error
from pages import markdown_table, page_of_results, publish

TRAIN, HELD_OUT = 100, 10


def row(name: str, error: OpenLoopError) -> list[str]:
    """Median and 95th percentile after every horizon."""
    return [name, *(f"{m:.4f} ({p:.4f})" for m, p in zip(error.median_cm, error.p95_cm, strict=True))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help=f"a data set whose first {TRAIN + HELD_OUT} trajectories are used")
    parser.add_argument("--steps", type=int, default=1_500, help="optimiser steps of training, and of pretraining")
    parser.add_argument("--seeds", type=int, default=2, help="repetitions")
    parser.add_argument("--out", type=Path, help="write the page there as Markdown")
    options = parser.parse_args()
    preset = PRESETS["small"]
    share = options.steps / preset.total_steps
    phases = tuple(dataclasses.replace(p, steps=max(1, round(share * p.steps))) for p in preset.phases)
    lines = []
    with tempfile.TemporaryDirectory() as scratch:
        store = options.data
        if store is None:
            store = Path(scratch) / "data.zarr"
            generate(DatasetConfig(n_trajectories=TRAIN + HELD_OUT, seed=1, motion=MotionConfig(start="random")), store)
        data = read_trajectories(store, np.arange(TRAIN))
        held_out = read_trajectories(store, np.arange(TRAIN, TRAIN + HELD_OUT))
        for seed in range(options.seeds):
            config = dataclasses.replace(preset, phases=phases, seed=seed)
            began = time.perf_counter()
            pretrained = pretrain(config, data, PretrainConfig(steps=options.steps))
            seconds = time.perf_counter() - began
            for name, initial in (("end to end", None), ("pretrained", (pretrained.model, pretrained.weights))):
                result = train(config, data, Path(scratch) / f"{name} {seed}", initial=initial)
                error = open_loop_error((result.graphdef, result.weights), held_out, result.model)
                lines.append(row(f"{name}, seed {seed}", error))
                print(*lines[-1], sep=" | ", flush=True)
            missed = f"{pretrained.node_error:.2%} of node and {pretrained.edge_error:.2%} of edge features"
        lines.append(row("static prior", open_loop_error(prior_motion(result.model, "static"), held_out, result.model)))
    model = preset.model
    page = page_of_results(
        "Pretraining of the encoders",
        "`python experiments/04_pretraining.py --out docs/results/pretraining.md`",
        [
            f"{model.message_passing} message-passing steps of {model.latent}, {options.steps} optimiser steps of "
            f"batch {phases[0].batch} on {TRAIN} trajectories; median (95th percentile) of the open-loop error on "
            f"{HELD_OUT} others [cm]. Pretraining takes the same number of steps first ({seconds:.0f} s); the "
            f"auto-encoders' reconstruction error is then {missed} (root mean square).",
            "",
            *markdown_table([["", *(f"after {h}" for h in error.horizons)], *lines]),
        ],
    )
    publish(page, options.out)


if __name__ == "__main__":
    main()
