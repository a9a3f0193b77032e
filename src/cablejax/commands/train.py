"""`cablejax train`: trains a model on data sets."""

from __future__ import annotations

import dataclasses
import itertools
import json
import pathlib
import shlex
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from cablejax.commands.options import SeededCommand, UsageError, say, text_table
from cablejax.limits import require
from cablejax.text_file import write_json

if TYPE_CHECKING:
    from cablejax.control.cable_inputs import CableInputs
    from cablejax.dataset.store import Store
    from cablejax.dynamics.error_report import ErrorReport
    from cablejax.dynamics.train_config import TrainConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class Train(SeededCommand):
    """Train a model of the cable's dynamics on data sets made by `cablejax simulate`.

    Writes checkpoints, metrics (CSV and TensorBoard), weights.safetensors, a model card, and the error on held-out
    trajectories. The same command resumes an interrupted training, which ends in the same weights. All devices that JAX
    sees share each batch; a training may resume on another number of devices.

    Attributes:
        data: Folders of the data sets, or their places in object storage (s3://BUCKET/PREFIX), in this order.
        out: Folder for the results; a folder that holds the same training is resumed.
        overwrite: Delete another training in the folder, or write next to other files there.
        preset: released: as the released model was trained. small: for comparing variants, some minutes. smoke: a few
            steps.
        prior: The prior that the network corrects. static: the frictionless resting shape. rigid: the grippers' motion,
            interpolated. none: nothing.
        symmetric: Tie the weights so that a mirrored cable, and one whose keypoints are counted from the other end,
            move alike.
        conditioned: Give the network each cable's stiffness and friction as inputs; the data should vary in them.
        start_from: Weights to start from instead of random ones: a released model by name, or a training's folder.
        lr: Learning rate at the beginning; the whole schedule is scaled with it. By default that of the preset.
        held_out: Fraction of each data set that is held out to measure the error.
        buffer: Training trajectories in memory at a time, for data sets larger than memory; by default all. Every 50
            steps one shard replaces another.
        steps: Optimiser steps in all; by default those of the preset. The preset's phases keep their proportions.
        batch: Windows per optimiser step, in every phase; by default those of the preset.
        latent: Width of every hidden layer and latent vector; by default that of the preset.
        message_passing: Message-passing steps; by default those of the preset.
    """

    resume_hint: ClassVar[str] = "The last checkpoint is kept, if one was made; run the same command again to go on."

    data: tuple[pathlib.Path, ...] = (pathlib.Path("runs/data.zarr"),)
    out: pathlib.Path = pathlib.Path("runs/train")
    overwrite: bool = False
    preset: Literal["released", "small", "smoke"] = "released"
    prior: Literal["static", "rigid", "none"] = "static"
    symmetric: bool = False
    conditioned: bool = False
    start_from: str | None = None
    lr: float | None = None
    held_out: float = 0.05
    buffer: int | None = None
    steps: int | None = None
    batch: int | None = None
    latent: int | None = None
    message_passing: int | None = None

    def execute(self):
        """Trains, from a checkpoint where there is one, and reports the open-loop error."""
        from cablejax.control.cable_inputs import inputs_of_data
        from cablejax.dataset.opening import open_store
        from cablejax.dataset.split import known_motions, read_split
        from cablejax.dataset.windows import concatenate
        from cablejax.dynamics.error_report import error_report
        from cablejax.dynamics.fine_tune import starting_from
        from cablejax.dynamics.parallel import training_mesh
        from cablejax.dynamics.train import train
        from cablejax.dynamics.weights import FILE_NAME, load_info, save_weights, weights_path

        if self.steps is not None:
            require(self.steps, "optimiser_steps", "--steps", "Leave it out for those of the preset.")
        if self.lr is not None:
            require(self.lr, "learning_rate", "--lr")
        start = self.start_from
        if start is not None and weights_path(start).resolve().is_relative_to(self.out.resolve()):
            raise UsageError(
                f"--start-from {start} lies in {self.out}, where the training writes its own weights. Name "
                "another folder with --out."
            )
        stores = [open_store(path) for path in self.data]
        self._check_cables(stores)
        asymmetric = sorted({name for store in stores for name in store.config.asymmetric})
        config = self._config(stores[0], flips=not asymmetric)
        if asymmetric and self.symmetric:
            say(
                f"With {', '.join(asymmetric)} a cable moves otherwise in a mirror or counted from its other end, and "
                "a symmetric network learns the mean: leave out --symmetric to learn the difference."
            )
        training_mesh(config)  # refuses a batch that the devices cannot share, before anything is read
        initial = None if start is None else starting_from(start, config.model)
        training, held_out = read_split(stores, self.held_out, buffer=self.buffer, seed=self.seed)
        inputs = inputs_of_data(stores, self.held_out) if self.conditioned else None
        if inputs and all(low == high for low, high in inputs.limits):
            say(
                "All cables of the data are equally stiff and rough, so a conditioned network learns nothing of its "
                "inputs: simulate with --stiffness-range or --friction-range, or leave --conditioned out."
            )
        if inputs and start is not None:
            inputs = inputs.also_of(start)
        counts = [len(part.gripper_twist) for part in held_out]
        total = sum(store.config.n_trajectories for store in stores) - sum(counts)
        say(f"{total} trajectories to train on, {sum(counts)} held out; {config.total_steps} steps")
        for sentence in known_motions(stores, counts, [] if start is None else load_info(start).get("data") or []):
            say(f"{sentence} Simulate with another --seed.")
        result = train(
            config, training, self.out, validation=concatenate(held_out), initial=initial, overwrite=self.overwrite
        )
        if not result.completed:
            kept = f"; the checkpoint is in {self.out}" if result.steps else ", and nothing is lost"
            raise KeyboardInterrupt(
                f"Stopped after step {result.steps} of {config.total_steps}{kept}. Run the same command again to go on."
            )
        info = self._info(config, stores, counts, inputs)
        save_weights(self.out / FILE_NAME, result.model, result.weights, info)
        say("measuring the error on the held-out trajectories ...")
        names = [data["name"] for data in info["data"]]
        report = error_report((result.graphdef, result.weights), dict(zip(names, held_out, strict=True)), result.model)
        self._write_card(result.model, info, stores, report)
        summary = {"out": str(self.out), "steps": result.steps, **report.to_json()}
        write_json(self.out / "summary.json", summary)
        errors = report.errors["all windows"]
        table = text_table(
            ["open-loop error [cm] after", *(f"{h * result.model.interval:g} s" for h in errors["network"].horizons)],
            [
                [f"{name}, {kind}", *(f"{e:.4f}" for e in getattr(error, f"{kind}_cm"))]
                for kind in ("median", "rmse")
                for name, error in errors.items()
            ],
        )
        return summary, f"{table}\n\nThe weights are in {self.out / FILE_NAME}; read {self.out / 'card.md'}"

    def _check_cables(self, stores: list[Store]) -> None:
        """Refuses data sets of different cables, and keypoints that the network cannot have."""
        from cablejax.cable import differing
        from cablejax.cable_file import KEYS
        from cablejax.dynamics.weights import cable_of_weights

        def fields(other: dict[str, tuple[Any, Any]]) -> str:
            return ", ".join(f"{KEYS[name]} is {a} and {b}" for name, (a, b) in other.items())

        if not stores:
            raise UsageError("--data names no data set, expected at least one.")
        places = [path.resolve() for path in self.data]
        for path, place in zip(self.data, places, strict=True):
            if places.count(place) > 1:
                raise UsageError(f"--data names {path} twice: its trajectories would count twice. Name it once.")
        first = stores[0]
        if first.config.cable.marks is not None:
            raise UsageError(
                f"{first.path} has keypoints at given arc lengths, but a network is trained on evenly spaced ones. "
                "Simulate a cable with `keypoints = N` in place of keypoint_arclength_m."
            )
        for store in stores:
            if outside := store.config.untrainable:
                raise UsageError(
                    f"{store.path} has {', '.join(outside)}. A model is of the cable itself: it takes the keypoints as "
                    "points of the cable and every command as executed exactly, and a controller measures the poses "
                    "that the grippers reach. Simulate without effects of the camera and of the arms."
                )
        for store in stores[1:]:
            if other := differing(store.config.cable, first.config.cable):
                raise UsageError(
                    f"{store.path} and {first.path} are of different cables: {fields(other)}. Train on data of one "
                    "nominal cable; to vary it, give `cablejax simulate` ranges such as --stiffness-range."
                )

        if self.start_from is not None and (other := differing(cable_of_weights(self.start_from), first.config.cable)):
            say(f"{self.start_from} and {first.path} are of different cables: {fields(other)}.")

    def _config(self, store: Store, *, flips: bool) -> TrainConfig:
        """The preset's training with what the data and the options change."""
        from cablejax.dynamics.train_config import PRESETS

        config, cable = PRESETS[self.preset], store.config.cable
        model = dataclasses.replace(
            config.model,
            prior=self.prior,
            symmetric=self.symmetric,
            conditioned=self.conditioned,
            n_keypoints=cable.n_keypoints,
            length=cable.length,
            radius=config.model.radius * (cable.length / (cable.n_keypoints - 1) / config.model.spacing),
            interval=store.config.interval,
        )
        if self.latent is not None:
            model = dataclasses.replace(model, latent=self.latent, hidden=self.latent)
        if self.message_passing is not None:
            model = dataclasses.replace(model, message_passing=self.message_passing)
        phases = config.phases
        if self.steps is not None:
            share = self.steps / config.total_steps
            # of each phase the same share, and together as many as asked for: the shortest training has one phase
            ends = [round(share * end) for end in itertools.accumulate((p.steps for p in phases), initial=0)]
            counts = [after - before for before, after in itertools.pairwise(ends)]
            pairs = zip(phases, counts, strict=True)
            phases = tuple(dataclasses.replace(p, steps=count) for p, count in pairs if count)
            config = dataclasses.replace(config, warmup=min(config.warmup, round(share * config.warmup)))
        if self.lr is not None:
            share = self.lr / phases[0].lr_start
            phases = tuple(dataclasses.replace(p, lr_start=share * p.lr_start, lr_end=share * p.lr_end) for p in phases)
        if self.batch is not None:
            phases = tuple(dataclasses.replace(p, batch=self.batch) for p in phases)
        return dataclasses.replace(config, seed=self.seed, model=model, phases=phases, flips=flips)

    def _info(
        self, config: TrainConfig, stores: list[Store], held_out: list[int], inputs: CableInputs | None
    ) -> dict[str, Any]:
        """Provenance of the weights, without local paths."""
        from cablejax.cable_file import cable_to_fields
        from cablejax.dataset.schema import config_to_json
        from cablejax.dynamics.weights import fingerprint, load_weights
        from cablejax.provenance import machine, versions

        start = self.start_from
        training = json.loads(json.dumps(dataclasses.asdict(config)))
        del training["model"]  # the weights file has it, with the normalisation
        return {
            "cable": cable_to_fields(stores[0].config.cable),
            # what the model may believe of a cable
            **({} if inputs is None else {"inputs": dataclasses.asdict(inputs)}),
            **(
                {}
                if start is None
                else {"start_from": pathlib.Path(start).name, "start_weights": fingerprint(load_weights(start)[2])}
            ),
            "effects": list(dict.fromkeys(effect for store in stores for effect in store.config.effects_shown)),
            "data": [
                {
                    "name": name,
                    "digest": store.info().digest,
                    "config": config_to_json(store.config),
                    "versions": store.versions,
                    "held_out": count,
                }
                for name, store, count in zip(_names(stores), stores, held_out, strict=True)
            ],
            "training": training,
            "versions": versions(),
            "machine": machine(),
        }

    def _write_card(self, model, info: dict[str, Any], stores: list[Store], report: ErrorReport) -> None:
        from cablejax.cable import Cable
        from cablejax.commands.reproduce import command_line, simulate_command
        from cablejax.dynamics.card import write_card

        name = self.out.resolve().name
        ends = [".zarr" if store.path.name.endswith(".zarr") else "" for store in stores]
        data = [f"{stem}{end}" for stem, end in zip(_names(stores), ends, strict=True)]
        training = dataclasses.replace(self, data=tuple(map(pathlib.Path, data)))
        write_card(
            self.out / "card.md",
            name=name,
            config=model,
            info=info,
            metrics=self.out / "metrics.csv",
            report=report,
            commands=[
                *(
                    [shlex.join(["cablejax", "cable", "--from", name, "--out", "cable.toml"])]
                    if stores[0].config.cable != Cable()
                    else []
                ),
                *(simulate_command(store.config, place) for store, place in zip(stores, data, strict=True)),
                command_line(training, "train"),
            ],
        )


def _names(stores: list[Store]) -> list[str]:
    """Of the data sets: the last part of each place, with a number where two have the same."""
    stems = [store.path.name.removesuffix(".zarr") for store in stores]
    names: list[str] = []
    for stem in stems:
        numbered = (name for k in itertools.count(1) if (name := f"{stem} {k}") not in (*stems, *names))
        names.append(stem if stems.count(stem) == 1 else next(numbered))
    return names
