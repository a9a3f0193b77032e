"""Runs both benchmarks of the command line and writes their numbers as one Markdown page.

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("docs/results/speed.md"))
    parser.add_argument("--weights", default="gns-reference")
    options = parser.parse_args()

    simulate = measure("bench", "simulate")
    mpc = measure("bench", "mpc", "--weights", options.weights)
    lines = [
        "# Speed",
        "",
        "Made by `python benchmarks/speed.py --out docs/results/speed.md`.",
        f"{simulate['machine']}; JAX computes on {simulate['device']}.",
        "",
        f"## Simulators, {simulate['links']} links, time step {1e3 * simulate['timestep_s']:g} ms",
        "",
        "| engine | us per environment-step |",
        "| --- | --- |",
        f"| MJX, batch {simulate['batch']} | {simulate['mjx_us_per_env_step']:.2f} |",
        f"| C MuJoCo, one core | {simulate['c_us_per_env_step']:.2f} |",
        f"| C MuJoCo, {simulate['threads']} threads | {simulate['c_threads_us_per_env_step']:.2f} |",
        "",
        f"MJX over C: {simulate['mjx_over_c']:.2f}. {simulate['threads']} threads over one: "
        f"{simulate['threads_speedup']:.2f} times as fast. MJX takes "
        f"{simulate['mjx_memory_per_env_bytes'] / 1024:.0f} KiB per environment and compiles in "
        f"{simulate['mjx_compile_s']:.1f} s.",
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
    ]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text("\n".join(lines), encoding="utf-8")
    print(f"Written to {options.out}")


if __name__ == "__main__":
    main()
