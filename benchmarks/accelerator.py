"""Measures simulation, data generation, training and control on one accelerator and writes one Markdown page.

python benchmarks/accelerator.py --out docs/results/accelerator.md          # stops measuring after `--minutes`
python benchmarks/accelerator.py --small --out runs/accelerator.md          # some minutes on a CPU
python benchmarks/accelerator.py --only rollout precision --out runs/accelerator.md

Finished measurements are kept as JSON lines next to the page (`--records`); the same command measures what is missing.
A record counts for the device, processor, package versions and sizes it was made with. Compiling takes most of the
time: set JAX_COMPILATION_CACHE_DIR to a folder, and a second run does not compile again.
"""

from __future__ import annotations

import os

os.environ.setdefault("NPROC", "4")

import argparse
import concurrent.futures
import dataclasses
import datetime
import json
import pathlib
import sys
import time
from typing import Any

import jax

# Tables are written as the experiments write theirs.
sys.path.append(str(pathlib.Path(__file__).resolve().parents[1] / "experiments"))

from accelerator_page import page
from accelerator_sections import SECTIONS, WAVES, Case, Prepared, Sizes, timed
from energy import EnergyMeter

from cablejax.commands.options import say
from cablejax.commands.workloads import seconds_in_turns, setting
from cablejax.provenance import versions


@dataclasses.dataclass(frozen=True)
class Records:
    """The measurements of one setting in a JSON-lines file, appended one by one.

    Attributes:
        path: the file.
        setting: device, processor, versions and sizes; records of another setting are left alone.
    """

    path: pathlib.Path
    setting: dict[str, str]

    def read(self) -> dict[str, dict[str, Any]]:
        """Measurements by the name of their case. A line that a kill cut short does not count."""
        found: dict[str, dict[str, Any]] = {}
        if self.path.is_file():
            for line in self.path.read_text(encoding="utf-8").splitlines():
                try:
                    record = json.loads(line)
                except ValueError:
                    continue
                if record["setting"] == self.setting:
                    found[record["case"]] = record
        return found

    def append(self, record: dict[str, Any]) -> None:
        """Adds one measurement, on a line of its own even after a line that was cut short."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a+b") as file:
            if file.tell():
                file.seek(-1, os.SEEK_END)
                if file.read() != b"\n":
                    file.write(b"\n")
            file.write(json.dumps({"setting": self.setting, **record}).encode() + b"\n")


def measure(cases: list[Case], records: Records, sizes: Sizes, deadline: float) -> None:
    """Prepares all cases side by side, since compiling takes the longest, then times one after the other."""
    meter = EnergyMeter()
    say(f"preparing {len(cases)} measurements ...")
    pool = concurrent.futures.ThreadPoolExecutor(os.cpu_count())
    prepared = [pool.submit(timed, case.prepare) for case in cases]
    # Timing begins when nothing compiles any more, which would disturb it.
    concurrent.futures.wait(prepared, timeout=max(deadline - time.monotonic(), 0.0))
    pool.shutdown(wait=False, cancel_futures=True)
    for case in cases:
        if time.monotonic() > deadline:
            return
        say(f"{case.name} ...")
        record = {"case": case.name, "section": case.section, **case.labels, "date": f"{datetime.date.today()}"}
        try:
            # Taken out of the list, so that its arrays are gone before the next one runs.
            records.append(record | measured(*prepared.pop(0).result(), meter, sizes))
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error):
                raise
            records.append(record | {"failure": "out of memory"})


def measured(prepared: Prepared, prepare_s: float, meter: EnergyMeter, sizes: Sizes) -> dict[str, Any]:
    """The figures of one measurement, as they stand in the records."""
    before = meter.joules()
    turns = seconds_in_turns({"": prepared.run}, sizes.rounds, least=sizes.least_seconds, most=sizes.most_seconds)
    after, seconds = meter.joules(), turns[""]
    return {
        "prepare_s": prepare_s,
        "work": prepared.work,
        "seconds": seconds,
        # The call that does not count in the seconds is in the energy.
        "joules": None if before is None or after is None else (after - before) / (len(seconds) + 1),
        "bytes": prepared.bytes,
        **prepared.details(),
    }


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("docs/results/accelerator.md"))
    parser.add_argument("--records", type=pathlib.Path, help="finished measurements; by default --out as .jsonl")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS), help="sections to measure")
    parser.add_argument("--small", action="store_true", help="sizes for a CPU")
    parser.add_argument("--minutes", type=float, default=9.5, help="after which no measurement is begun")
    options = parser.parse_args(arguments)
    deadline = time.monotonic() + 60 * options.minutes
    sizes = Sizes.small() if options.small else Sizes()
    made_with = {**setting(), "versions": versions(), "sizes": "small" if options.small else "full"}
    records = Records(options.records or options.out.with_suffix(".jsonl"), made_with)
    for wave in WAVES:
        cases = [case for name in wave if name in options.only for case in SECTIONS[name](sizes)]
        todo = [case for case in cases if case.name not in records.read()]
        if todo and time.monotonic() < deadline:
            measure(todo, records, sizes, deadline)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(page(list(records.read().values()), records.setting), encoding="utf-8")
    print(f"Written to {options.out}", file=sys.stderr)


if __name__ == "__main__":
    main()
