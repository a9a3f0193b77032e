"""Where EI / rho of a cable lies, from recordings whose effects were searched for.

An effect stays in the search when recordings that no fit has seen are simulated better with it. That is strict: drag, a
stiffness profile or a recording's own grip may be there and yet not help elsewhere, and what is left out pulls EI / rho
the same way in all recordings, where no resampling of the recordings shows it. Here all effects that were tried are
free, chosen or not, and the interval has two parts: how EI / rho changes when recordings are left out (jackknife), and
how it changes when the priors move by their standard deviation, which is how far the fit may be drawn towards them. Its
middle is the estimate with all effects free. The value that predictions are made with is another one, and where the
effects that stayed are too few it may lie outside.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.stats import norm, t

from cablejax.spatial.identify import Identified, affordable
from cablejax.spatial.newton import improve, jackknife, prior_shifts
from cablejax.spatial.values import Values
from cablejax.spatial.windows import Windows

_ITERATIONS = 12
_TAIL = 0.95


def stiffness_interval(
    found: Identified,
    start: Values,
    windows: Windows,
    *,
    progress: Callable[[str], None] = lambda text: None,
) -> tuple[float, float]:
    """90 % interval of EI / rho, of its geometric mean along the cable [m^4/s^2].

    Args:
        found: what was tried.
        start: values to start from, fitted to the same windows with the effects that stayed.
        windows: to fit.
        progress: called with a line of text.
    """
    layout = found.simulator.layout
    # a positive value that is off starts at its prior's median: the logarithm of nothing leads nowhere
    off = layout.active(found.tried) & ~np.isnan(layout.starts) & (start.shared == 0)
    start = dataclasses.replace(start, shared=np.where(off, layout.starts, start.shared))
    chosen = windows.chosen(np.flatnonzero(affordable(found.simulator, windows)))
    progress(f"EI/rho with all effects free: {len(chosen)} windows")
    fit = improve(found.simulator, start, found.tried, chosen, iterations=_ITERATIONS, progress=progress)
    log = layout.log_stiffness(fit.values.shared)
    moves, shifts = jackknife(fit, layout), prior_shifts(fit, layout)
    error = np.hypot(
        t.ppf(_TAIL, len(moves) - 1) * np.linalg.norm(layout.log_stiffness(moves)),
        norm.ppf(_TAIL) * np.linalg.norm(layout.log_stiffness(shifts)),
    )
    low, high = layout.nominal_stiffness * np.exp([log - error, log + error])
    return float(low), float(high)


def intervals_of_halves(
    found: Identified, windows: Windows, *, progress: Callable[[str], None] = lambda text: None
) -> tuple[tuple[float, float], tuple[float, float]]:
    """`stiffness_interval` from either half of the recordings, as the search split them [m^4/s^2].

    Args:
        found: from these windows.
        windows: of all recordings.
        progress: called with a line of text.
    """
    one, other = (
        stiffness_interval(found, values, windows.chosen(np.flatnonzero(half)), progress=progress)
        for values, half in zip(found.half_values, (found.first, ~found.first), strict=True)
    )
    return one, other
