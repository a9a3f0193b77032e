"""What photographs of a hanging wire say: which effects, how stiff the wire is, and how sure that is.

An effect is named if two things hold, whatever the wire: its probability, summed over all explanations that have it, is
at least a half; and the gap in the photographs left out shrinks by it, with an interval that excludes zero.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq
from scipy.stats import norm, t

from cablejax.diagnose.belief import probabilities
from cablejax.diagnose.diagnosis import Diagnosis, Gap, NamedEffect, ParameterEstimate, Ranked
from cablejax.diagnose.judgement import judged, verdict_sentence
from cablejax.diagnose.verdict_json import verdict_json
from cablejax.diagnose.where import LEVEL, Where
from cablejax.diagnose.where_words import describe
from cablejax.spatial.gap import split_of
from cablejax.spatial.hanging_effects import EFFECTS, SLICES
from cablejax.spatial.hanging_fit import CALIBRATION, EXPLANATIONS, Photographs, WireFit, fit_wire

NAMED = 0.5
"""Least probability of an effect that is named."""

_INTERVAL = 0.9


@dataclasses.dataclass(frozen=True, kw_only=True)
class WireDiagnosis(Diagnosis):
    """The findings on one wire. Its episodes are the photographs.

    Attributes:
        fits: of all explanations, the most probable one first.
        chances: their probabilities, shape [F].
        inclusion: the probability of each effect.
        chosen: the explanation with the named effects and no other.
        stiffness: EI over the believed one, with its 90 % interval, over all explanations that fit it.
    """

    fits: tuple[WireFit, ...]
    chances: Float[np.ndarray, " F"]
    inclusion: dict[str, float]
    chosen: WireFit
    stiffness: tuple[float, float, float]

    def fit(self, *names: str) -> WireFit:
        """The fit of an explanation."""
        return next(fit for fit in self.fits if set(fit.names) == set(names))


def diagnose_wire(photographs: Photographs, progress: Callable[[str], None] = lambda text: None) -> WireDiagnosis:
    """Diagnoses one wire. Needs JAX in double precision.

    Args:
        photographs: of the wire, at least three.
        progress: called with a line of text after each explanation.
    """
    begun = time.perf_counter()
    fits = fit_wire(photographs, EXPLANATIONS, progress)
    chances = probabilities(np.array([fit.score for fit in fits]))
    order = np.argsort(-chances)
    fits, chances = [fits[k] for k in order], chances[order]
    by_names = {frozenset(fit.names): fit for fit in fits}
    nominal = by_names[frozenset()]
    inclusion = {
        name: float(sum(chance for fit, chance in zip(fits, chances, strict=True) if name in fit.names))
        for name in EFFECTS
    }
    floor = tracing_noise(photographs.points)
    likely = frozenset(name for name in EFFECTS if inclusion[name] >= NAMED)
    chosen = by_names.get(likely, nominal)
    shrinkage = _shrinkage(nominal.held_out, chosen.held_out, floor)
    if not shrinkage[1] > 0:
        chosen = nominal
    equivalent = _equivalent(chosen, fits, chances)
    smallest = CALIBRATION.smallest_gap(0.0) / CALIBRATION.baseline * photographs.error
    before, left = _rms(nominal.held_out), _rms(chosen.held_out)
    verdict = judged(
        resolvable=before > smallest,
        telling=bool(chosen.names),
        complete=left <= max(CALIBRATION.adequate * before, smallest),
        alike=bool(equivalent),
    )
    if verdict == "none":
        chosen, equivalent = nominal, ()
    gap = _gap(nominal, chosen, floor, resolvable=verdict != "none")
    effects = tuple(_named(chosen, name, inclusion[name], photographs.length) for name in chosen.names)
    ranking = [
        Ranked(
            name,
            inclusion[name],
            _shrinkage(nominal.held_out, by_names[frozenset({name})].held_out, floor)[0],
            _above(by_names[frozenset({name})].residual ** 2, floor),
        )
        for name in sorted(EFFECTS, key=lambda name: -inclusion[name])
    ]
    return WireDiagnosis(
        verdict=verdict,
        sentence=verdict_sentence(verdict, effects, equivalent, ranking, gap.shrinkage or 0.0),
        effects=effects,
        equivalent=equivalent,
        ranking=tuple(ranking),
        leftover_p=None,
        gap=gap,
        where=_where(photographs, nominal, floor, smallest),
        next_motion=None,
        baselines={},
        caveats=(),
        seconds=time.perf_counter() - begun,
        settings={"calibration": dataclasses.asdict(CALIBRATION)},
        fits=tuple(fits),
        chances=chances,
        inclusion=inclusion,
        chosen=chosen,
        stiffness=_stiffness(fits, chances),
    )


def tracing_noise(points: Float[np.ndarray, "R N 2"]) -> float:
    """Noise of a traced coordinate [m], from fourth differences along the wire, to which its shape adds little."""
    return float(np.sqrt((np.diff(points, n=4, axis=1) ** 2).mean() / 70))


def rig_error(ends: Float[np.ndarray, "R 2"]) -> float:
    """Root mean square error of a coordinate [m] that photographs of one rig show.

    Args:
        ends: from the first clamp to the second, in every photograph of the rig [m]; the rig itself keeps this.
    """
    return float(np.sqrt(ends.var(axis=0, ddof=1).mean()))


def wire_verdict_json(diagnosis: WireDiagnosis) -> dict[str, Any]:
    """The verdict in the format `cablejax-verdict/1`, with `stiffness_ratio`: EI over the believed one."""
    value, *interval = diagnosis.stiffness
    return {**verdict_json(diagnosis), "stiffness_ratio": {"value": value, "ci90": interval, "unit": ""}}


def _rms(values: Float[np.ndarray, " R"]) -> float:
    return float(np.sqrt((values**2).mean()))


def _above(squares: Float[np.ndarray, "*shape"], floor: float, axis: Any = None) -> Any:
    """Root mean square above the noise [mm] of squared errors [m^2]."""
    return 1e3 * np.sqrt(np.maximum(squares.mean(axis=axis) - floor**2, 0.0))


def _gap(nominal: WireFit, chosen: WireFit, floor: float, *, resolvable: bool) -> Gap:
    before, after = _rms(nominal.held_out), _rms(chosen.held_out)
    shrinkage = _shrinkage(nominal.held_out, chosen.held_out, floor) if resolvable else None
    return Gap(
        horizon_s=0.0,
        before_rmse_mm=1e3 * before,
        after_rmse_mm=1e3 * after,
        noise_floor_mm=1e3 * floor,
        shrinkage=None if shrinkage is None else shrinkage[0],
        shrinkage_ci90=None if shrinkage is None else shrinkage[1:],
        ahead_mm=None,
        horizons_mm={},
        held_out_episodes=tuple(range(len(chosen.held_out))),
        split=split_of((floor / before) ** 2, (after / before) ** 2),
    )


def _where(photographs: Photographs, nominal: WireFit, floor: float, smallest: float) -> Where:
    """Sizes of the gap of the wire as believed; at the ends, which are given to the model, there is none."""
    squares = nominal.residual.reshape(len(nominal.residual), -1, 2) ** 2
    along = np.pad(_above(squares, floor, (0, 2)), 1)
    held_out = nominal.held_out[:, None] ** 2
    where = Where(
        gap_mm=float(_above(held_out, floor)),
        smallest_mm=1e3 * smallest,
        along_cable_mm=along,
        bend_per_m=None,
        per_episode_mm=_above(held_out, floor, 1),
        episode_p=None,
        keypoint_p=None,
        heat=np.pad(np.sqrt(squares.mean(axis=2)), ((0, 0), (1, 1)))[:, None] / floor,
        horizons_mm={},
        regimes={},
        frames={},
        contrasts={},
        regime_masks={},
        sentences=(),
    )
    names = [f"photograph {k + 1}" for k in range(len(squares))]
    places = np.linspace(0.0, photographs.length, len(along))
    return dataclasses.replace(where, sentences=describe(where, places, np.array([floor]), LEVEL, names))


def _named(fit: WireFit, name: str, probability: float, length: float) -> NamedEffect:
    """Values with 90 % intervals: posterior and leave-one-out spread together, in the fitted coordinates."""
    parameters: dict[str, ParameterEstimate] = {}
    for k, parameter in enumerate(EFFECTS[name], SLICES[name].start):
        half = _half_width(fit, k)
        unit, scale = (parameter.unit, 1.0) if parameter.name not in ("centre", "width") else ("m", length)
        z = np.asarray([fit.z[k], fit.z[k] - half, fit.z[k] + half])
        value, low, high = (scale * np.clip(parameter.value(z), parameter.low, parameter.high)).tolist()
        parameters[f"{parameter.name}_m" if unit == "m" else parameter.name] = ParameterEstimate(
            value, (low, high), unit
        )
    along, values = None, fit.values(name)
    if len(values) == 3:
        along = [max(values[0] - values[1] / 2, 0.0) * length, min(values[0] + values[1] / 2, 1.0) * length]
    return NamedEffect(name, probability, parameters, {"along_cable_m": along, "time_s": None, "table_m": None})


def _half_width(fit: WireFit, k: int) -> float:
    """Half of the 90 % interval of a coordinate."""
    count = len(fit.left_out_z)
    jackknife = (count - 1) * fit.left_out_z[:, k].var()
    return float(t.ppf(0.5 + _INTERVAL / 2, count - 1) * np.sqrt(jackknife + fit.spread[k] ** 2))


def _shrinkage(
    before: Float[np.ndarray, " R"], after: Float[np.ndarray, " R"], floor: float
) -> tuple[float, float, float]:
    """Shrinkage of the squared gap above the floor, and its 90 % interval by the jackknife over photographs."""

    def of(rows) -> float:
        gap = max(float((before[rows] ** 2).mean()) - floor**2, 1e-18)
        return 1.0 - max(float((after[rows] ** 2).mean()) - floor**2, 0.0) / gap

    everyone = np.arange(len(before))
    parts = np.array([of(np.delete(everyone, k)) for k in everyone])
    half = t.ppf(0.5 + _INTERVAL / 2, len(parts) - 1) * np.sqrt((len(parts) - 1) * parts.var())
    return of(everyone), of(everyone) - float(half), min(of(everyone) + float(half), 1.0)


def _equivalent(chosen: WireFit, fits: Sequence[WireFit], chances: np.ndarray) -> tuple[tuple[str, ...], ...]:
    """For each named effect, those that may be in its place: the package's rule of odds."""
    odds = {frozenset(fit.names): float(chance) for fit, chance in zip(fits, chances, strict=True)}
    own = odds[frozenset(chosen.names)]
    sets = []
    for name in chosen.names:
        rest = set(chosen.names) - {name}
        least = CALIBRATION.set_odds * own
        others = [o for o in EFFECTS if o not in chosen.names and odds[frozenset({*rest, o})] >= least]
        if others:
            sets.append((name, *others))
    return tuple(sets)


def _stiffness(fits: Sequence[WireFit], chances: np.ndarray) -> tuple[float, float, float]:
    """Median and 90 % interval of EI over the believed one, mixed over the explanations that fit it."""
    parameter = EFFECTS["bending_stiffness"][0]
    parts = [(float(c), fit) for fit, c in zip(fits, chances, strict=True) if "bending_stiffness" in fit.names]
    weights = np.array([c for c, _ in parts]) / sum(c for c, _ in parts)
    centres = np.array([fit.z[0] for _, fit in parts])
    spreads = np.array([_half_width(fit, 0) for _, fit in parts]) / norm.ppf(0.5 + _INTERVAL / 2)

    def quantile(share: float) -> float:
        def missing(z):
            return float((weights * norm.cdf(z, centres, spreads)).sum()) - share

        reach = 20 * spreads.max() + np.ptp(centres)
        z = brentq(missing, centres.min() - reach, centres.max() + reach)
        return float(parameter.value(np.asarray(z)))

    return quantile(0.5), quantile(0.5 - _INTERVAL / 2), quantile(0.5 + _INTERVAL / 2)
