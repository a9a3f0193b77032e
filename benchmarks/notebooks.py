"""Executes the notebooks as they are, as many at once as there are processors, and prints how long each takes.

    python benchmarks/notebooks.py             # all of them; exit code 1 above eight minutes in all
    python benchmarks/notebooks.py 01 --keep   # stores the outputs in the notebook

The notebook of a real cable needs its recordings, in $CABLEJAX_DATA, and is left out without them.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import pathlib
import tempfile
import time
from collections.abc import Sequence

import nbformat
from nbclient import NotebookClient

FOLDER = pathlib.Path(__file__).parents[1] / "notebooks"
MOST = 480.0
"""Wall-clock time from the first notebook's start to the last one's end that is asked for [s]."""
RECORDED = "CABLEJAX_DATA"
"""Names the folder of recordings, for the notebooks in whose text it is."""


def chosen(folder: pathlib.Path, names: Sequence[str]) -> tuple[list[pathlib.Path], list[str]]:
    """The notebooks whose names begin with one of these, or all; and the names of those whose recordings are absent."""
    found = [path for path in sorted(folder.glob("*.ipynb")) if path.name.startswith(tuple(names) or "")]
    if not found:
        raise SystemExit(f"notebooks: no notebook in {folder} begins with {', '.join(names)}.")
    absent = [p for p in found if RECORDED in p.read_text(encoding="utf-8") and not os.environ.get(RECORDED)]
    return [path for path in found if path not in absent], [path.stem for path in absent]


async def execute(path: pathlib.Path, free: asyncio.Semaphore, programs: str, *, keep: bool) -> None:
    """Executes a notebook in its own kernel and folder once a processor is free, and prints how long that takes."""
    notebook = nbformat.read(path, as_version=4)
    # notebooks find `experiments/` from their own folder, which this is not
    places = [str(FOLDER.with_name("experiments")), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(places)}
    # one thread for each of the kernels that run at once; they fight for the processors otherwise
    environment.setdefault("NPROC", "1")
    # what one of them has compiled no other compiles again, as on the command line
    environment.setdefault("JAX_COMPILATION_CACHE_DIR", programs)
    async with free:
        began = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            resources = {"metadata": {"path": folder}}
            await NotebookClient(
                notebook, timeout=3600, kernel_name="python3", coalesce_streams=True, resources=resources
            ).async_execute(env=environment)
        print(f"| {path.stem} | {time.monotonic() - began:.0f} |", flush=True)
    if keep:
        for cell in notebook.cells:
            cell.metadata.pop("execution", None)  # the hour of each cell
        nbformat.write(notebook, path)


async def execute_all(paths: Sequence[pathlib.Path], *, keep: bool) -> None:
    """Executes as many notebooks at once as there are processors."""
    free = asyncio.Semaphore(os.cpu_count() or 1)
    with tempfile.TemporaryDirectory() as programs:
        # the long ones are the last, and begin first
        await asyncio.gather(*(execute(path, free, programs, keep=keep) for path in reversed(paths)))


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="beginnings of the names of notebooks; by default all")
    parser.add_argument("--keep", action="store_true", help="store the outputs in the notebooks")
    parser.add_argument("--folder", type=pathlib.Path, default=FOLDER)
    parser.add_argument("--most", type=float, default=MOST, help="seconds that all may take")
    options = parser.parse_args(arguments)
    paths, absent = chosen(options.folder, options.names)
    print("| notebook | wall time [s] |\n| --- | ---: |")
    began = time.monotonic()
    asyncio.run(execute_all(paths, keep=options.keep))
    total = time.monotonic() - began
    left_out = f", without {', '.join(absent)}, which needs ${RECORDED}" if absent else ""
    print(f"\n{total:.0f} s in all{left_out}.")
    return int(total > options.most)


if __name__ == "__main__":
    raise SystemExit(main())
