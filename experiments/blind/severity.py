"""The strength at which an effect leaves a wanted gap."""

from __future__ import annotations

import math
from collections.abc import Callable

from .record import Unreachable

TOLERANCE = 0.06
"""Of the gap, relative."""


def search(
    evaluate: Callable[[float], float], target: float, strengths: tuple[float, float], evaluations: int = 9
) -> tuple[float, float]:
    """Secant in the logarithms of strength and gap, kept inside the bracket by bisection.

    Args:
        evaluate: gap of a strength; raises `Unreachable` where the motions do not allow so much.
        target: wanted gap, in the unit of `evaluate`.
        strengths: smallest and largest strength.

    Returns:
        Strength and gap nearest to the target among those tried.

    Raises:
        Unreachable: no strength that was tried is possible.
    """
    low, high = math.log(strengths[0]), math.log(strengths[1])
    wanted = math.log(target)
    tried: list[tuple[float, float]] = []
    x = 0.5 * (low + high)
    for _ in range(evaluations):
        try:
            y = math.log(max(evaluate(math.exp(x)), 1e-9))
        except Unreachable:
            high = x
            x = 0.5 * (low + high)
            continue
        tried.append((x, y))
        if abs(y - wanted) < TOLERANCE or high - low < 1e-3:
            break
        low, high = (x, high) if y < wanted else (low, x)
        slope = 1.0
        if len(tried) > 1:
            (xa, ya), (xb, yb) = tried[-2:]
            if abs(xb - xa) > 1e-9:
                slope = min(max((yb - ya) / (xb - xa), 0.3), 4.0)
        step = x + (wanted - y) / slope
        margin = 0.05 * (high - low)
        x = step if low + margin < step < high - margin else 0.5 * (low + high)
    if not tried:
        raise Unreachable("No strength of this effect goes with these motions.")
    x, y = min(tried, key=lambda pair: abs(pair[1] - wanted))
    return math.exp(x), math.exp(y)
