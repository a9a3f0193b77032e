"""A conformal test of whether an explanation is complete (Vovk, Gammerman and Shafer 2005).

The score of an explanation is what it leaves over what `Calibration.complete` allows. On labelled logs of other
simulators that show one effect of the library, the right explanation has the scores below. If a new log is like these
and its explanation right, its score is as likely to be at any rank among them: the p-value is the share of scores at
least as high, the new one counted. An explanation that is not complete, with a score above 1, has p <= 3 / 81.
"""

from __future__ import annotations

from collections.abc import Sequence

from cablejax.diagnose.belief import Calibration

# fmt: off
SCORES = (
    0.00, 0.00, 0.00, 0.03, 0.06, 0.08, 0.08, 0.09, 0.10, 0.10, 0.11, 0.12, 0.13, 0.13, 0.14, 0.16,
    0.16, 0.16, 0.16, 0.18, 0.18, 0.19, 0.19, 0.21, 0.23, 0.23, 0.24, 0.26, 0.26, 0.27, 0.27, 0.27,
    0.27, 0.27, 0.28, 0.29, 0.29, 0.29, 0.29, 0.29, 0.30, 0.30, 0.30, 0.31, 0.31, 0.34, 0.36, 0.36,
    0.36, 0.37, 0.37, 0.38, 0.38, 0.39, 0.39, 0.39, 0.39, 0.42, 0.44, 0.45, 0.45, 0.45, 0.47, 0.47,
    0.48, 0.50, 0.52, 0.52, 0.53, 0.55, 0.56, 0.60, 0.61, 0.70, 0.72, 0.79, 0.87, 0.97, 1.30, 1.85,
)
# fmt: on
"""Of 80 logs of the blind check of seed 20270404, printed by `python experiments/22_blind_score.py
docs/results/blind/20270404/cases.jsonl --leftovers`."""


def leftover_score(left: float, gap: float, noise: float, calibration: Calibration) -> float:
    """Remaining gap of an explanation, relative to that of a complete one; all in one unit."""
    return left / calibration.may_leave(gap, noise)


def leftover_p(score: float, right: Sequence[float] = SCORES) -> float | None:
    """Chance that a right explanation has a score at least as high; at least 1 / 81 for cables.

    Args:
        score: of the new explanation.
        right: scores of right explanations on labelled recordings that are like the new one.

    Returns:
        None where there are no such recordings.
    """
    return (1 + sum(other >= score for other in right)) / (len(right) + 1) if right else None
