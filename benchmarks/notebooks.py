"""Executes the notebooks as they are, and prints how long each takes.

    python benchmarks/notebooks.py             # all of them; exit code 1 above eight minutes together
    python benchmarks/notebooks.py 01 --keep   # stores the outputs in the notebook

The notebook of a real cable needs its recordings, in $CABLEJAX_DATA, and is left out without them.
"""

from __future__ import annotations

import argparse
import os
import pathlib
import resource
import tempfile
import time
from collections.abc import Sequence

import nbformat
from nbclient import NotebookClient

FOLDER = pathlib.Path(__file__).parents[1] / "notebooks"
MOST = 480.0
"""Wall-clock time of all notebooks together that is asked for [s]."""
RECORDED = "CABLEJAX_DATA"
"""Names the folder of recordings, for the notebooks in whose text it is."""


def chosen(folder: pathlib.Path, names: Sequence[str]) -> tuple[list[pathlib.Path], list[str]]:
    """The notebooks whose names begin with one of these, or all; and the names of those whose recordings are absent."""
    found = [path for path in sorted(folder.glob("*.ipynb")) if path.name.startswith(tuple(names) or "")]
    if not found:
        raise SystemExit(f"notebooks: no notebook in {folder} begins with {', '.join(names)}.")
    absent = [p for p in found if RECORDED in p.read_text(encoding="utf-8") and not os.environ.get(RECORDED)]
    return [path for path in found if path not in absent], [path.stem for path in absent]


def execute(path: pathlib.Path, *, keep: bool) -> tuple[float, float]:
    """Wall-clock and processor time [s] of a notebook, in a kernel and a folder of its own."""
    notebook = nbformat.read(path, as_version=4)
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    # notebooks find `experiments/` from their own folder, which this is not
    places = [str(FOLDER.with_name("experiments")), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(places)}
    with tempfile.TemporaryDirectory() as folder:
        resources = {"metadata": {"path": folder}}
        NotebookClient(
            notebook, timeout=3600, kernel_name="python3", coalesce_streams=True, resources=resources
        ).execute(env=environment)
    wall, after = time.monotonic() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if keep:
        for cell in notebook.cells:
            cell.metadata.pop("execution", None)  # the hour of each cell
        nbformat.write(notebook, path)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="beginnings of the names of notebooks; by default all")
    parser.add_argument("--keep", action="store_true", help="store the outputs in the notebooks")
    parser.add_argument("--folder", type=pathlib.Path, default=FOLDER)
    parser.add_argument("--most", type=float, default=MOST, help="seconds that all may take together")
    options = parser.parse_args(arguments)
    (paths, absent), total = chosen(options.folder, options.names), 0.0
    print("| notebook | wall time [s] | processor time [s] |\n| --- | ---: | ---: |")
    for path in paths:
        wall, processor = execute(path, keep=options.keep)
        total += wall
        print(f"| {path.stem} | {wall:.0f} | {processor:.0f} |", flush=True)
    left_out = f", without {', '.join(absent)}, which needs ${RECORDED}" if absent else ""
    print(f"\n{total:.0f} s together{left_out}.")
    return int(total > options.most)


if __name__ == "__main__":
    raise SystemExit(main())
