"""Diagnoses blind cases, one row per log, without reading any label.

python experiments/21_blind_diagnose.py LOG_DIR --out VERDICTS.jsonl                  # resumable
python experiments/21_blind_diagnose.py LOG_DIR --out VERDICTS.jsonl --executor 2     # in two processes, or tcp://...

Calls only `cablejax.diagnose.diagnose`, as a user would, on each log alone, without commissioning logs
unless a folder of them is given; the verdict is then called `verdict_commissioned`. A log that is refused gets a row
with the message and no verdict. The labels' hashes are published before this runs.
"""

from __future__ import annotations

import argparse
import functools
import os
import pathlib
from typing import Any

os.environ.setdefault("NPROC", "4")

import jax

from cablejax.diagnose import Calibration, DiagnosisError, diagnose, verdict_json
from cablejax.diagnose.planar_run import baseline_error
from cablejax.gaplog import read_gap_log
from executors import add_option, executor_of
from rows import Rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=pathlib.Path, help="folder of gap logs")
    parser.add_argument("--out", type=pathlib.Path, required=True, help="file of the verdicts")
    parser.add_argument("--commissioning", type=pathlib.Path, help="folder of logs without effect, of the same set-up")
    add_option(parser)
    options = parser.parse_args()
    compiled, calibration, field = options.out.with_suffix(".compiled").absolute(), None, "verdict"
    keep_programs(compiled)
    if options.commissioning:
        logs = [read_gap_log(path) for path in sorted(options.commissioning.glob("*.npz"))]
        calibration = Calibration(baseline=baseline_error(logs))
        field = "verdict_commissioned"
        print(f"baseline error of {len(logs)} commissioning logs: {1e3 * calibration.baseline:.3f} mm", flush=True)

    rows, names = Rows(options.out, ("name",)), sorted(path.stem for path in options.logs.glob("*.npz"))
    make = functools.partial(diagnosed, options.logs.absolute(), compiled, calibration, field)
    with executor_of(options.executor) as executor:
        rows.run(rows.missing([(name,) for name in names]), make, executor=executor)


def keep_programs(folder: pathlib.Path) -> None:
    """Logs of one length share compiled programs, from one process to the next too."""
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)


def diagnosed(
    logs: pathlib.Path, compiled: pathlib.Path, calibration: Calibration | None, field: str, name: str
) -> dict[str, Any]:
    """The row of one log."""
    keep_programs(compiled)
    try:
        return {field: verdict_json(diagnose(read_gap_log(logs / f"{name}.npz"), calibration=calibration))}
    except DiagnosisError as error:
        return {"refused": str(error)}


if __name__ == "__main__":
    main()
