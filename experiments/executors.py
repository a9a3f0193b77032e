"""Executors for rows of results: this process, several on this machine, or a Dask cluster."""

from __future__ import annotations

import argparse
import concurrent.futures
import contextlib
import multiprocessing
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

from cablejax.dataset.opening import PACKAGES
from cablejax.provenance import package_versions

SECONDS = 20.0
"""How long a scheduler may take to answer, and how often a cluster is asked for its workers."""
_GO_ON = "What was done is kept: run the same command to go on."


class ExecutorError(SystemExit):
    """An executor cannot be used; the message, with which the program ends, says why and what to do."""


def add_option(parser: argparse.ArgumentParser) -> None:
    """Adds `--executor`."""
    parser.add_argument(
        "--executor",
        default="1",
        metavar="N|tcp://HOST:PORT",
        help="processes on this machine (1: this one), or the scheduler of a Dask cluster with the same file system",
    )


@contextlib.contextmanager
def executor_of(text: str) -> Iterator[concurrent.futures.Executor | None]:
    """The executor that `--executor` names; None for this process.

    Raises:
        ExecutorError: it is neither a number nor an address, cannot be reached, has no workers, or a worker lacks the
            experiments or has other versions of the packages.
    """
    if "://" in text:
        with _dask(text) as executor:
            yield executor
        return
    if not text.isascii() or not text.isdecimal() or not 1 <= int(text) <= 1024:
        raise ExecutorError(f"--executor is {text!r}, expected a number of processes or tcp://HOST:PORT.")
    if int(text) == 1:
        yield None
        return
    # forked processes would inherit JAX's threads, and wait for them for ever
    context = multiprocessing.get_context("spawn")
    pool = concurrent.futures.ProcessPoolExecutor(int(text), context, initializer=_ends_with_its_parent)
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _ends_with_its_parent() -> None:
    """Workers of a process that is killed would wait for the next row for ever, with gigabytes of memory each."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


@contextlib.contextmanager
def _dask(address: str) -> Iterator[concurrent.futures.Executor]:
    try:
        from distributed import Client
    except ImportError as error:
        raise ExecutorError("--executor names a Dask cluster: pip install 'cablejax[cluster]'.") from error
    try:
        client = Client(address, timeout=SECONDS, set_as_default=False)
    except (OSError, TimeoutError, ValueError, TypeError, AssertionError) as error:
        # an address without a port fails an assertion, one of another kind has no security settings
        raise ExecutorError(
            f"No Dask scheduler answers at {address} ({str(error) or type(error).__name__}). Start one with "
            "`dask scheduler`, give its address as tcp://HOST:PORT, or give a number of processes."
        ) from error
    with client:
        # a function inside another one travels whole, to workers that may not know this file yet
        def know_the_experiments(path: Sequence[str] = tuple(sys.path)) -> None:
            sys.path.extend(folder for folder in path if folder not in sys.path)

        def versions() -> dict[str, str]:
            from cablejax.dataset.opening import PACKAGES
            from cablejax.provenance import package_versions

            return package_versions(PACKAGES)

        client.register_worker_callbacks(know_the_experiments)
        _check(cast("dict[str, Any]", client.run(versions, on_error="return")), address)
        yield _Opaque(client)


class _Opaque(concurrent.futures.Executor):
    """Sends calls as bytes: a scheduler reads the tasks that it hands on, and need not know this checkout."""

    def __init__(self, client: Any):
        self._client, self._inner = client, client.get_executor(pure=False)

    def abandoned(self) -> bool:
        """Whether the cluster has no workers: it would wait for some for ever."""
        try:
            return not self._client.scheduler_info()["workers"]
        except (OSError, TimeoutError):
            return True

    def submit(self, fn, /, *args, **kwargs):
        import cloudpickle

        def call(task: bytes) -> Any:
            import pickle

            function, arguments, options = pickle.loads(task)
            return function(*arguments, **options)

        return self._inner.submit(call, cloudpickle.dumps((fn, args, kwargs)))


def _check(found: dict[str, Any], address: str) -> None:
    if not found:
        raise ExecutorError(f"The cluster at {address} has no workers: start some with `dask worker {address}`.")
    here = package_versions(PACKAGES)
    for worker, there in found.items():
        if isinstance(there, BaseException):
            raise ExecutorError(
                f"The worker {worker} cannot import cablejax ({there}). Install the same checkout there."
            )
        if other := [f"{name} {there.get(name)}" for name in here if there.get(name) != here[name]]:
            wanted = ", ".join(f"{name} {version}" for name, version in here.items())
            raise ExecutorError(f"The worker {worker} has {', '.join(other)}, expected {wanted}, as here.")


def results(
    executor: concurrent.futures.Executor | None,
    make: Callable[..., Any],
    keys: Sequence[tuple],
    *,
    going: Callable[[], bool] = lambda: True,
) -> Iterator[tuple[tuple, Any]]:
    """Calls `make(*key)` for every key; yields each key with the result, in the order in which they are done.

    Args:
        executor: where; None = here, one after the other.
        make: can be pickled, unless it is called here.
        keys: its arguments.
        going: no other call begins once this is false; those that have begun are waited for.

    Raises:
        ExecutorError: a process ended, or the cluster lost its workers: what was yielded stands. As where a call
            failed, what was done by then is yielded first.
    """
    if executor is None:
        for key in keys:
            if not going():
                return
            yield key, make(*key)
        return
    pending = {executor.submit(make, *key): key for key in keys if going()}
    waiting: set[concurrent.futures.Future] = set(pending)
    try:
        while waiting:
            done, waiting = concurrent.futures.wait(waiting, SECONDS, concurrent.futures.FIRST_COMPLETED)
            if not done and isinstance(executor, _Opaque) and executor.abandoned():
                raise ExecutorError(f"The cluster has no workers any more. {_GO_ON}")
            failed = None
            for future in done:
                try:
                    result = future.result()
                except Exception as error:
                    failed = failed or error
                    continue
                yield pending[future], result
            if failed is not None:
                if lost := _lost(failed):
                    raise ExecutorError(f"{lost} {_GO_ON}") from failed
                raise failed
            if not going():
                waiting = {future for future in waiting if not future.cancel()}
    finally:
        for future in pending:
            future.cancel()


def _lost(error: Exception) -> str | None:
    if isinstance(error, concurrent.futures.BrokenExecutor):
        return "A process ended abruptly, perhaps for want of memory."
    if type(error).__name__ in ("KilledWorker", "FutureCancelledError", "CancelledError", "CommClosedError"):
        return f"The cluster lost the work ({str(error) or type(error).__name__})."
    return None
