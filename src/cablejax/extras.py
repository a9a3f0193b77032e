"""Libraries that only an extra of this package installs."""

from __future__ import annotations

import importlib
from typing import Any


def from_extra(module: str, extra: str, what: str, error: type[ValueError] = ValueError) -> Any:
    """Imports a module that an extra of this package installs.

    Args:
        module: its full name.
        extra: name of the extra.
        what: who needs which library, for the message.
        error: what is raised.

    Raises:
        ValueError: it is not installed; says what needs it and how to install it.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError:
        raise error(f"{what}: pip install 'cablejax[{extra}]'.") from None
