"""Shapes a cable with a model that is wrong about it, without and with the online correction.

    python experiments/01_shape_a_cable.py --out runs/01_shape_a_cable

The plant's cable is a fifth as stiff as the one the model was trained on. Prints how the error fell and writes the
figures. `--steps` and `--links` make it smaller.
"""

from __future__ import annotations

import argparse
import dataclasses
import pathlib

from cablejax.control.shaping import METHODS, load_model, shape_once
from cablejax.control.targets import make_target
from cablejax.effects.given import GivenEffect
from cablejax.report import figures
from cablejax.report.animation import write_gif
from cablejax.simulate.plant import PlantConfig


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("runs/01_shape_a_cable"))
    parser.add_argument("--shape", choices=("U", "S", "Z"), default="S")
    parser.add_argument("--steps", type=int, default=40, help="commands, one second each")
    parser.add_argument("--links", type=int, default=24, help="links of the plant's cable")
    parser.add_argument("--weights", default="gns-reference")
    options = parser.parse_args(arguments)

    plant = PlantConfig(effects=(GivenEffect("bending_stiffness", (("ratio", 0.2),)),))
    plant = dataclasses.replace(plant, discretisation=dataclasses.replace(plant.discretisation, n_links=options.links))
    model = load_model(options.weights)
    target = make_target(options.shape, plant.cable)

    runs = {}
    for method in METHODS:
        run = shape_once(plant, model, target, method=method, solver="levenberg-marquardt", steps=options.steps)
        print(f"{method:10s} {run.verdict()}")
        runs[target.name, method] = run

    options.out.mkdir(parents=True, exist_ok=True)
    for draw in (figures.snapshots, figures.final_shapes, figures.error_over_time, figures.residual_share):
        draw(runs).savefig(options.out / f"{draw.__name__}.png", dpi=160)
    write_gif(options.out / "shape.gif", runs)
    print(f"Figures and animation are in {options.out}")


if __name__ == "__main__":
    main()
