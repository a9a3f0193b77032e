"""Diagnoses real wires that hang between two clamps: how stiff they are, and which of them keep a permanent set.

Reads photographs of three wires, each hung five times, traced by others, who also published EI of each
(qj25/adapteddlo_muj, arXiv 2310.00911). Reports for each wire: the effects that explain how it differs from a straight
wire of the published EI, judged by held-out photographs; EI with a 90 % interval and the published one; and EI for
other places of the clamps, which the photographs do not show.

    CABLEJAX_DATA=... python experiments/31_wires.py --out docs/results/wires.md --figure docs/images/wires.png

Takes about three minutes on two cores. The rule is the same for all wires, see `cablejax.diagnose`.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from cablejax.cable import GRAVITY
from cablejax.provenance import machine, versions
from cablejax.report.style import LIGHT
from cablejax.simulate.hanging import Wire, hanging_angles, hanging_points
from cablejax.spatial.hanging import Photographs, WireDiagnosis, diagnose_wire, rig_error, wire_verdict_json
from cablejax.spatial.hanging_effects import EFFECTS
from pages import markdown_table, publish
from real_cables.wires import HangingWire, read_wires

OUTSIDE = (0.0, 0.005, 0.01, 0.015)
"""How far outside of the first and last traced point the clamps may be [m]: nothing, to half a spacing."""


def photographs_of(wire: HangingWire, error: float) -> Photographs:
    """The wire's photographs, in their plane."""
    stiffness = float(wire.published_stiffness.mean()) / (GRAVITY * wire.linear_density)
    return Photographs(wire.keypoints[..., [0, 2]], wire.length, stiffness, error)


def level_stiffness(photographs: Photographs, outside: float) -> float:
    """EI over the published one of a straight wire in level clamps, `outside` metres beyond the traced ends."""
    points = photographs.points
    guess = photographs.guess
    links, length = guess.shape[1], photographs.length + 2 * outside
    turns = 2 * np.pi * np.round(guess[:, [0, -1]] / (2 * np.pi))
    clamps = np.concatenate([points[:, [0, -1]] + outside * np.array([[-1.0, 0], [1, 0]]), turns[..., None]], axis=2)
    places = outside + np.linspace(0, photographs.length, points.shape[1])
    nodes = np.linspace(0, length, links + 1)

    @jax.jit
    def square(stiffness, clamps, guess, points):
        wire = Wire(jnp.full(links + 1, stiffness), jnp.zeros(links + 1), jnp.asarray(length))

        def one(clamps, guess, traced):
            there = hanging_points(hanging_angles(wire, clamps, guess), clamps, length, links + 1)
            seen = jnp.stack([jnp.interp(places, nodes, column) for column in there.T], axis=1)
            return ((seen - traced) ** 2).sum()

        return jax.vmap(one)(clamps, guess, points)

    # The median photograph: one whose equilibrium is not found at some EI does not decide.
    ratios = np.geomspace(0.5, 1.6, 60)
    misses = [float(np.median(square(photographs.stiffness * ratio, clamps, guess, points))) for ratio in ratios]
    return float(ratios[np.argmin(misses)])


def named(diagnosis: WireDiagnosis) -> str:
    return ", ".join(f"`{effect.name}` ({effect.probability:.2f})" for effect in diagnosis.effects) or "nothing"


def table(results: dict[str, dict[str, Any]]) -> str:
    title = "wire", "verdict", "named (probability)", "gap before [mm]", "after [mm]", "shrinkage", "EI [1e-4 N m²]"
    rows = [[*title, "published"]]
    for name, result in results.items():
        d: WireDiagnosis = result["diagnosis"]
        wire: HangingWire = result["wire"]
        shrinkage, interval = d.gap.shrinkage, d.gap.shrinkage_ci90
        unit = 1e4 * float(wire.published_stiffness.mean())
        value, low, high = (unit * number for number in d.stiffness)
        published = 1e4 * wire.published_stiffness
        rows.append(
            [
                name,
                d.verdict,
                named(d),
                f"{d.gap.before_rmse_mm:.2f}",
                f"{d.gap.after_rmse_mm:.2f}",
                "n/a"
                if shrinkage is None or interval is None
                else f"{shrinkage:.2f} ({interval[0]:.2f} to {interval[1]:.2f})",
                f"{value:.2f} ({low:.2f} to {high:.2f})",
                f"{unit:.2f} ({published.min():.2f} to {published.max():.2f})",
            ]
        )
    return "\n".join(markdown_table(rows))


def ranking(results: dict[str, dict[str, Any]]) -> str:
    names = [effect.name for effect in EFFECTS]
    rows = [["wire", *(f"`{name}`" for name in names)]]
    for name, result in results.items():
        ranked = {entry["name"]: entry for entry in result["verdict"]["ranking"]}
        tried = ((ranked[n]["probability"], ranked[n]["held_out_shrinkage"]) for n in names)
        shares = (f"{chance:.2f}, {'not fitted' if share is None else f'{share:.2f}'}" for chance, share in tried)
        rows.append([name, *shares])
    return "\n".join(markdown_table(rows))


def sets(results: dict[str, dict[str, Any]]) -> str:
    lines = []
    for name, result in results.items():
        for effect in result["verdict"]["effects"]:
            parts = []
            for label, entry in effect["parameters"].items():
                low, high = entry["ci90"]
                parts.append(f"{label} {entry['value']:.3g} ({low:.3g} to {high:.3g}) {entry['unit']}".strip())
            lines.append(f"- {name}: `{effect['name']}`: {'; '.join(parts)}")
        for alike in result["verdict"]["equivalent"]:
            lines.append(f"- {name}: instead of `{alike[0]}` possibly {' or '.join(f'`{o}`' for o in alike[1:])}")
    return "\n".join(lines)


def clamps(results: dict[str, dict[str, Any]]) -> str:
    rows = [["wire", *(f"{1e3 * outside:g} mm outside" for outside in OUTSIDE)]]
    rows += [[name, *(f"{ratio:.2f}" for ratio in result["level"])] for name, result in results.items()]
    return "\n".join(markdown_table(rows))


def draw(results: dict[str, dict[str, Any]], path: Path) -> None:
    figure = Figure(figsize=(12, 6.4), layout="constrained")
    axes = figure.subplots(1, len(results), sharey=True)
    for axis, (name, result) in zip(axes, results.items(), strict=True):
        d, photographs = result["diagnosis"], result["photographs"]
        for shapes, colour, label in (
            (d.examined.before[:, 0], LIGHT.direct, "straight, published EI"),
            (d.examined.after[:, 0], LIGHT.residual, "with what is named"),
        ):
            for k, shape in enumerate(shapes):
                axis.plot(*shape.T, color=colour, lw=1, label=label if k == 0 else None)
        for k, points in enumerate(photographs.points):
            axis.plot(*points.T, ".", color=LIGHT.ink, ms=3, label="traced, five photographs" if k == 0 else None)
        for effect in result["verdict"]["effects"]:
            if place := effect["location"]["along_cable_m"]:
                count = photographs.points.shape[1]
                first, last = (round(s / photographs.length * (count - 1)) for s in place)
                middle = photographs.points.mean(axis=0)[first : last + 1]
                axis.plot(*middle.T, color=LIGHT.faint, lw=12, zorder=0, label="where the rest shape is curved")
        what = " + ".join(effect.name for effect in d.effects) or "nothing named"
        change = f"{d.gap.before_rmse_mm:.1f} to {d.gap.after_rmse_mm:.1f} mm"
        axis.set_title(f"{name}: {what}, {change}", color=LIGHT.ink, fontsize=10)
        axis.set_aspect("equal")
        axis.set_xlabel("sideways [m]")
    axes[0].set_ylabel("up [m]")
    drawn = {label: line for axis in axes for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(drawn.values(), drawn.keys(), loc="outside lower center", ncols=len(drawn), frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def page(results: dict[str, dict[str, Any]], error: float, arguments: list[str], seconds: float) -> str:
    return f"""# Real wires between two clamps

Made by `python experiments/31_wires.py {" ".join(arguments)}` in {seconds / 60:.0f} minutes. {versions()}. {machine()}.

Three wires, each hung five times and traced in photographs (qj25/adapteddlo_muj, arXiv 2310.00911; 51 points, 1.5 m).
The model is a planar elastica with weight; the nominal wire is straight, with the published EI, in clamps level within
10 degrees. Effects are named by the rule of every diagnosis: the most probable explanation, if it shrinks the gap in
the held-out photographs significantly (the interval excludes zero). All gaps are of held-out photographs, root mean
square per coordinate; only the angles of the clamps are fitted to them. An effect's probability is relative to all
explanations with it or with another effect in its place; photographs are resampled for the interval of a shrinkage.

{table(results)}

{sets(results)}

![Traced wires, and what the model makes of them](../images/wires.png)

**Effects**: probability among single effects, and shrinkage of the squared gap by that effect alone.

{ranking(results)}

**What is not explained.** Photographs of one wire differ among each other by more than any shared effect can explain: a
wire with a permanent set hangs differently each time that it is turned about its axis, and that turn is not known. A
section with another EI and a section with a curved rest shape are distinguishable only where the wire bends both ways.
The error of a coordinate, {1e3 * error:.2f} mm, is how much the line from clamp to clamp differs among all photographs;
errors of one photograph count as one error.

**EI and the clamps.** EI is averaged over the explanations that fit EI. It depends on where the clamps are, which the
photographs do not show: this model clamps the wire at the first and last traced point, in clamps that may be some
degrees off. EI over the published one, of a straight wire in level clamps farther outside (median photograph, in steps
of 2 %; 1.6 is the end of the range):

{clamps(results)}

So the interval holds for clamps at the traced ends. An offset of some millimetres, which the published analysis may
have, would explain the differences from the published EI.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/results/wires.md"))
    parser.add_argument("--figure", type=Path, default=Path("docs/images/wires.png"))
    parser.add_argument("--verdicts", type=Path, help="folder for a verdict of each wire, as JSON")
    options = parser.parse_args()
    source = Path(os.environ.get("CABLEJAX_DATA", "absent")) / "hanging_wires" / "wires.npz"
    if not source.is_file():
        print("No recordings: set CABLEJAX_DATA to a folder with hanging_wires/wires.npz.")
        return
    began = time.perf_counter()
    wires = read_wires(source)
    error = rig_error(np.concatenate([wire.keypoints[:, -1] - wire.keypoints[:, 0] for wire in wires])[:, [0, 2]])
    results: dict[str, dict[str, Any]] = {}
    with jax.enable_x64(True):
        for wire in wires:
            photographs = photographs_of(wire, error)
            diagnosis = diagnose_wire(photographs, lambda text, name=wire.name: print(f"{name}: {text}", flush=True))
            results[wire.name] = {
                "wire": wire,
                "photographs": photographs,
                "diagnosis": diagnosis,
                "verdict": wire_verdict_json(diagnosis),
                "level": [level_stiffness(photographs, outside) for outside in OUTSIDE],
            }
    if options.verdicts is not None:
        options.verdicts.mkdir(parents=True, exist_ok=True)
        for name, result in results.items():
            (options.verdicts / f"{name}.json").write_text(
                json.dumps(result["verdict"], indent=1, allow_nan=False) + "\n"
            )
    draw(results, options.figure)
    publish(page(results, error, sys.argv[1:], time.perf_counter() - began), options.out)


if __name__ == "__main__":
    main()
