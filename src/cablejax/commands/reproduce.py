"""Command lines that make something again, as they go into a model card: without local folders."""

from __future__ import annotations

import dataclasses
import pathlib
import shlex
from typing import Any

from cablejax.commands.options import Command
from cablejax.commands.simulate import Simulate
from cablejax.dataset.schema import DatasetConfig


def command_line(command: Command, name: str) -> str:
    """`cablejax NAME` with the options that are not at their defaults; of paths only the last part."""
    words = ["cablejax", name]
    for field in dataclasses.fields(command):
        value = getattr(command, field.name)
        if value != field.default and field.name not in ("json", "device", "overwrite"):
            words += [f"--{field.name.replace('_', '-')}", *_words(value)]
    return shlex.join(words)


def simulate_command(config: DatasetConfig, out: str) -> str:
    """The `cablejax simulate` that makes a data set, or a comment that its options cannot."""
    command = Simulate(
        out=pathlib.Path(out),
        seed=config.seed,
        trajectories=config.n_trajectories,
        steps=config.n_steps,
        start=config.motion.start,
        max_amplification=config.motion.max_amplification,
        engine=config.engine,
        links=config.discretisation.n_links,
        stiffness=config.cable.bending_stiffness,
        friction=config.cable.friction_coefficient,
        stiffness_range=config.randomisation.stiffness,
        damping_range=config.randomisation.damping,
        friction_range=config.randomisation.friction,
    )
    if command.dataset_config() != dataclasses.replace(config, shard_size=DatasetConfig.shard_size):
        return f"# {out}: cablejax.dataset.generate.generate with the configuration recorded in the weights file"
    if command.links == DatasetConfig().discretisation.n_links:
        command = dataclasses.replace(command, links=None)
    return command_line(command, "simulate")


def _words(value: Any) -> list[str]:
    if isinstance(value, tuple):
        return [word for item in value for word in _words(item)]
    if value is True:
        return []
    return [value.name if isinstance(value, pathlib.Path) else f"{value:g}" if isinstance(value, float) else str(value)]
