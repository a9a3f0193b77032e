"""The adapter of cables in space: windows of motion, simulated by the rod, behind the protocol of simulators.

A window is an episode. Distances between simulated and recorded markers count as pseudo-Huber: a window in which the
cable swings over another way must not decide alone. They stay the same for tenths of a second, so a sample counts as
the share of a correlation time that it stands for, in units of what a good fit leaves.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses

import jax
import numpy as np
from jaxtyping import Float, Int

from cablejax.cores import available_cores
from cablejax.diagnose.belief import LEAST_SQUARES
from cablejax.diagnose.evidence import Evidence, Robust
from cablejax.diagnose.protocol import Explanation, Plan, Simulator
from cablejax.simulate.rod import Rod
from cablejax.spatial.accidents import moderated, trust
from cablejax.spatial.effects import GRIP, Layout
from cablejax.spatial.rods import compiled_rod, limit
from cablejax.spatial.windows import FITTED, Windows

GOOD_FIT = 0.01
"""Error of a good fit [m]: unit of the residuals."""
TWISTED = "intrinsic_curvature"
"""The effect that needs the material frame, whose derivatives take four times as long as all others together."""
_CHUNK = 4
# The number of directions of a derivative is rounded up to a multiple of this, so that few programs are compiled.
_COLUMNS = 8
# What a simulation has lost is off by this [m].
_LOST = 1.0
# In fits it counts for less: one lost window must not outweigh all others.
_ROBUST = Robust(distance=0.02, lost=0.1, steepest=10.0)
_CORRELATION = 0.3  # [s]
FINER = 4
"""Time steps that estimates are corrected for, in place of each of a fit."""
# Predictions are extrapolated from the rod's number of edges and this one, of which the next order needs one between.
# Above 32 edges LAPACK's matrices are large enough for OpenBLAS to share among threads, which takes longer by far.
_MORE_EDGES = 1.6
# Nats per window: a step that promises less is not worth the simulations that it takes.
_TOLERANCE = 0.1
# Steps end by the tolerance. This is for fits that creep.
_MOST_STEPS = 40


@dataclasses.dataclass(frozen=True)
class SpatialCable(Simulator):
    """The rod of one cable between the clamps of some windows.

    Attributes:
        rod: resolution; the material frame is followed where an explanation needs it.
        layout: of the effects.
        windows: to simulate.
        edges: numbers of edges from whose motions that of ever more edges is extrapolated; () = the rod's alone.
        shown: so many samples of each window the simulation is given, see `Rod.rollout`.
        correction: added to what is predicted in the windows, see `corrected`, shape [W, T, F, 3]; None = nothing.
    """

    rod: Rod
    layout: Layout
    windows: Windows
    edges: tuple[int, ...] = ()
    shown: int = 2
    correction: Float[np.ndarray, "W T F 3"] | None = None

    @property
    def effects(self):  # type: ignore[override]
        """The effects of the layout."""
        return self.layout.effects

    @property
    def recording(self) -> Int[np.ndarray, "E"]:  # type: ignore[override]
        """The recording of each window."""
        return self.windows.group

    @property
    def plan(self) -> Plan:  # type: ignore[override]
        """Fits end by a tolerance for each window; either half of the recordings is left out."""
        return Plan(last_steps=_MOST_STEPS, tolerance=_TOLERANCE * len(self.windows), parts=2)

    def on(self, windows: Windows) -> SpatialCable:
        """The same cable in other windows, without correction."""
        return dataclasses.replace(self, windows=windows, correction=None)

    def chosen(self, index) -> SpatialCable:
        """The same cable in some of the windows, without correction."""
        return self.on(self.windows.chosen(index))

    def some(self, count: int) -> SpatialCable:
        """The same cable in at most so many windows, see `Windows.whole`, without correction."""
        return self.chosen(self.windows.whole(count))

    def trusting(self, error: Float[np.ndarray, "W"]) -> SpatialCable:
        """The same cable and windows, with less weight in fits for windows that are off by their errors [m]."""
        return self.on(dataclasses.replace(self.windows, trust=self.windows.trust * trust(error)))

    def finer(self, factor: int) -> SpatialCable:
        """The same cable with time steps that are so many times shorter, including those in fast motion."""
        rod = self.rod
        finer = dataclasses.replace(rod, substeps=factor * rod.substeps, local_error=rod.local_error / factor**3)
        return dataclasses.replace(self, rod=finer)

    def exact(self, finer: int = FINER) -> SpatialCable:
        """The same cable with the predictions to which estimates are corrected, without correction.

        Edges are straight, and their error falls with the square of their number: what two numbers predict is
        extrapolated (Richardson 1911), less so where they are apart by more than a good fit leaves: a motion that
        amplifies small differences has no limit to be reached by this. Little of the error is left where a cable bends
        over many edges, most of it where it hangs like a chain; `left_by_edges` shows it.

        Args:
            finer: so many time steps in place of each.
        """
        rod = dataclasses.replace(self.rod, substeps=finer * self.rod.substeps)
        return dataclasses.replace(self, rod=rod, edges=self._orders[1], correction=None)

    def with_most_edges(self) -> SpatialCable:
        """What `exact` returns, with the largest of its numbers of edges alone."""
        return dataclasses.replace(self, edges=self._orders[0])

    def left_by_edges(self, one: Explanation) -> Float[np.ndarray, "W T F 3"]:
        """What the next order of the extrapolation would change in the motion of `exact` or `with_most_edges` [m]."""
        numbers = self._orders[len(self.edges)]
        each = [dataclasses.replace(self, edges=(n,)).motion(one) for n in numbers]
        return limit(numbers, each) - self.motion(one)

    @property
    def _orders(self) -> tuple[tuple[int, ...], ...]:
        """Numbers of edges by orders of the extrapolation."""
        count = self.rod.n_edges
        most, between = round(_MORE_EDGES * count), round(_MORE_EDGES**0.5 * count)
        return (most,), (count, most), (count, between, most)

    def corrected(self, one: Explanation) -> SpatialCable:
        """The cable with the predictions of `exact` at these values, and the derivatives of this rod.

        The difference of the two at `one` is added to every prediction. If fits are repeated, each with the difference
        at the last result, until the values settle, the residuals are those of `exact`, at the cost of this rod's
        derivatives.
        """
        plain, every = dataclasses.replace(self, correction=None), np.arange(len(self.windows))
        exact, coarse = (cable.predict([one], every)[0] for cable in (self.exact(), plain))
        return dataclasses.replace(self, correction=exact - coarse)

    def own(self, one: Explanation) -> int:
        """Number of parameters of each recording alone, those of its grip."""
        return sum(len(e.null) for e in self.layout.effects if e.own and e.name in one.names)

    def motion(self, one: Explanation) -> Float[np.ndarray, "W T F 3"]:
        """Free markers at every sample [m], constant after the last recorded one; NaN after the last solved one."""
        return self.rollouts(one)[0]

    def rollouts(self, one: Explanation, episodes=None) -> tuple[Float[np.ndarray, "E T F 3"], Int[np.ndarray, "E"]]:
        """The free markers of `motion`, and the `RodResult` of each window; `episodes` are windows, None = all."""
        episodes = np.arange(len(self.windows)) if episodes is None else episodes
        numbers = self.edges or (self.rod.n_edges,)
        motions, results = zip(*(self._simulated(n, one, episodes) for n in numbers), strict=True)
        fine = motions[-1]
        apart = np.linalg.norm(fine - motions[0], axis=-1, keepdims=True)
        step = (limit(numbers, motions) - fine) / (1.0 + (apart / GOOD_FIT) ** 2)
        return fine + step, np.max(results, axis=0)

    def _simulated(self, n_edges: int, one: Explanation, episodes):
        """Free markers and `RodResult`s of a rod of so many edges, with the same longest local error in metres."""
        rod = dataclasses.replace(
            self.rod, n_edges=n_edges, local_error=self.rod.local_error * n_edges / self.rod.n_edges
        )
        return tuple(map(np.concatenate, zip(*self._in_parallel(rod, one, episodes), strict=True)))

    def predict(self, explanations, episodes) -> Float[np.ndarray, "X E T F 3"]:
        """Free markers [m] at the samples that are compared; NaN from where on the simulation was not solved."""
        found = np.stack([self.rollouts(one, episodes)[0][:, FITTED] for one in explanations])
        return found if self.correction is None else found + self.correction[episodes]

    def linearise(self, explanations, episodes):
        """Forward derivatives: exact of the rod, which stand for those of what is predicted."""
        result = []
        for one in explanations:
            directions, own = self.directions(one)
            predicted, slopes = self.along(one, directions, episodes)
            if self.edges:
                predicted = self.predict([one], episodes)[0]
            elif self.correction is not None:
                predicted = predicted + self.correction[episodes]
            result.append((predicted, slopes[own]))
        return result

    def along(
        self, one: Explanation, directions: Float[np.ndarray, "K P"], episodes: Int[np.ndarray, "E"]
    ) -> tuple[Float[np.ndarray, "E T F 3"], Float[np.ndarray, "K E T F 3"]]:
        """Free markers [m] of the rod alone at the samples that are compared, and their derivatives.

        Args:
            one: where.
            directions: in the vector of physical values, along which derivatives are taken: forward, exact.
            episodes: windows to simulate.
        """
        count = len(directions)
        rows = np.zeros((max(_COLUMNS * -(-count // _COLUMNS), _COLUMNS), self.layout.size))
        rows[:count] = directions
        parts = self._in_parallel(self.rod, one, episodes, rows)
        predicted = np.concatenate([part[0] for part in parts])[:, FITTED]
        slopes = np.concatenate([part[1][:, :, FITTED] for part in parts])
        return predicted, np.moveaxis(slopes, 1, 0)[:count]

    def evidence(self) -> Evidence:
        """The windows, weighed for fits."""
        windows, stride = self.windows, FITTED.step
        unit = GOOD_FIT * np.sqrt(3 * _CORRELATION / (stride * windows.interval))
        return Evidence(
            simulator=self,
            episodes=np.arange(len(windows)),
            observed=windows.observed[:, FITTED],
            nominal=np.zeros_like(windows.keypoints[:, FITTED]),
            noise=np.full((windows.keypoints.shape[2], 1), unit),
            temper=1 / windows.trust,
            freedom=LEAST_SQUARES,
            motion=np.arange(len(windows)),
            robust=_ROBUST,
        )

    def _in_parallel(self, rod: Rod, one: Explanation, episodes, directions: Float[np.ndarray, "K P"] | None = None):
        """Batches of one size, so that one compilation serves, by as many threads as there are cores.

        Of each batch the free markers and the `RodResult`s, or with `directions` the markers and their derivatives.
        """
        rod = dataclasses.replace(rod, twisting=TWISTED in one.names)
        simulate, differentiate = compiled_rod(rod, self.layout, self.windows.interval)
        run, more = (simulate, ()) if directions is None else (differentiate, (directions,))
        windows, values = self.windows.chosen(episodes), self._values(one, episodes)
        # one rollout's operations are too small to share; a window alone is not worth a batch
        size = _CHUNK if len(windows) > 1 else 1

        def batch(begin):
            index = np.arange(begin, min(begin + size, len(windows)))
            full = np.concatenate([index, np.full(size - len(index), index[0])])
            part = windows.chosen(full)
            # up to the last sample that is recorded in one of them
            wanted = 1 + np.flatnonzero(part.valid.any(axis=0))[-1]
            found = run(values[full], *more, wanted, part.position, part.frames, part.observed[:, : self.shown])
            return jax.tree.map(lambda a: np.asarray(a)[: len(index)], found)

        with concurrent.futures.ThreadPoolExecutor(available_cores()) as pool:
            return list(pool.map(batch, range(0, len(windows), size)))

    def _values(self, one: Explanation, episodes) -> Float[np.ndarray, "e P"]:
        """Physical values of every window; a recording that has no row of its own has what all share."""
        one, group = self.with_own(one), self.windows.group[episodes]
        values = np.repeat(one.vector(self.effects)[None], len(group), axis=0)
        if one.own.size:
            values[:, self._own_slots] += GRIP * one.own[group]
        return values

    def directions(self, one: Explanation) -> tuple[Float[np.ndarray, "K P"], Int[np.ndarray, "C"]]:
        """Rows of derivatives of the vector by the coordinates, and which of them each column of a fit is."""
        slots = {e.name: np.arange(self.layout.size)[self.layout.slots(e.name)] for e in self.effects}
        columns = np.concatenate([np.zeros(0, int), *(slots[name] for name in one.names)])
        parameters = [p for term in one.terms for p in term.effect.parameters]
        values = np.concatenate([np.zeros(0), *one.values()])
        count = len(columns)
        rows = np.zeros((count, self.layout.size))
        rows[np.arange(count), columns] = [
            p.scale * (v if p.log else 1.0) for p, v in zip(parameters, values, strict=True)
        ]
        # what a recording adds moves the same values, in the same units
        own = np.flatnonzero(np.isin(columns, self._own_slots)) if one.own.size else np.zeros(0, int)
        return rows, np.concatenate([np.arange(count), own])

    @property
    def _own_slots(self) -> Int[np.ndarray, "M"]:
        every = np.arange(self.layout.size)
        return np.concatenate([every[self.layout.slots(e.name)] for e in self.layout.effects if e.own])


def mean_error(predicted: Float[np.ndarray, "W T F 3"], observed: Float[np.ndarray, "W T F 3"]) -> np.ndarray:
    """Mean absolute error of each window's observed coordinates [m], shape [W]; 0 where none is observed."""
    seen = np.isfinite(observed)
    off = np.where(seen, bounded(predicted - observed), 0.0)
    return off.sum(axis=(1, 2, 3)) / np.maximum(seen.sum(axis=(1, 2, 3)), 1)


def typical_error(evidence: Evidence, one: Explanation) -> float:
    """Mean of `mean_error` over windows, each limited to ten times the median [m]."""
    return float(moderated(mean_error(evidence.predict([one])[0], evidence.observed)).mean())


def bounded(off: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Sizes of errors [m]; lost simulations, NaN included, count as a metre."""
    return np.minimum(np.nan_to_num(np.abs(off), nan=_LOST, posinf=_LOST), _LOST)


def errors(predicted: Float[np.ndarray, "W T F 3"], windows: Windows) -> Float[np.ndarray, "W"]:
    """Mean absolute error of a coordinate of the free markers, from the third sample on [m]."""
    return mean_error(predicted[:, 2:], windows.observed[:, 2:])
