"""Entry point of the command line: `cablejax COMMAND`."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import tyro
from tyro.conf import subcommand

from cablejax import __version__
from cablejax.commands.bench import Bench
from cablejax.commands.cable import CableFile
from cablejax.commands.demo import Demo
from cablejax.commands.diagnose import Diagnose
from cablejax.commands.export import Export
from cablejax.commands.import_recording import Import
from cablejax.commands.options import Command
from cablejax.commands.shape import Shape
from cablejax.commands.simulate import Simulate
from cablejax.commands.study import Study
from cablejax.commands.train import Train
from cablejax.commands.view import View
from cablejax.compiled_programs import keep_compiled_programs
from cablejax.interrupts import INTERRUPTED, answered
from cablejax.whole_file import DRAFT

USER_ERROR = 2
"""Exit code for input that cannot be used."""

_LONGEST = 2000
"""Characters of a message that are printed."""

CLOSED = 141
"""Exit code where the reader of the output has gone, as shells have it."""

_COMMANDS: Any = (
    Annotated[Demo, subcommand("demo")]
    | Annotated[CableFile, subcommand("cable")]
    | Annotated[Simulate, subcommand("simulate")]
    | Annotated[Train, subcommand("train")]
    | Annotated[Shape, subcommand("shape")]
    | Annotated[Import, subcommand("import")]
    | Annotated[Export, subcommand("export")]
    | Annotated[Diagnose, subcommand("diagnose")]
    | Annotated[Study, subcommand("study")]
    | Annotated[View, subcommand("view")]
    | Annotated[Bench, subcommand("bench")]
)
_DESCRIPTION = """Two robot grippers bring a cable to a shape.

Start with `cablejax demo`: it needs nothing else and writes a page to look at. To make your own model: describe your
`cable` in a file, `simulate` a data set, `train` on it, `shape` a cable with the model, and `diagnose` what the
simulator lacks. `study` diagnoses a simulated plant in rounds. `import` reads a recording of a real cable, `view` shows
any file of these commands, and `export` writes it for other programs. `cablejax COMMAND --help` explains each command,
`cablejax --version` prints the version."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command and returns the exit code.

    That is 0, 2 for input that cannot be used, 130 after Ctrl-C, or 141 for a closed pipe.

    Args:
        arguments: what follows `cablejax` on the command line; by default that of this process.
    """
    given = sys.argv[1:] if arguments is None else list(arguments)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal of Latin-1 shows a question mark for what it lacks
            stream.reconfigure(errors="replace")
    try:
        try:
            code = _run(given)
        except KeyboardInterrupt as interrupt:
            print(f"\ncablejax: {interrupt or 'Interrupted.'}", file=sys.stderr)
            code = INTERRUPTED
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        # as `cablejax --help | head` does; what is left to print goes nowhere, or Python would complain at its end
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), sys.stdout.fileno())
        return CLOSED
    if code == INTERRUPTED and arguments is None:
        # what was interrupted may still run in another thread, and Python would wait for it, or crash
        sys.stderr.flush()
        os._exit(code)
    return code


def _run(given: list[str]) -> int:
    if given == ["--version"]:
        print(f"cablejax {__version__}")
        return 0
    command: Command | Bench | Import = tyro.cli(
        _COMMANDS,
        prog="cablejax",
        description=_DESCRIPTION,
        args=given,
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff),
    )
    if not isinstance(command, Bench):  # which times compilations too
        keep_compiled_programs()
    command = command.what if isinstance(command, (Bench, Import)) else command
    hint = f"Interrupted. {command.resume_hint}"
    try:
        if os.environ.get("NPROC") == "2":
            raise ValueError(
                "NPROC is 2, and XLA's pool of two threads can deadlock in batched steps. Set it to 1, or to 4 or "
                "more, or leave it out."
            )
        with answered(hint):
            command.run()
    except BrokenPipeError:
        raise
    except OSError as error:
        where = str(error.filename or "").removesuffix(DRAFT)
        said = f"{where}: {error.strerror}." if where and error.strerror else error.strerror or f"{error}"
    except ValueError as error:
        said = str(error)
    except MemoryError:
        said = "There is not enough memory for this input: give a smaller one."
    except KeyboardInterrupt as interrupt:
        raise KeyboardInterrupt(str(interrupt) or hint) from interrupt
    else:
        return 0
    # the name of a file may be of any length
    print(f"cablejax: {said if len(said) <= _LONGEST else f'{said[:_LONGEST]} ...'}", file=sys.stderr)
    return USER_ERROR
