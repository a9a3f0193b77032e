"""Diagnoses blind cases: one verdict file per log, without a look at any label.

python experiments/21_blind_diagnose.py LOG_DIR --out VERDICT_DIR                  # resumable
python experiments/21_blind_diagnose.py LOG_DIR --out VERDICT_DIR --process 0 2    # shares the work

Uses nothing but `cablejax.diagnose.diagnose` as a user would call it on each log alone, without commissioning logs
unless a folder of them is given. A log that is refused gets a file with the message. The labels' hashes are published
before this runs.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import pathlib
import time

os.environ.setdefault("NPROC", "4")

import jax

from cablejax.diagnose import Calibration, DiagnosisError, diagnose, write_verdict
from cablejax.diagnose.planar_run import baseline_error
from cablejax.gaplog import read_gap_log


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=pathlib.Path, help="folder of gap logs")
    parser.add_argument("--out", type=pathlib.Path, required=True, help="folder of the verdicts")
    parser.add_argument("--commissioning", type=pathlib.Path, help="folder of logs without effect, of the same set-up")
    parser.add_argument(
        "--process", type=int, nargs=2, metavar=("I", "N"), default=(0, 1), help="this is process I of N"
    )
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    # Logs of one length share compiled programs, from one process to the next too.
    jax.config.update("jax_compilation_cache_dir", str(options.out / ".compiled"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    paths = sorted(options.logs.glob("*.npz"))[options.process[0] :: options.process[1]]
    calibration = Calibration()
    if options.commissioning:
        logs = [read_gap_log(path) for path in sorted(options.commissioning.glob("*.npz"))]
        calibration = dataclasses.replace(calibration, baseline=baseline_error(logs))
        print(f"baseline error of {len(logs)} commissioning logs: {1e3 * calibration.baseline:.3f} mm", flush=True)
    begin = time.perf_counter()
    for number, path in enumerate(paths, 1):
        verdict = options.out / f"{path.stem}.json"
        if not verdict.exists():
            try:
                write_verdict(verdict, diagnose(read_gap_log(path), calibration=calibration))
            except DiagnosisError as error:
                verdict.write_text(json.dumps({"refused": str(error)}) + "\n")
        print(f"{number}/{len(paths)} {path.stem} {time.perf_counter() - begin:.0f} s", flush=True)


if __name__ == "__main__":
    main()
