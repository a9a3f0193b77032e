"""A sheet: one page that describes a file."""

from __future__ import annotations

import dataclasses
import os
import pathlib
import shlex
from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from cablejax.cable import GRAVITY, Cable
from cablejax.cable_file import NUMBERS, cable_to_fields
from cablejax.control.targets import make_target
from cablejax.limits import LIMITS
from cablejax.report.diagnosis_sections import Table
from cablejax.report.html import svg, write_html
from cablejax.report.style import DIAGNOSIS_STYLE, LIGHT, cable_curve


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sheet:
    """Content of one page.

    Attributes:
        kind: what it is, in a word or two.
        title: what it holds, in a sentence.
        lead: a second sentence.
        cards: heading, text and note of each.
        figures: each with its caption.
        tables: heading, head and rows of each.
        following: what can be done with it, in sentences.
        facts: all that else is known of it, by name.
        text: a longer text, as it is.
    """

    kind: str
    title: str
    lead: str
    cards: Sequence[tuple[str, str, str]]
    figures: Sequence[tuple[Figure, str]]
    tables: Sequence[Table] = ()
    following: Sequence[str] = ()
    facts: Mapping[str, str] = dataclasses.field(default_factory=dict)
    text: str = ""


def write_sheet(path: str | os.PathLike[str], sheet: Sheet) -> pathlib.Path:
    """Writes a sheet as a self-contained HTML page and returns its path."""
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    pictures = [(svg(figure, f"figure{k}"), caption) for k, (figure, caption) in enumerate(sheet.figures)]
    write_html(path, "sheet.html", title=f"{sheet.kind}: {sheet.title}", sheet=sheet, pictures=pictures)
    return path


def cable_sheet(cable: Cable, name: str) -> Sheet:
    """The page of a cable file."""
    return Sheet(
        kind="cable",
        title=f"A cable of {cable.length:g} m, {1e3 * cable.diameter:g} mm thick",
        lead=f"{name}: {cable.n_keypoints} observed keypoints between two grippers that hold position and direction.",
        cards=cable_cards(cable),
        figures=[(letters_figure(cable), LETTERS_CAPTION)],
        following=(
            f"Simulate motions of it: cablejax simulate --cable {shlex.quote(name)}",
            *(
                [
                    "Train a model on them: cablejax train --data runs/data.zarr --out runs/train",
                    "Shape it with that model: cablejax shape --target Z --weights runs/train",
                ]
                if cable.marks is None
                else [f"To train a model, write `keypoints = {cable.n_keypoints}` in place of keypoint_arclength_m."]
            ),
        ),
        facts=cable_facts(cable),
    )


def cable_cards(cable: Cable, *, on_table: bool = True) -> list[tuple[str, str, str]]:
    """Size, weight and stiffness of a cable, and the friction of its table, as cards."""
    weight = cable.linear_density * GRAVITY
    droop = (cable.bending_stiffness / weight) ** (1 / 3)
    friction = cable.friction_coefficient * weight * cable.length**3 / cable.bending_stiffness
    curved = f", curved by {cable.rest_curvature:g} /m at rest" if cable.rest_curvature else ""
    cards = [
        ("Length", f"{cable.length:g} m", f"{cable.n_keypoints} keypoints, {1e3 * cable.diameter:g} mm thick{curved}"),
        ("Mass", f"{1e3 * cable.linear_density * cable.length:.3g} g", f"{cable.linear_density:g} kg/m"),
        ("Bending stiffness", f"{cable.bending_stiffness:g} N m²", f"(EI / weight)^(1/3) is {100 * droop:.3g} cm"),
        ("Friction", f"{cable.friction_coefficient:g}", f"friction over stiffness, mu w L^3 / EI, is {friction:.3g}"),
    ]
    return cards if on_table else cards[:-1]


def cable_facts(cable: Cable) -> dict[str, str]:
    """Every number of a cable's file, with its unit."""
    units = {key: LIMITS[field].unit for key, (field, _) in NUMBERS.items()}
    return {key: f"{value} {units.get(key, '')}".strip() for key, value in cable_to_fields(cable).items()}


LETTERS_CAPTION = "This cable as a U, an S and a Z between two grippers, at rest and without friction. Dots: keypoints."
"""Caption of `letters_figure`."""


def letters_figure(cable: Cable) -> Figure:
    """The cable at rest as a U, an S and a Z."""
    with matplotlib.rc_context(DIAGNOSIS_STYLE):
        figure = Figure(figsize=(10.0, 3.2), layout="constrained")
        for ax, letter in zip(figure.subplots(1, 3, sharex=True, sharey=True), ("U", "S", "Z"), strict=True):
            target = make_target(letter, cable)
            ax.plot(*cable_curve(target.keypoints, target.gripper_pose).T, color=LIGHT.residual, lw=2.2)
            ax.plot(*target.keypoints.T, "o", color=LIGHT.residual, ms=3.5)
            ax.set(aspect="equal", xlabel="x [m]", title=letter)
    return figure


def span(values: np.ndarray) -> str:
    """Least and largest of the finite values: "0.1 to 3"; "n/a" where there is none."""
    known = np.asarray(values, float)[np.isfinite(values)]
    if not known.size:
        return "n/a"
    low, high = f"{known.min():.3g}", f"{known.max():.3g}"
    return low if low == high else f"{low} to {high}"
