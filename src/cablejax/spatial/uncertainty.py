"""How far the values of a fit may be off: recordings left out (jackknife), priors moved, edges made shorter."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from cablejax.bounded import solve_arrow
from cablejax.diagnose.evidence import Evidence
from cablejax.diagnose.fit import Fit, evaluate
from cablejax.diagnose.refits import independent
from cablejax.spatial.cable import SpatialCable
from cablejax.spatial.windows import FITTED

_LARGEST_STEP = 1.0


def sources(evidence: Evidence, fit: Fit) -> tuple[Float[np.ndarray, "R K"], Float[np.ndarray, "K K"]]:
    """What leaving out each recording, and what moving each prior, does to the coordinates.

    With S the curvature of the cost in prior standard deviations, the recordings' own values eliminated, the fit is off
    the true values by -S^-1 times these, were there no errors in the data: it is drawn towards the prior. On average
    over the prior the square of that, for anything linear in the values, is the sum of its squares over rows.
    """
    return jackknife(evidence, fit), np.linalg.inv(fit.precision(evidence))


def resolution(evidence: Evidence, fit: Fit) -> Float[np.ndarray, "K"]:
    """What the error of the edges in corrected predictions does to the shared coordinates, by one Gauss-Newton step.

    The next order of the extrapolation shows it. If a cable bends over less than an edge, as next to a gripper, an
    estimate may rest on it.

    Args:
        evidence: of a `SpatialCable.corrected`.
        fit: to it.
    """
    cable = evidence.simulator
    assert isinstance(cable, SpatialCable) and cable.correction is not None
    left = cable.exact(1).left_by_edges(fit.explanation)[:, FITTED]
    finer = dataclasses.replace(cable, correction=cable.correction + left)
    (there,) = evaluate(dataclasses.replace(evidence, simulator=finer), [fit.explanation])
    weight = evidence.weight(fit.sse)
    here, moved = fit.model(weight, 0.0), there.model(weight, 0.0)
    found = _step(here.curvature, moved.gradient - here.gradient, here.blocks, here.free)
    return _reached(found[: len(fit.explanation.z)])


def jackknife(evidence: Evidence, fit: Fit) -> Float[np.ndarray, "R K"]:
    """Change of the shared coordinates when each recording is left out, by one Gauss-Newton step (Miller 1974).

    Scaled so that the standard error of anything linear in them is the root of its sum of squares over rows. A value
    that the fit holds at its bound stays there for the others. Its own changes are those that it would make without
    the bound: that it cannot be lower does not make it certain.
    """
    label = independent(np.asarray(evidence.simulator.recording)[evidence.episodes])
    weight, names = evidence.weight(fit.sse), np.unique(label)
    models = [fit.model(weight, 0.0), *(fit.model(np.where(label != name, weight, 0.0), 0.0) for name in names)]
    free = models[0].free

    def moves(free):
        full, *others = (_step(model.curvature, model.gradient, model.blocks, free) for model in models)
        return np.array(others) - full

    both = np.where(free, moves(free), moves(np.ones_like(free)))[:, : len(fit.explanation.z)]
    return np.sqrt((len(names) - 1) / len(names)) * _reached(both)


def _step(
    curvature: Float[np.ndarray, "C C"],
    gradient: Float[np.ndarray, "C"],
    blocks: Sequence[Int[np.ndarray, "B"]],
    free: Bool[np.ndarray, "C"],
) -> Float[np.ndarray, "C"]:
    """Gauss and Newton's step of the free coordinates."""
    moving = free[:, None] & free
    return -solve_arrow(np.where(moving, curvature, np.diag(~free)), np.where(free, gradient, 0.0), blocks)


def _reached(change: Float[np.ndarray, "*rows C"]) -> Float[np.ndarray, "*rows C"]:
    """A change of each coordinate, or as much of it as the linear picture reaches."""
    return np.clip(change, -_LARGEST_STEP, _LARGEST_STEP)
