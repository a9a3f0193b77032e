"""Training state on disk, by Orbax: written atomically, so a kill leaves the previous checkpoint whole."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp

_OVERHEAD = 2**16
"""Bytes that Orbax writes about a state."""


class Checkpoints:
    """The last two training states of one run, under `folder`.

    Restored leaves are arrays of exactly the bits saved. Synchronous: when `save` returns, the state is on disk.
    """

    def __init__(self, folder: Path):
        self._folder = folder
        options = ocp.CheckpointManagerOptions(max_to_keep=2, create=True, enable_async_checkpointing=False)
        self._manager = ocp.CheckpointManager(folder.absolute(), options=options)

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, *_: object) -> None:
        self._manager.close()

    def latest(self) -> int | None:
        """Step of the newest checkpoint, None if there is none."""
        return self._manager.latest_step()

    def save(self, step: int, state: Any) -> None:
        """Writes a pytree of arrays; a step that is already there is left alone.

        Raises:
            OSError: there is no room for it; the states that were there before stay.
        """
        if step != self.latest():
            self._reserve(sum(leaf.nbytes for leaf in jax.tree.leaves(state)))
            self._manager.save(step, args=ocp.args.StandardSave(state))

    def _reserve(self, size: int) -> None:
        """Raises unless there is room for a state: on a full disk Orbax leaves errors of its own threads."""
        with tempfile.TemporaryFile(dir=self._folder.parent) as file:
            try:
                os.posix_fallocate(file.fileno(), 0, max(size + size // 8, 1) + _OVERHEAD)
            except OSError as error:
                if error.errno not in (errno.ENOSPC, errno.EFBIG, errno.EDQUOT):
                    return  # a file system that cannot reserve
                raise OSError(error.errno, os.strerror(error.errno), os.fspath(self._folder)) from None

    def restore(self, like: Any, *, report: Callable[[str], None] = lambda text: None) -> Any:
        """The newest state that can be read; newer ones, which are damaged, are deleted.

        Args:
            like: a pytree that shapes, dtypes and structure are checked against.
            report: called with a line of text on each state that cannot be read.

        Raises:
            ValueError: none can be read.
        """
        abstract = jax.tree.map(ocp.utils.to_shape_dtype_struct, like)
        damaged: list[int] = []
        reason = "there is none"
        for step in sorted(self._manager.all_steps(), reverse=True):
            try:
                state = self._manager.restore(step, args=ocp.args.StandardRestore(abstract))
            except Exception as error:  # Orbax raises what its parts raise, and plain exceptions itself
                damaged.append(step)
                reason = next(iter(str(error).splitlines()), repr(error))
                continue
            for newer in damaged:
                report(f"The checkpoint of step {newer} is damaged; resuming from the one of step {step}.")
                self._manager.delete(newer)
            return state
        raise ValueError(
            f"No checkpoint in {self._folder} can be read ({reason}). Delete this folder to restart the training."
        )
