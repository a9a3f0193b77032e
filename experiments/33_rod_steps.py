"""Tries the time step of a cable in space over wide ranges of cables and motions, against 1/32 of the step.

    python experiments/33_rod_steps.py

simulates 144 motions of 5 s: EI/rho from 0.0003 to 0.3 m^4/s^2, lengths from 0.3 to 3 m, damping from none to
overdamped, and clamps that wave, jerk with 300 m/s^2, carry the cable into a loop, or pull it taut. It writes
docs/results/rod_steps.md. Takes two minutes on one core.
"""

from __future__ import annotations

import argparse
import pathlib
import time

import numpy as np

from cablejax.provenance import machine, versions
from cablejax.simulate.rod import Rod, RodResult
from cablejax.simulate.rod.constrained import TOLERANCE
from pages import markdown_table, publish
from real_cables.rod_grid import MOTIONS, STIFFNESS, every_case, rollouts

_FINER = 32


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("docs/results/rod_steps.md"))
    arguments = parser.parse_args()
    cases = every_case()
    found, seconds = rollouts(cases), []
    # each batch alone, for the compilation is over
    for begin in range(0, len(cases), 4):
        start = time.process_time()
        rollouts(cases[begin : begin + 4])
        seconds += [(time.process_time() - start) / 4] * 4
    reference = rollouts(cases, substeps=_FINER)
    off = np.abs(found.points - reference.points).mean(axis=(2, 3))
    length = np.array([case.length for case in cases])
    error = {s: 100 * off[:, : round(100 * s)].mean(axis=1) / length for s in (1, 5)}
    lines = [
        "# The rod's time step over wide ranges",
        "",
        f"{len(cases)} motions of 5 s at 100 Hz: 3 lengths (0.3, 1, 3 m) and 3 damping times (0, 0.03, 1 s) in each "
        f"row. Solved: every time step to {TOLERANCE:g} m, with a local error of at most {Rod.local_error:g} of an "
        "edge. Coarse: every step solved, but even 1/32 of a step exceeded that error somewhere. Unsolved: a step "
        "without a solution. Error: mean "
        f"distance of a marker's coordinate to the same simulation with {_FINER} steps a sample, as a share of the "
        "cable's length, over the first second and over all five; for chaotic cables the latter grows for any step.",
        "",
    ]
    measures = ("steps a sample, median, largest", "error in 1 s, median, largest [%]", "in 5 s [%]")
    rows = [["clamps", "EI/rho [m^4/s^2]", "solved, coarse, unsolved", *measures, "processor time, median [ms]"]]
    for motion in MOTIONS:
        for stiffness in STIFFNESS:
            row = np.array([c.motion == motion and c.stiffness == stiffness for c in cases])
            counts = [int((found.result[row] == code).sum()) for code in RodResult]
            steps = found.steps[row] / found.points.shape[1]
            one, five = ([np.median(error[s][row]), error[s][row].max()] for s in (1, 5))
            measured = (
                f"{np.median(steps):.2f}, {steps.max():.1f}",
                f"{one[0]:.2f}, {one[1]:.2f}",
                f"{five[0]:.2f}, {five[1]:.1f}",
                f"{1e3 * np.median(np.array(seconds)[row]):.0f}",
            )
            rows.append([motion, f"{stiffness:g}", ", ".join(map(str, counts)), *measured])
    lost = [int((result == RodResult.UNSOLVED).sum()) for result in (found.result, reference.result)]
    lines += [
        *markdown_table(rows),
        "",
        f"Unsolved in all: {lost[0]} of {len(cases)}, and {lost[1]} of the references. A batch holds the four "
        "motions of one cable; times are per motion, the batch's divided by four.",
        "",
        "---",
        "",
        f"Made by `python experiments/33_rod_steps.py`. {versions()}; {machine()}.",
        "",
    ]
    publish("\n".join(lines), arguments.out)


if __name__ == "__main__":
    main()
