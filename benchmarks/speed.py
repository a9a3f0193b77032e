"""Runs the benchmarks of the command line and writes their numbers as one Markdown page.

python benchmarks/speed.py --out docs/results/speed.md
"""

from __future__ import annotations

import argparse
import json
import pathlib
import subprocess
import sys


def measure(*words: str) -> dict:
    """The JSON result of one `cablejax` command."""
    run = subprocess.run([sys.executable, "-m", "cablejax", *words, "--json"], stdout=subprocess.PIPE, check=True)
    return json.loads(run.stdout)


def waiting(start: dict) -> list[str]:
    """The section about what one waits for."""
    verdict = f"a verdict, median of {len(start['verdict']['logs'])} logs"
    rows = [("`import cablejax`", start["import"]), ("`cablejax --help`", start["help"])]
    for name, part in (("first control call", start["control"]), (verdict, start["verdict"])):
        rows += [(f"{name}, first run", part["empty"]), (f"{name}, later run", part["filled"])]
    return [
        "## Start-up, first control call and verdict",
        "",
        "Each in a process of its own; compiled programs are kept from the first run on. Processor time is that of all",
        "cores together.",
        "",
        "| | wall time [s] | processor time [s] |",
        "| --- | ---: | ---: |",
        *(f"| {name} | {seconds['wall_s']:.2f} | {seconds['cpu_s']:.2f} |" for name, seconds in rows),
        "",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("docs/results/speed.md"))
    parser.add_argument("--weights", default="gns-reference")
    parser.add_argument("--logs", nargs="*", default=[], help="gap logs to diagnose; by default a staged one")
    options = parser.parse_args()

    start = measure("bench", "start", *options.logs, "--weights", options.weights)
    mpc = measure("bench", "mpc", "--weights", options.weights)
    simulate = measure("bench", "simulate")
    lines = [
        "# Speed",
        "",
        "Made by `python benchmarks/speed.py --out docs/results/speed.md`.",
        f"{simulate['machine']}; JAX computes on {simulate['device']}.",
        "",
        f"## Simulators, {simulate['links']} links, each at the time step of its data",
        "",
        "| engine | time step [ms] | us per environment-step | us per simulated second | relative to C |",
        "| --- | ---: | ---: | ---: | ---: |",
        *(
            f"| {label} | {1e3 * simulate['timestep_s'][engine]:g} | {simulate['us_per_env_step'][name]:.2f} "
            f"| {simulate['us_per_simulated_second'][name]:.0f} | {simulate['relative_to_c'][name]:.3f} |"
            for name, engine, label in (
                ("chain", "chain", f"chain, batch {simulate['batch']}"),
                ("mjx", "mjx", f"MJX, batch {simulate['batch']}"),
                ("c_one", "threaded", "C MuJoCo, one core"),
                ("c_many", "threaded", f"C MuJoCo, {simulate['threads']} threads"),
            )
        ),
        "",
        f"MJX takes {simulate['mjx_memory_per_env_bytes'] / 1024:.0f} KiB per environment and compiles in "
        f"{simulate['mjx_compile_s']:.1f} s.",
        "",
        "## Transitions into a store",
        "",
        "Random motions of 200 commands, drawn, simulated, checked and written. Distances are those of the keypoint",
        "that is farthest from a simulation at 2 ms, over all samples.",
        "",
        "| engine | distance, median [mm] | 99 % [mm] | drawing [us] | simulation [us] | checks and store [us] "
        "| transitions per second | minutes for 2 million |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
        *(
            f"| {name} | {of['median_mm']:.4f} | {of['p99_mm']:.3f} "
            f"| {' | '.join(f'{us:.0f}' for us in simulate['us_per_transition'][name].values())} "
            f"| {simulate['transitions_per_second'][name]:.0f} | {simulate['two_million_transitions_min'][name]:.1f} |"
            for name, of in simulate["accuracy"].items()
        ),
        "",
        f"## One control call, model {options.weights}",
        "",
        "| solver | median [ms] | 95th percentile [ms] | first call, compiled [s] |",
        "| --- | --- | --- | --- |",
        *(
            f"| {name} | {s['p50_ms']:.1f} | {s['p95_ms']:.1f} | {s['first_call_s']:.1f} |"
            for name, s in mpc["solvers"].items()
        ),
        "",
        f"## Many cables at once, {mpc['solver']}",
        "",
        "| cables | ms per call | plans per second |",
        "| --- | --- | --- |",
        *(f"| {size} | {b['ms']:.1f} | {b['plans_per_second']:.1f} |" for size, b in mpc["batched"].items()),
        "",
        *waiting(start),
    ]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text("\n".join(lines), encoding="utf-8")
    print(f"Written to {options.out}")


if __name__ == "__main__":
    main()
