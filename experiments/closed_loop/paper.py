"""Published figures to compare with: tables III to V of Wang et al., RA-L 2022, and Liang et al., 2026."""

from __future__ import annotations

import dataclasses
from typing import Literal

PaperTable = Literal["III", "IV", "V"]
"""III: in simulation, five stiffnesses; IV: an Ethernet cable; V: a USB cable."""

Measure = Literal["terminal", "settling"]


@dataclasses.dataclass(frozen=True)
class PaperCell:
    """Mean and standard deviation over the paper's five trials.

    Attributes:
        terminal: error at the end [cm].
        settling: settling time [s]; the paper does not say how it is measured.
    """

    terminal: tuple[float, float]
    settling: tuple[float, float]


VISUAL_SERVO, DIRECT, RANDOMISED, FINE_TUNED, RESIDUAL = (
    "visual-servo",
    "direct",
    "randomised",
    "fine-tuned",
    "residual",
)  # fmt: skip

METHOD_LABEL: dict[str, str] = {
    VISUAL_SERVO: "online visual servo",
    DIRECT: "direct transfer",
    RANDOMISED: "domain randomisation",
    FINE_TUNED: "fine-tuning",
    RESIDUAL: "GNS + online residual",
}
"""The paper's methods in its order, under the names that trials have for them."""

_Cells = dict[str, dict[str, PaperCell]]

PAPER: dict[PaperTable, _Cells] = {
    "III": {
        VISUAL_SERVO: {
            "U": PaperCell((1.96, 0.29), (27.47, 5.44)),
            "S": PaperCell((3.28, 0.82), (24.76, 3.27)),
            "Z": PaperCell((8.72, 1.15), (19.43, 6.11)),
        },
        DIRECT: {
            "U": PaperCell((1.54, 0.53), (11.32, 1.46)),
            "S": PaperCell((1.61, 0.42), (13.98, 1.31)),
            "Z": PaperCell((1.87, 0.56), (11.91, 1.75)),
        },
        RANDOMISED: {
            "U": PaperCell((1.11, 0.21), (12.60, 1.32)),
            "S": PaperCell((1.30, 0.33), (14.33, 1.47)),
            "Z": PaperCell((1.76, 0.41), (12.07, 1.66)),
        },
        FINE_TUNED: {
            "U": PaperCell((0.42, 0.10), (8.31, 0.72)),
            "S": PaperCell((0.57, 0.08), (13.58, 1.06)),
            "Z": PaperCell((1.19, 0.23), (9.82, 1.32)),
        },
        RESIDUAL: {
            "U": PaperCell((0.58, 0.13), (12.35, 1.09)),
            "S": PaperCell((0.61, 0.14), (13.79, 1.50)),
            "Z": PaperCell((0.78, 0.17), (16.32, 1.15)),
        },
    },
    "IV": {
        VISUAL_SERVO: {
            "U": PaperCell((5.58, 1.11), (52.04, 12.11)),
            "S": PaperCell((1.64, 0.28), (44.18, 8.00)),
        },
        DIRECT: {
            "U": PaperCell((2.54, 0.61), (25.23, 5.19)),
            "S": PaperCell((1.57, 0.35), (24.63, 5.16)),
        },
        RANDOMISED: {
            "U": PaperCell((1.91, 0.59), (36.29, 5.45)),
            "S": PaperCell((1.36, 0.34), (16.73, 4.37)),
        },
        FINE_TUNED: {
            "U": PaperCell((1.56, 0.43), (22.29, 5.63)),
            "S": PaperCell((1.12, 0.33), (23.03, 4.80)),
        },
        RESIDUAL: {
            "U": PaperCell((1.03, 0.24), (24.29, 7.92)),
            "S": PaperCell((0.99, 0.16), (19.29, 7.71)),
        },
    },
    "V": {
        VISUAL_SERVO: {
            "U": PaperCell((3.41, 0.91), (113.66, 20.93)),
            "S": PaperCell((2.04, 0.16), (106.12, 17.09)),
        },
        DIRECT: {
            "U": PaperCell((1.79, 0.45), (21.16, 4.38)),
            "S": PaperCell((1.91, 0.67), (23.71, 5.13)),
        },
        RANDOMISED: {
            "U": PaperCell((1.39, 0.40), (13.65, 4.39)),
            "S": PaperCell((1.33, 0.43), (31.19, 6.90)),
        },
        FINE_TUNED: {
            "U": PaperCell((0.86, 0.38), (14.83, 3.87)),
            "S": PaperCell((1.08, 0.24), (21.44, 4.06)),
        },
        RESIDUAL: {
            "U": PaperCell((0.93, 0.23), (18.81, 7.64)),
            "S": PaperCell((0.82, 0.16), (34.81, 8.61)),
        },
    },
}
"""The paper prints in bold what it calls best, twice not the lowest number: use `best_in_paper`."""


def best_in_paper(table: PaperTable, scenario: str, measure: Measure) -> float:
    """The lowest mean that the paper reports in one column.

    Raises:
        ValueError: the paper has no such table, or no such scenario in it.
    """
    cells = [row[scenario] for row in PAPER.get(table, {}).values() if scenario in row]
    if not cells:
        raise ValueError(
            f"The paper reports nothing for scenario {scenario!r} in table {table!r} by any method: its tables are III "
            "(U, S, Z), IV and V (U, S)."
        )
    return min(getattr(cell, measure)[0] for cell in cells)


@dataclasses.dataclass(frozen=True)
class PublishedSuccess:
    """How often a published method succeeded in planar two-arm shaping from random starts to random targets.

    Attributes:
        label: the method.
        scenario: "straight" or "diverse" starts.
        successes: runs with a root mean square error below 10 mm within 250 steps.
        trials: of so many.
        error_mm: mean error of the method [mm], None where only the count is reported.
    """

    label: str
    scenario: str
    successes: int
    trials: int = 50
    error_mm: float | None = None


LIANG: tuple[PublishedSuccess, ...] = (
    PublishedSuccess("Liang et al., 2026", "straight", 47, error_mm=1.7),
    PublishedSuccess("Liang et al., 2026", "diverse", 43, error_mm=2.2),
    PublishedSuccess("MPC, as reported there", "straight", 30),
    PublishedSuccess("MPC, as reported there", "diverse", 26),
    PublishedSuccess("visual servo, as reported there", "straight", 13),
    PublishedSuccess("visual servo, as reported there", "diverse", 18),
)
