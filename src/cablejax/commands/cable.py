"""`cablejax cable`: writes a cable file to edit, or the cable inside a data set, trained weights or a log."""

from __future__ import annotations

import dataclasses
import math
import pathlib
import shlex
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, get_args

import tyro

from cablejax.commands.artefacts import kind_of
from cablejax.commands.export import recorded
from cablejax.commands.options import Command, output_file, say
from cablejax.limits import shown

if TYPE_CHECKING:
    from cablejax.cable import Cable


@dataclasses.dataclass(frozen=True, kw_only=True)
class CableFile(Command):
    """Write a cable file to edit: the reference cable, or the cable inside a data set, trained weights or a log.

    `simulate` and `shape` take the file as `--cable`. Data sets, weights and logs keep the cable that they were made
    with.

    Attributes:
        out: The file to write, for example cable.toml; by default the text is only printed.
        from_: A data set, trained weights (a file, a folder, or a released model by name), a log, or another cable
            file. By default the reference cable.
        overwrite: Replace a file that is there.
    """

    out: pathlib.Path | None = None
    from_: Annotated[str | None, tyro.conf.arg(name="from")] = None
    overwrite: bool = False

    def execute(self):
        """Writes a cable file, or prints it where no --out is given."""
        from cablejax.cable_file import cable_text, cable_to_fields, write_cable

        cable = find_cable(self.from_)
        if self.out is None:
            return cable_to_fields(cable), cable_text(cable).rstrip()
        output_file(self.out, overwrite=self.overwrite).parent.mkdir(parents=True, exist_ok=True)
        write_cable(self.out, cable)
        text = f"The cable is in {self.out}. Edit it, then: cablejax simulate --cable {shlex.quote(str(self.out))}"
        return {"out": str(self.out), **cable_to_fields(cable)}, text


def find_cable(source: str | pathlib.Path | None) -> Cable:
    """The cable in a cable file, a gap log, a data set's folder, trained weights, or a run's folder with its log.

    That of None is the reference cable.

    Raises:
        ValueError: there is no such thing, or it cannot be read.
    """
    from cablejax.cable import Cable

    if source is None:
        return Cable()
    kind, path = kind_of(source)
    if kind == "cable":
        from cablejax.cable_file import read_cable

        return read_cable(path)
    if kind == "verdict" and (stated := cable_of_verdict(path)) is not None:
        return stated
    if kind == "store":
        from cablejax.dataset.opening import open_store

        return open_store(path).config.cable
    if kind == "weights":
        from cablejax.dynamics.weights import cable_of_weights

        return cable_of_weights(path)
    from cablejax.cable_file import cable_of_log

    log = recorded(pathlib.Path(source))[0]
    try:
        return cable_of_log(log)
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None


def cable_of_verdict(path: pathlib.Path) -> Cable | None:
    """The cable of a verdict's log; None if the verdict does not state it.

    Raises:
        ValueError: it is no verdict, or its cable is none.
    """
    from cablejax.cable_file import cable_from_fields
    from cablejax.effects.verdicts import read_verdict_json

    stated = read_verdict_json(path).get("cable")
    return None if stated is None else cable_from_fields(stated, f"{path}: cable")


def check_verdicts(paths: Sequence[pathlib.Path], cable: Cable, remedy: str) -> None:
    """Checks that verdicts are on this cable, to which their effects are added.

    Prints a warning if an effect is named alongside an unknown cause.

    Raises:
        ValueError: one is of another cable, or no verdict; says how the two differ, and `remedy`.
    """
    from cablejax.cable_file import NUMBERS
    from cablejax.diagnose.belief import BESIDE_UNKNOWN
    from cablejax.diagnose.diagnosis import Verdict
    from cablejax.effects.verdicts import read_verdict_json

    for path in paths:
        word = read_verdict_json(path).get("verdict")
        if word not in get_args(Verdict):
            raise ValueError(f"{path}: verdict is {shown(word)}, expected {', '.join(get_args(Verdict))}.")
        if word == "named+unknown":
            say(
                f"{path} names an effect together with an unknown cause; about {100 * BESIDE_UNKNOWN:.0f} % of such "
                "effects are causes. The effect is added nevertheless."
            )
        if (theirs := cable_of_verdict(path)) is None:
            continue
        pairs = {key: (getattr(theirs, name), getattr(cable, name)) for key, (name, _) in NUMBERS.items()}
        off = [f"{key} = {a:g}, not {b:g}" for key, (a, b) in pairs.items() if not math.isclose(a, b, rel_tol=1e-4)]
        if off:
            raise ValueError(f"{path} is the verdict on another cable than this one ({', '.join(off)}). {remedy}")
