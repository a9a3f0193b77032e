"""Common parts of the subcommands: their options, the choice of device, the output folder, and tables of results."""

from __future__ import annotations

import abc
import dataclasses
import json as json_format
import pathlib
import sys
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from cablejax.limits import require
from cablejax.whole_file import holds_anything


class UsageError(ValueError):
    """A command line that cannot be carried out: names the value, what was expected and what to do."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Command(abc.ABC):
    """Options of every subcommand.

    Attributes:
        resume_hint: Advice that Ctrl-C prints: how to resume.
        device: Where JAX computes. auto: an accelerator if there is one.
        json: Print the result as one JSON object on stdout, and nothing else there; progress goes to stderr.
    """

    resume_hint: ClassVar[str] = "Run the same command again."
    device: Literal["auto", "cpu", "gpu"] = "auto"
    json: bool = False

    @abc.abstractmethod
    def execute(self) -> tuple[Mapping[str, Any], str]:
        """Does the work. Returns the result as it goes into JSON, and as text for a person."""

    def run(self) -> None:
        """Chooses the device, does the work and prints the result."""
        choose_device(self.device)
        result, text = self.execute()
        print(json_format.dumps(result, indent=2, allow_nan=False) if self.json else text)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SeededCommand(Command):
    """Options of the subcommands that draw random numbers.

    Attributes:
        seed: Seed of everything random; the same seed gives the same result.
    """

    seed: int = 0

    def run(self) -> None:
        """As every command, with a seed that can be one."""
        require(self.seed, "seed", "--seed")
        super().run()


def require_counts(command: Command, *names: str) -> None:
    """Raises ValueError unless options of a command, or all numbers of a list, are whole numbers from 1."""
    for name in names:
        value = getattr(command, name)
        for number in value if isinstance(value, tuple) else (value,):
            require(number, "count", f"--{name}")


def choose_device(device: Literal["auto", "cpu", "gpu"]) -> None:
    """Makes JAX compute on `device`.

    Raises:
        UsageError: if a GPU is asked for and JAX finds none.
    """
    if device == "auto":
        return
    import jax

    if device == "cpu":
        jax.config.update("jax_platforms", "cpu")
        return
    try:
        gpus = jax.devices("gpu")
    except RuntimeError:
        gpus = []
    if not gpus:
        raise UsageError(
            "--device gpu was asked for, but JAX finds no GPU here. Install the package with its CUDA extra "
            "(pip install 'cablejax[cuda]') on a machine with an NVIDIA driver, or use --device cpu."
        )
    jax.config.update("jax_default_device", gpus[0])


def output_folder(path: pathlib.Path, *, overwrite: bool) -> None:
    """Makes a folder for results if it is not there.

    Raises:
        UsageError: if it exists and holds anything, unless `overwrite`; or if it is a file.
    """
    if path.exists() and not path.is_dir():
        raise UsageError(f"--out is {path}, which is a file; expected a folder. Name another one.")
    if holds_anything(path) and not overwrite:
        raise UsageError(f"{path} exists and is not empty. Give another folder with --out, or add --overwrite.")
    path.mkdir(parents=True, exist_ok=True)


def output_file(path: pathlib.Path, *, overwrite: bool) -> pathlib.Path:
    """The path of a file that may be written.

    Raises:
        UsageError: if it exists, unless `overwrite`; or if it is a folder.
    """
    if path.is_dir():
        raise UsageError(f"--out is {path}, which is a folder; expected a file.")
    if path.exists() and not overwrite:
        raise UsageError(f"{path} exists. Give another file with --out, or add --overwrite.")
    return path


def say(message: str) -> None:
    """Prints progress on stderr."""
    print(message, file=sys.stderr, flush=True)


def text_table(header: list[str], rows: list[list[str]]) -> str:
    """Columns aligned for a terminal: the first to the left, the others to the right."""
    widths = [max(len(line[k]) for line in [header, *rows]) for k in range(len(header))]

    def line(cells: list[str]) -> str:
        first, *others = (
            c.ljust(w) if k == 0 else c.rjust(w) for k, (c, w) in enumerate(zip(cells, widths, strict=True))
        )
        return "  ".join([first, *others]).rstrip()

    return "\n".join([line(header), "  ".join("-" * w for w in widths), *(line(row) for row in rows)])
