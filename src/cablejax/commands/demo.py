"""`cablejax demo`."""

from __future__ import annotations

import dataclasses

from cablejax.commands.options import Command


@dataclasses.dataclass(frozen=True, kw_only=True)
class Demo(Command):
    """To be wired."""
