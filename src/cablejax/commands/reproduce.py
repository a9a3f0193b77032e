"""Command lines that reproduce an artefact, for model cards: without local folders."""

from __future__ import annotations

import dataclasses
import pathlib
import shlex
from typing import Any

from cablejax.cable import Cable
from cablejax.commands.options import Command
from cablejax.commands.simulate import Simulate
from cablejax.dataset.schema import DatasetConfig
from cablejax.effects.given import number_text
from cablejax.simulate import ENGINES

_NAMES_OR_FOLDERS = ("start_from", "weights")
REPEATED = ("effect", "with_", "plant_effect")
"""Options that are given once for each of their values."""


def command_line(command: Command, name: str) -> str:
    """`cablejax NAME` with the options that are not at their defaults; of paths only the last part."""
    words = ["cablejax", name]
    for field in dataclasses.fields(command):
        value = getattr(command, field.name)
        if value == field.default or field.name in ("json", "device", "overwrite"):
            continue
        option = f"--{field.name.strip('_').replace('_', '-')}"
        items = value if isinstance(value, tuple) else (value,)
        for together in [(item,) for item in items] if field.name in REPEATED else [items]:
            words += [option, *(word for item in together for word in _words(item))]
        if field.name in _NAMES_OR_FOLDERS:
            words[-1] = pathlib.Path(words[-1]).name
    return shlex.join(words)


def simulate_command(config: DatasetConfig, out: str) -> str:
    """The `cablejax simulate` that makes a data set, or a comment that its options cannot.

    A cable other than the reference is expected in `cable.toml`.
    """
    command = Simulate(
        out=pathlib.Path(out),
        seed=config.seed,
        trajectories=config.n_trajectories,
        steps=config.n_steps,
        start=config.motion.start,
        max_amplification=config.motion.max_amplification,
        engine=config.engine,
        cable=None if config.cable == Cable() else pathlib.Path("cable.toml"),
        effect=tuple(map(str, config.effects)),
        links=config.discretisation.n_links,
        timestep=config.discretisation.timestep,
        stiffness_range=config.randomisation.stiffness,
        damping_range=config.randomisation.damping,
        friction_range=config.randomisation.friction,
    )
    if command.config_of(config.cable, config.effects) != dataclasses.replace(
        config, shard_size=DatasetConfig.shard_size
    ):
        return f"# {out}: cablejax.dataset.generate.generate with the configuration recorded in the weights file"
    if command.links == DatasetConfig().discretisation.n_links:
        command = dataclasses.replace(command, links=None)
    if command.timestep == ENGINES[config.engine].data_timestep:
        command = dataclasses.replace(command, timestep=None)
    return command_line(command, "simulate")


def _words(value: Any) -> list[str]:
    if value is True:
        return []
    if isinstance(value, float):
        return [number_text(value)]
    return [value.name if isinstance(value, pathlib.Path) else str(value)]
