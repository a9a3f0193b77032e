"""Fits of a rod's values: what all recordings share, and what each has for its own.

With s the shared parameters, in prior standard deviations, and d_r what recording r adds to some of them,

    minimise  sum_r f_r(s + d_r) + |s|^2 / 2 + sum_r |d_r / spread|^2 / 2

by `bounded.BatchedGaussNewton`. The recordings' own values enter no other recording's cost: they are blocks, which
every solution of the normal equations eliminates, so that what is left has the size of s however many recordings there
are.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float

from cablejax.bounded import BatchedGaussNewton, Linearised, Result, solve_arrow
from cablejax.spatial.effects import Layout
from cablejax.spatial.fit import Simulator, Sums
from cablejax.spatial.values import Values
from cablejax.spatial.windows import Windows

# Nats per window: a step that promises less is not worth the simulations that it takes.
_TOLERANCE = 0.1
# Steps end by the tolerance. This is for fits that creep.
_MOST_STEPS = 40
_LARGEST_STEP = 1.0


@dataclasses.dataclass(frozen=True)
class RodFit:
    """Fitted values.

    Attributes:
        values: of the fit.
        active: which were fitted, shape [P].
        sums: at the values, over the windows of the fit and whatever else was asked for.
        group: recording of each window of the sums, shape [W].
        result: how the fit ended; `STEP_LIMIT` also where no step was made.
    """

    values: Values
    active: Bool[np.ndarray, "P"]
    sums: Sums
    group: np.ndarray
    result: Result = Result.STEP_LIMIT


def fit_at(simulator: Simulator, values: Values, effects: Sequence[str], windows: Windows) -> RodFit:
    """The sums at given values, with nothing fitted; see `improve` for the arguments."""
    values = values.covering(windows.group)
    return RodFit(values, simulator.layout.active(effects), simulator.sums(values, windows), windows.group)


def improve(
    simulator: Simulator,
    values: Values,
    effects: Sequence[str],
    windows: Windows,
    *,
    use: Bool[np.ndarray, "W"] | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> RodFit:
    """Fits some effects' values until a step promises too little. No step raises the cost.

    Args:
        simulator: of the cable.
        values: to start from; recordings without values of their own begin at what all share.
        effects: whose values are free.
        windows: of the recordings.
        use: which of them are fitted; the sums are of all. By default all.
        progress: called with a line of text after each step.
    """
    layout = simulator.layout
    active, use = layout.active(effects), np.ones(len(windows), bool) if use is None else use
    start = now = normal_equations(fit_at(simulator, values, effects, windows), layout, use)

    def linearise(trials):
        nonlocal now
        (point,) = trials.values()
        # a value that is off moves along a line, one that is on by a factor: a step is one from where the fit stands
        moved = moved_by(layout, now.kept.values, active, move_of(now.kept, layout, active, point - now.point))
        fit = fit_at(simulator, moved, effects, windows)
        there = normal_equations(fit, layout, use)
        taken = there.value < now.value
        progress(f"    {1e3 * fit.sums.error[use].mean():.2f} mm{'' if taken else ', not taken'}")
        now = there if taken else now
        return [there]

    solver = BatchedGaussNewton(
        tolerance=_TOLERANCE * int(use.sum()),
        max_steps=_MOST_STEPS,
        largest_step=_LARGEST_STEP,
        damping=1e-3,
        raised=20.0,
        least_damping=1e-5,
        least_raised=3e-2,
    )
    (ended,) = solver.minimise([start], linearise)
    return dataclasses.replace(ended.best.kept, result=ended.result)


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


def normal_equations(
    fit: RodFit, layout: Layout, use: Bool[np.ndarray, "W"], active: Bool[np.ndarray, "P"] | None = None
) -> Linearised[RodFit]:
    """The cost of some windows with its derivatives by the active values.

    The point holds the shared values' coordinates, then each recording's own, all in prior standard deviations.
    """
    active = fit.active if active is None else active
    a, m = np.flatnonzero(active), np.flatnonzero(active & (layout.spreads > 0))
    shared, own = fit.values.shared, fit.values.own
    columns, scale = np.r_[a, m], np.r_[slopes(layout, shared)[a], layout.spreads[m]]
    point = np.r_[coordinates(layout, shared)[a], (own[:, m] / layout.spreads[m]).ravel()]
    lower = np.full(len(point), -np.inf)
    lower[: len(a)][~np.isnan(layout.starts[a]) & (shared[a] <= 0)] = 0.0
    # all priors are standard normal in these coordinates
    cost, gradient, curvature = 0.5 * float(point @ point), point.copy(), np.eye(len(point))
    blocks = tuple(len(a) + len(m) * r + np.arange(len(m)) for r in range(len(own)))
    for recording, block in zip(fit.values.recordings, blocks, strict=True):
        part, rows = use & (fit.group == recording), np.r_[: len(a), block]
        cost += float(fit.sums.cost[part].sum())
        gradient[rows] += scale * fit.sums.gradient[part].sum(axis=0)[columns]
        curved = fit.sums.curvature[part].sum(axis=0)[np.ix_(columns, columns)]
        curvature[np.ix_(rows, rows)] += np.outer(scale, scale) * curved
    free = np.full(len(point), np.inf)
    return Linearised(point, lower, free, cost, gradient, curvature, fit, blocks if len(m) else ())


def move_of(fit: RodFit, layout: Layout, active: Bool[np.ndarray, "P"], step: Float[np.ndarray, "C"]) -> Move:
    """A step of the point of `normal_equations` as one of the values."""
    a, m = np.flatnonzero(active), np.flatnonzero(active & (layout.spreads > 0))
    move = Move(np.zeros(len(active)), np.zeros_like(fit.values.own))
    move.shared[a] = step[: len(a)]
    move.own[:, m] = step[len(a) :].reshape(len(move.own), len(m)) * layout.spreads[m]
    return move


def newton_step(fit: RodFit, layout: Layout, use: Bool[np.ndarray, "W"], *, damping: float = 0.0, active=None) -> Move:
    """Gauss-Newton's step of the active values, from some of the windows."""
    active = fit.active if active is None else active
    at = normal_equations(fit, layout, use, active)
    step = -solve_arrow(at.curvature + damping * np.diag(np.diagonal(at.curvature)), at.gradient, at.blocks)
    return move_of(fit, layout, active, step * min(1.0, _LARGEST_STEP / max(np.abs(step).max(initial=0.0), 1e-12)))


def jackknife(fit: RodFit, layout: Layout) -> Float[np.ndarray, "R P"]:
    """What leaving out each recording does to the shared values, by one Gauss-Newton step (Miller 1974).

    Scaled so that the standard error of anything linear in the values is the root of its sum of squares over rows.
    """
    label = fit.group if len(np.unique(fit.group)) > 1 else np.arange(len(fit.group))
    names = np.unique(label)
    full = newton_step(fit, layout, np.ones(len(label), bool)).shared
    moved = np.array([newton_step(fit, layout, label != name).shared for name in names])
    steps = (moved - full) * slopes(layout, fit.values.shared)
    return np.where(fit.active, np.sqrt((len(names) - 1) / len(names)) * steps, 0.0)


def prior_shifts(fit: RodFit, layout: Layout) -> Float[np.ndarray, "P P"]:
    """What moving the prior of each value by its standard deviation does to the shared values, by one step.

    With S the curvature of the cost in prior standard deviations, the recordings' own values eliminated, the fit is off
    the true values by -S^-1 times these, were there no errors in the data: it is drawn towards the prior. On average
    over the prior the square of that, for anything linear in the values, is the sum of its squares over rows.
    """
    at, a = normal_equations(fit, layout, np.ones(len(fit.group), bool)), np.flatnonzero(fit.active)
    shifts = np.zeros((len(fit.active), len(fit.active)))
    shifts[np.ix_(a, a)] = solve_arrow(at.curvature, np.eye(len(at.point), len(a)), at.blocks)[: len(a)]
    return shifts * slopes(layout, fit.values.shared)
