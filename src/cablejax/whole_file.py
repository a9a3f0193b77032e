"""Writes files whole or not at all, and reserves a folder for one process at a time."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import pathlib
import shutil
import time
import uuid
from collections.abc import Iterator
from typing import BinaryIO

DRAFT = ".part"
"""Ending of a file's name until it is complete."""
# Nobody fills a draft for so long [s].
_ABANDONED = 24 * 3600


def holds_anything(folder: pathlib.Path) -> bool:
    """Whether there is a folder that holds anything except drafts that a killed process left."""
    return folder.is_dir() and any(not file.name.endswith(DRAFT) for file in folder.iterdir())


@contextlib.contextmanager
def naming(path: str | os.PathLike[str]) -> Iterator[None]:
    """Adds the file or folder to an operating system's error: "disk full" does not name it."""
    try:
        yield
    except OSError as error:
        if error.errno and error.filename is None:
            error.filename = os.fspath(path)
        raise


@contextlib.contextmanager
def whole_file(path: pathlib.Path) -> Iterator[BinaryIO]:
    """A stream into a file that takes its place, over what was there, when the block has ended.

    Until then its name ends in `DRAFT`; a block that is left early leaves nothing, and a kill no more than that. Its
    mode is the umask's.

    Raises:
        ValueError: another process is writing the file, or has just done so.
    """
    draft = path.with_name(f"{path.name}{DRAFT}")
    # truncated only once it is known that nobody else writes it
    with naming(path), open(draft, "wb", opener=_not_truncated) as stream:
        _lock(stream.fileno(), path)
        _require_draft(stream.fileno(), draft, path)
        try:
            stream.truncate()
            yield stream
            stream.flush()
            os.replace(draft, path)
        except BaseException:
            draft.unlink(missing_ok=True)
            raise


@contextlib.contextmanager
def draft_folder(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """A new name next to a path, for a folder to be filled and then renamed; what is left of it in the end is removed.

    It is no other's: on a file system that several machines share, their processes may have one number. What a kill
    left of earlier ones is removed once it is a day old.
    """
    if path.parent.is_dir():
        for old in path.parent.iterdir():
            if old.name.startswith(f".{path.name}.") and old.name.endswith(".draft"):
                with contextlib.suppress(FileNotFoundError):
                    if time.time() - old.stat().st_mtime > _ABANDONED:
                        shutil.rmtree(old, ignore_errors=True)
    draft = path.parent / f".{path.name}.{uuid.uuid4().hex}.draft"
    try:
        with naming(path):
            yield draft
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _not_truncated(name: str, _: int) -> int:
    return os.open(name, os.O_WRONLY | os.O_CREAT, 0o666)


@contextlib.contextmanager
def sole_writer(folder: pathlib.Path) -> Iterator[None]:
    """Keeps other processes from writing to an existing folder until the block has ended; a kill frees it too.

    Raises:
        ValueError: another process holds the folder.
    """
    place = os.open(folder, os.O_RDONLY)
    try:
        _lock(place, folder)
        yield
    finally:
        os.close(place)


def _require_draft(place: int, draft: pathlib.Path, path: pathlib.Path) -> None:
    """Refuses a draft that another process has completed between its opening here and its lock."""
    try:
        same = os.path.samestat(os.fstat(place), os.stat(draft))
    except FileNotFoundError:
        same = False
    if not same:
        raise ValueError(f"Another process has just written {path}. Look at it, and begin again if it is not wanted.")


def _lock(place: int, path: pathlib.Path) -> None:
    try:
        fcntl.flock(place, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        # some network file systems know no locks
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            raise ValueError(
                f"Another process is writing to {path}. Wait until it has ended, or give another place; nothing was "
                "changed."
            ) from None
