"""Damped Gauss-Newton on what recordings share and on what each has for its own.

With s the shared parameters, in prior standard deviations, and d_r what recording r adds to some of them,

    minimise  sum_r f_r(s + d_r) + |s|^2 / 2 + sum_r |d_r / spread|^2 / 2.

The recordings' own values enter no other recording's cost, so each is eliminated from its recording's share of the
normal equations (Schur complement), and what is left has the size of s however many recordings there are.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float

from cablejax.spatial.effects import Layout
from cablejax.spatial.fit import Simulator, Sums
from cablejax.spatial.values import Values
from cablejax.spatial.windows import Windows

_LARGEST_STEP = 1.0
_CONVERGED = 2e-3


@dataclasses.dataclass(frozen=True)
class Fit:
    """Fitted values.

    Attributes:
        values: of the fit.
        active: which were fitted, shape [P].
        sums: at the values, over the windows of the fit and whatever else was asked for.
        group: recording of each window of the sums, shape [W].
    """

    values: Values
    active: Bool[np.ndarray, "P"]
    sums: Sums
    group: np.ndarray


def improve(
    simulator: Simulator,
    values: Values,
    effects: Sequence[str],
    windows: Windows,
    *,
    use: Bool[np.ndarray, "W"] | None = None,
    iterations: int = 4,
    progress: Callable[[str], None] = lambda text: None,
) -> Fit:
    """Damped Gauss-Newton on some effects' values.

    Args:
        simulator: of the cable.
        values: to start from; recordings without values of their own begin at what all share.
        effects: whose values are free.
        windows: of the recordings.
        use: which of them are fitted; the sums are of all. By default all.
        iterations: steps, accepted or not.
        progress: called with a line of text after each step.
    """
    layout = simulator.layout
    active, use = layout.active(effects), np.ones(len(windows), bool) if use is None else use
    values = values.covering(windows.group)
    fit, damping = Fit(values, active, simulator.sums(values, windows), windows.group), 1e-3
    best = _objective(fit, layout, use)
    for iteration in range(iterations):
        moved = moved_by(layout, fit.values, active, newton_step(fit, layout, use, damping=damping))
        trial = Fit(moved, active, simulator.sums(moved, windows), windows.group)
        cost = _objective(trial, layout, use)
        progress(f"    step {iteration + 1}: {1e3 * trial.sums.error[use].mean():.2f} mm")
        if cost < best:
            done = best - cost < _CONVERGED * best
            fit, best, damping = trial, cost, max(damping / 5, 1e-5)
            if done:
                break
        else:
            damping = max(damping * 20, 3e-2)
    return fit


def coordinates(layout: Layout, values: Float[np.ndarray, "P"]) -> Float[np.ndarray, "P"]:
    """Values in prior standard deviations; what is switched off is at 0."""
    starts = layout.starts
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(np.where(values > 0, values, 1.0) / starts)
    return np.where(np.isnan(starts), values, np.where(values > 0, logs, 0.0)) / layout.scales


def slopes(layout: Layout, values: Float[np.ndarray, "P"]) -> Float[np.ndarray, "P"]:
    """Derivative of the values by their coordinates; what is switched off moves by its start."""
    starts = layout.starts
    return layout.scales * np.where(np.isnan(starts), 1.0, np.where(values > 0, values, np.nan_to_num(starts)))


@dataclasses.dataclass(frozen=True)
class Move:
    """A step of the shared values in their coordinates, shape [P], and of each recording's own values [R, P]."""

    shared: Float[np.ndarray, "P"]
    own: Float[np.ndarray, "R P"]

    def __mul__(self, scale: float) -> Move:
        return Move(scale * self.shared, scale * self.own)


def moved_by(layout: Layout, values: Values, active: Bool[np.ndarray, "P"], step: Move) -> Values:
    """The values after a step. What cannot be negative grows by a factor, or stays off."""
    old, positive = values.shared, ~np.isnan(layout.starts)
    moved = old + np.where(active, slopes(layout, old) * step.shared, 0.0)
    grown = old * np.exp(np.where(active & positive, layout.scales * step.shared, 0.0))
    shared = np.select([positive & (old > 0), positive], [grown, np.maximum(moved, 0.0)], moved)
    return Values(shared, values.recordings, values.own + step.own)


def newton_step(fit: Fit, layout: Layout, use: Bool[np.ndarray, "W"], *, damping: float = 0.0, active=None) -> Move:
    """Gauss-Newton's step of the active values, from some of the windows."""
    active = fit.active if active is None else active
    a, m = np.flatnonzero(active), np.flatnonzero(active & (layout.spreads > 0))
    gradient, curvature, kept = _eliminated(fit, layout, use, m, damping)
    matrix = curvature[np.ix_(a, a)]
    matrix = matrix + damping * np.diag(np.diagonal(matrix))
    step, own_step = np.zeros(len(active)), np.zeros_like(fit.values.own)
    step[a] = -np.linalg.solve(matrix, gradient[a])
    for r, solved in enumerate(kept):
        own_step[r, m] = -(solved[:, 0] + solved[:, 1:] @ step)
    size = max(np.abs(step).max(), np.abs(own_step[:, m] / layout.spreads[m]).max(initial=0.0), 1e-12)
    return Move(step, own_step) * min(1.0, _LARGEST_STEP / size)


def jackknife(fit: Fit, layout: Layout) -> Float[np.ndarray, "R P"]:
    """What leaving out each recording does to the shared values, by one Gauss-Newton step (Miller 1974).

    Scaled so that the standard error of anything linear in the values is the root of its sum of squares over rows.
    """
    label = fit.group if len(np.unique(fit.group)) > 1 else np.arange(len(fit.group))
    names = np.unique(label)
    full = newton_step(fit, layout, np.ones(len(label), bool)).shared
    moved = np.array([newton_step(fit, layout, label != name).shared for name in names])
    steps = (moved - full) * slopes(layout, fit.values.shared)
    return np.where(fit.active, np.sqrt((len(names) - 1) / len(names)) * steps, 0.0)


def prior_shifts(fit: Fit, layout: Layout) -> Float[np.ndarray, "P P"]:
    """What moving the prior of each value by its standard deviation does to the shared values, by one step.

    With S the curvature of the cost in prior standard deviations, the fit is off the true values by -S^-1 times these,
    were there no errors in the data: it is drawn towards the prior. On average over the prior the square of that, for
    anything linear in the values, is the sum of its squares over rows.
    """
    a, m = np.flatnonzero(fit.active), np.flatnonzero(fit.active & (layout.spreads > 0))
    _, curvature, _ = _eliminated(fit, layout, np.ones(len(fit.group), bool), m, 0.0)
    shifts = np.zeros_like(curvature)
    shifts[np.ix_(a, a)] = np.linalg.inv(curvature[np.ix_(a, a)])
    return shifts * slopes(layout, fit.values.shared)


def _eliminated(fit: Fit, layout: Layout, use, m, damping):
    """Gradient and curvature of the cost by the shared coordinates with the recordings' own values `m` eliminated, and
    per recording its own values' step, first without a step of the shared ones, then by each of them."""
    slope, spread = slopes(layout, fit.values.shared), layout.spreads[m]
    gradient, curvature = coordinates(layout, fit.values.shared), np.eye(len(slope))
    kept = []
    for recording, own in zip(fit.values.recordings, fit.values.own, strict=True):
        part = use & (fit.group == recording)
        own_gradient, own_curvature = fit.sums.gradient[part].sum(axis=0), fit.sums.curvature[part].sum(axis=0)
        block = own_curvature[np.ix_(m, m)] + np.diag(1 / spread**2)
        block = block + damping * np.diag(np.diagonal(block))
        across = own_curvature[:, m] * slope[:, None]
        pull = own_gradient[m] + own[m] / spread**2
        solved = np.linalg.solve(block, np.column_stack([pull, across.T])) if len(m) else np.zeros((0, len(slope) + 1))
        gradient = gradient + own_gradient * slope - across @ solved[:, 0]
        curvature = curvature + own_curvature * np.outer(slope, slope) - across @ solved[:, 1:]
        kept.append(solved)
    return gradient, curvature, kept


def _objective(fit: Fit, layout: Layout, use) -> float:
    prior = np.sum(coordinates(layout, fit.values.shared)[fit.active] ** 2)
    m = fit.active & (layout.spreads > 0)
    prior += np.sum((fit.values.own[:, m] / layout.spreads[m]) ** 2)
    cost = float(fit.sums.cost[use].sum()) + 0.5 * float(prior)
    return cost if np.isfinite(cost) else np.inf
