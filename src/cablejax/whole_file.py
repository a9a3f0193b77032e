"""Files that are written whole or not at all."""

from __future__ import annotations

import contextlib
import os
import pathlib
from collections.abc import Iterator
from typing import BinaryIO

DRAFT = ".part"
"""Ending of a file's name until it is complete."""


@contextlib.contextmanager
def whole_file(path: pathlib.Path) -> Iterator[BinaryIO]:
    """A stream into a file that takes its place, over what was there, when the block has ended.

    Until then its name ends in `DRAFT`; a block that is left early leaves nothing, and a kill no more than that. Its
    mode is the umask's.
    """
    draft = path.with_name(f"{path.name}{DRAFT}")
    try:
        with draft.open("wb") as stream:
            yield stream
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)
