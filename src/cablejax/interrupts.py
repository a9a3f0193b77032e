"""Answers Ctrl-C at once, even while compiled code runs.

Python handles a signal between two of its own instructions, and a compilation or a rollout is a single one. Every file
of this package is written whole or not at all, so that the process may end at any instant.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""

GRACE, SAVING = 1.5, 30.0
"""Seconds from Ctrl-C to the end of the process, and those while a state is saved."""

_T = TypeVar("_T")
_saving = threading.Event()


@contextlib.contextmanager
def answered(message: str) -> Iterator[None]:
    """Ends the process `GRACE` seconds after Ctrl-C, unless the block has been left by then.

    Args:
        message: what the process prints in that case.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    listening, signalled = os.pipe()
    os.set_blocking(signalled, False)
    left = threading.Event()

    def watch() -> None:
        while number := os.read(listening, 1):
            if number[0] == signal.SIGINT and not left.wait(GRACE):
                deadline = time.monotonic() + SAVING
                while _saving.is_set() and time.monotonic() < deadline:
                    time.sleep(0.05)
                if not left.wait(0.1):
                    os.write(2, f"\ncablejax: {message}\n".encode())
                    os._exit(INTERRUPTED)

    def unraisable(found: Any) -> None:
        # Ctrl-C within a callback of the garbage collector is lost there, with a traceback: the watcher answers it
        if not issubclass(found.exc_type, KeyboardInterrupt):
            hook(found)

    before, hook = signal.set_wakeup_fd(signalled, warn_on_full_buffer=False), sys.unraisablehook
    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    sys.unraisablehook = unraisable
    try:
        yield
    finally:
        sys.unraisablehook = hook
        left.set()
        signal.set_wakeup_fd(before)
        os.close(signalled)
        watcher.join()
        os.close(listening)


def unless(event: threading.Event, compute: Callable[[], _T]) -> _T | None:
    """The result of a computation, or None as soon as an event is set, which abandons it.

    Args:
        event: that ends the wait.
        compute: called in another thread, since it may be one long call of compiled code.
    """
    results: list[_T] = []
    errors: list[BaseException] = []

    def run() -> None:
        try:
            results.append(compute())
        except BaseException as error:  # raised again below
            errors.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    while thread.is_alive() and not event.is_set():
        thread.join(0.05)
    if errors:
        raise errors[0]
    return results[0] if results else None


@contextlib.contextmanager
def interrupt_flag() -> Iterator[threading.Event]:
    """An event that Ctrl-C or SIGTERM sets, once; a second Ctrl-C ends the program at once."""
    flag = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield flag
        return
    before = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)}

    def handle(number, frame):
        flag.set()
        signal.signal(number, before[number])

    for s in before:
        signal.signal(s, handle)
    try:
        yield flag
    finally:
        for s, handler in before.items():
            signal.signal(s, handler)


@contextlib.contextmanager
def ended_by_sigterm() -> Iterator[None]:
    """SIGTERM leaves the block by SystemExit, as Ctrl-C leaves it by KeyboardInterrupt, so that it ends in order."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def leave(number, frame):
        raise SystemExit(128 + number)  # as shells have it

    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def saving() -> Iterator[None]:
    """Gives the block `SAVING` seconds after Ctrl-C."""
    _saving.set()
    try:
        yield
    finally:
        _saving.clear()
