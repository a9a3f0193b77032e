"""What photographs of a hanging wire say: which effects, how stiff the wire is, and how sure that is.

An effect is named if two things hold, whatever the wire: its probability, summed over all explanations that have it, is
at least a half; and the gap in the photographs left out shrinks by it, with an interval that excludes zero.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq
from scipy.stats import norm, t

from cablejax.diagnose.belief import probabilities
from cablejax.spatial.hanging_effects import EFFECTS
from cablejax.spatial.hanging_fit import CALIBRATION, EXPLANATIONS, Photographs, WireFit, fit_wire

NAMED = 0.5
"""Least probability of an effect that is named."""

_INTERVAL = 0.9


@dataclasses.dataclass(frozen=True)
class WireDiagnosis:
    """The verdict on one wire.

    Attributes:
        verdict: as in the format.
        fits: of all explanations, the most probable one first.
        chances: their probabilities, shape [F].
        inclusion: the probability of each effect.
        chosen: the explanation with the named effects and no other.
        equivalent: sets of effects that these photographs cannot tell apart.
        before, after: root mean square gap of the photographs left out [m], of the wire as believed and as chosen.
        floor: noise of a traced coordinate [m].
        shrinkage: of the squared gap, with its 90 % interval.
        stiffness: EI over the believed one, with its 90 % interval, over all explanations that fit it.
    """

    verdict: str
    fits: tuple[WireFit, ...]
    chances: Float[np.ndarray, " F"]
    inclusion: dict[str, float]
    chosen: WireFit
    equivalent: tuple[tuple[str, ...], ...]
    before: float
    after: float
    floor: float
    shrinkage: tuple[float, float, float]
    stiffness: tuple[float, float, float]

    def fit(self, *names: str) -> WireFit:
        """The fit of an explanation."""
        return next(fit for fit in self.fits if set(fit.names) == set(names))


def diagnose_wire(photographs: Photographs, progress: Callable[[str], None] = lambda text: None) -> WireDiagnosis:
    """Diagnoses one wire. Needs JAX in double precision.

    Args:
        photographs: of the wire, at least three.
        progress: is told how it goes.
    """
    fits = fit_wire(photographs, EXPLANATIONS, progress)
    chances = probabilities(np.array([fit.score for fit in fits]))
    order = np.argsort(-chances)
    fits, chances = [fits[k] for k in order], chances[order]
    nominal = next(fit for fit in fits if not fit.names)
    inclusion = {
        name: float(sum(chance for fit, chance in zip(fits, chances, strict=True) if name in fit.names))
        for name in EFFECTS
    }
    floor = tracing_noise(photographs.points)
    likely = tuple(name for name in EFFECTS if inclusion[name] >= NAMED)
    chosen = next((fit for fit in fits if set(fit.names) == set(likely)), nominal)
    shrinkage = _shrinkage(nominal.held_out, chosen.held_out, floor)
    if not shrinkage[1] > 0:
        chosen, shrinkage = nominal, _shrinkage(nominal.held_out, nominal.held_out, floor)
    smallest = CALIBRATION.smallest_gap(0.0) / CALIBRATION.baseline * photographs.error
    gap, left = _rms(nominal.held_out), _rms(chosen.held_out)
    equivalent = _equivalent(chosen, fits, chances)
    if gap <= smallest:
        verdict, chosen, equivalent = "none", nominal, ()
    elif not chosen.names:
        verdict = "unknown"
    elif left > max(CALIBRATION.adequate * gap, smallest):
        verdict = "named+unknown"
    else:
        verdict = "ambiguous" if equivalent else "named"
    return WireDiagnosis(
        verdict, tuple(fits), chances, inclusion, chosen, equivalent, gap, _rms(chosen.held_out), floor, shrinkage,
        _stiffness(fits, chances),
    )  # fmt: skip


def tracing_noise(points: Float[np.ndarray, "R N 2"]) -> float:
    """Noise of a traced coordinate [m], from fourth differences along the wire, to which its shape adds little."""
    return float(np.sqrt((np.diff(points, n=4, axis=1) ** 2).mean() / 70))


def rig_error(ends: Float[np.ndarray, "R 2"]) -> float:
    """Root mean square error of a coordinate [m] that photographs of one rig show.

    Args:
        ends: from the first clamp to the second, in every photograph of the rig [m]; the rig itself keeps this.
    """
    return float(np.sqrt(ends.var(axis=0, ddof=1).mean()))


def verdict_of(diagnosis: WireDiagnosis, length: float) -> dict[str, Any]:
    """The verdict in the format `cablejax-verdict/1`; `stiffness_ratio` and `inclusion` come on top of it."""
    chosen, before = diagnosis.chosen, diagnosis.before
    effects = []
    for name in chosen.names:
        place = None
        values = chosen.values(name)
        if len(values) == 3:
            place = [max(values[0] - values[1] / 2, 0.0) * length, min(values[0] + values[1] / 2, 1.0) * length]
        effects.append(
            {
                "name": name,
                "probability": diagnosis.inclusion[name],
                "parameters": _parameters(chosen, name, length),
                "location": {"along_cable_m": place, "time_s": None, "table_m": None},
            }
        )
    return {
        "schema": "cablejax-verdict/1",
        "verdict": diagnosis.verdict,
        "effects": effects,
        "equivalent": [list(names) for names in diagnosis.equivalent],
        "ranking": [
            {
                "name": name,
                "probability": diagnosis.inclusion[name],
                "held_out_shrinkage": _shrinkage(
                    diagnosis.fit().held_out, diagnosis.fit(name).held_out, diagnosis.floor
                )[0],
            }
            for name in sorted(EFFECTS, key=lambda name: -diagnosis.inclusion[name])
        ],
        "gap": {
            "horizon_s": 0.0,
            "before_rmse_mm": 1e3 * before,
            "noise_floor_mm": 1e3 * diagnosis.floor,
            "after_rmse_mm": 1e3 * diagnosis.after,
            "shrinkage": diagnosis.shrinkage[0],
            "shrinkage_ci90": list(diagnosis.shrinkage[1:]),
            "held_out_episodes": list(range(len(chosen.held_out))),
        },
        "where": {
            "along_cable_mm": _along(diagnosis.fit()),
            "per_episode_mm": (1e3 * diagnosis.fit().held_out).tolist(),
            "regimes": {},
        },
        "next_motion": "mirror" if diagnosis.equivalent else None,
        "inclusion": diagnosis.inclusion,
        "stiffness_ratio": {"value": diagnosis.stiffness[0], "ci90": list(diagnosis.stiffness[1:])},
    }


def _rms(values: Float[np.ndarray, " R"]) -> float:
    return float(np.sqrt((values**2).mean()))


def _along(fit: WireFit) -> list[float]:
    """Root mean square gap of each traced point [mm]; the ends are given."""
    inner = fit.residual.reshape(len(fit.residual), -1, 2)
    return [0.0, *(1e3 * np.sqrt((inner**2).sum(axis=-1).mean(axis=0))).tolist(), 0.0]


def _parameters(fit: WireFit, name: str, length: float) -> dict[str, Any]:
    """Values with 90 % intervals: posterior and leave-one-out spread together, in the fitted coordinates."""
    first = sum(len(EFFECTS[other]) for other in list(EFFECTS)[: list(EFFECTS).index(name)])
    told = {}
    for k, parameter in enumerate(EFFECTS[name], first):
        half = _half_width(fit, k)
        unit, scale = (parameter.unit, 1.0) if parameter.name not in ("centre", "width") else ("m", length)
        z = np.asarray([fit.z[k], fit.z[k] - half, fit.z[k] + half])
        value, low, high = (scale * np.clip(parameter.value(z), parameter.low, parameter.high)).tolist()
        label = f"{parameter.name}_m" if unit == "m" else parameter.name
        told[label] = {"value": value, "ci90": [low, high], "unit": unit}
    return told


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
