"""`cablejax train`: a graph network on a data set."""

from __future__ import annotations

import dataclasses
import pathlib
from typing import ClassVar

from cablejax.commands.options import Command, UsageError, say, text_table, write_json


@dataclasses.dataclass(frozen=True, kw_only=True)
class Train(Command):
    """Train a model of the cable's dynamics on a data set made by `cablejax simulate`.

    Writes checkpoints, metrics (CSV and TensorBoard), the trained weights and the error on held-out trajectories. The
    defaults are those of the released model. A training that was interrupted goes on with the same command and ends in
    the very same weights."""

    resume_hint: ClassVar[str] = "The last checkpoint is kept; run the same command again to go on."

    data: pathlib.Path = pathlib.Path("runs/data.zarr")
    """Folder of the data set."""

    out: pathlib.Path = pathlib.Path("runs/train")
    """Folder for what the training writes; one that holds the same training is resumed."""

    held_out: float = 0.05
    """Fraction of the trajectories kept away from training to measure the error on."""

    steps: int | None = None
    """Optimiser steps in all; by default those of the released model. Its phases keep their proportions."""

    batch: int | None = None
    """Windows per optimiser step, in every phase; by default those of the released model."""

    latent: int | None = None
    """Width of every hidden layer and latent vector; by default that of the released model."""

    message_passing: int | None = None
    """Message-passing steps; by default those of the released model."""

    def execute(self):
        from cablejax.dataset.store import open_store
        from cablejax.dataset.windows import read_trajectories, split
        from cablejax.dynamics.evaluate import no_motion, open_loop_error, prior_motion
        from cablejax.dynamics.train import train

        store = open_store(self.data)
        if not store.info().complete:
            raise UsageError(
                f"{self.data} holds {store.info().n_complete} of {store.config.n_trajectories} trajectories. "
                "Complete it first: run the command that began it again."
            )
        config = self._config(store.config.cable.n_keypoints, store.config.cable.length)
        rows = split(store.config.n_trajectories, self.held_out)
        training, validation = (read_trajectories(store, r) for r in rows)
        say(f"{len(rows[0])} trajectories to train on, {len(rows[1])} held out; {config.total_steps} steps")
        result = train(config, training, self.out, validation=validation)
        if not result.completed:
            raise KeyboardInterrupt(
                f"Stopped after step {result.steps} of {config.total_steps}; the checkpoint is in {self.out}. "
                "Run the same command again to go on."
            )
        errors = {
            "model": open_loop_error((result.graphdef, result.weights), validation, result.model),
            "static prior": open_loop_error(prior_motion(result.model, "static"), validation, result.model),
            "rigid interpolation": open_loop_error(prior_motion(result.model, "rigid"), validation, result.model),
            "no motion": open_loop_error(no_motion, validation, result.model),
        }
        summary = {
            "out": str(self.out),
            "steps": result.steps,
            "open_loop_rmse_cm": {
                name: dict(zip(map(str, error.horizons), error.rmse_cm, strict=True)) for name, error in errors.items()
            },
        }
        write_json(self.out / "summary.json", summary)
        horizons = errors["model"].horizons
        table = text_table(
            ["open-loop error [cm] after", *(f"{h} s" for h in horizons)],
            [[name, *(f"{e:.4f}" for e in error.rmse_cm)] for name, error in errors.items()],
        )
        return summary, table

    def _config(self, n_keypoints: int, length: float):
        """The released model's training with what the options change."""
        from cablejax.dynamics.train_config import TrainConfig

        config = TrainConfig(seed=self.seed)
        model = dataclasses.replace(config.model, n_keypoints=n_keypoints, length=length)
        if self.latent is not None:
            model = dataclasses.replace(model, latent=self.latent, hidden=self.latent)
        if self.message_passing is not None:
            model = dataclasses.replace(model, message_passing=self.message_passing)
        phases = config.phases
        if self.steps is not None:
            share = self.steps / config.total_steps
            phases = tuple(dataclasses.replace(p, steps=max(1, round(share * p.steps))) for p in phases)
        if self.batch is not None:
            phases = tuple(dataclasses.replace(p, batch=self.batch) for p in phases)
        return dataclasses.replace(config, model=model, phases=phases)
