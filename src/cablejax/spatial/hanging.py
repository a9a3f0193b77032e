"""The adapter of hanging wires: photographs of a wire at rest behind the protocol of simulators.

Each photograph is an episode of one sample and a recording of its own; the angles of both clamps are what it has for
its own, nuisances that are fitted in every explanation alike, and to photographs that are held out too. Errors of one
photograph are one error: its coordinates count as correlated samples, and the error of the rig is the baseline.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq
from scipy.special import softmax
from scipy.stats import norm, t

from cablejax.diagnose.belief import LEAST_SQUARES, Calibration, log_scores
from cablejax.diagnose.diagnosis import Diagnosis
from cablejax.diagnose.fit import Fit, evaluate, improve
from cablejax.diagnose.given_arrays import checked_nominal
from cablejax.diagnose.noise import noise_floor
from cablejax.diagnose.protocol import Explanation, Plan, Report, Simulator, in_batches
from cablejax.diagnose.refits import refitted
from cablejax.diagnose.run import Examined, examine, settings_of, weighed
from cablejax.diagnose.search import Search
from cablejax.diagnose.verdict_json import verdict_json
from cablejax.diagnose.where import sizes_of
from cablejax.spatial.hanging_effects import CLAMP_ANGLE, EFFECTS, PARAMETERS, wire_shape

LINKS_PER_SPACING = 2
"""Links of the model from one traced point to the next."""

_TAIL = 0.95

_RIG = 0.05
"""Part of the wire's length that is no error of a rig any more."""


@dataclasses.dataclass(frozen=True)
class Photographs:
    """Photographs of one wire.

    Attributes:
        points: traced at equal arc lengths, horizontal and vertical coordinate [m], shape [R, N, 2].
        length: of the wire [m].
        stiffness: EI over the weight per length that is believed true [m^3].
        error: root mean square error of a coordinate that the rig shows [m].

    Raises:
        ValueError: too few points, another scale or length, or a wire that does not hang down, from left to right.
    """

    points: Float[np.ndarray, "R N 2"]
    length: float
    stiffness: float
    error: float

    def __post_init__(self):
        object.__setattr__(self, "points", np.asarray(self.points, float))
        shape = self.points.shape
        if len(shape) != 3 or shape[0] < 3 or shape[1] < 5 or shape[2] != 2 or not np.isfinite(self.points).all():
            raise ValueError(
                f"Photographs have points of shape {shape}, expected finite ones of shape [R, N, 2] with at least "
                "three photographs, so that one can be held out, and at least five points."
            )
        for name in ("length", "stiffness", "error"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"Photographs.{name} is {getattr(self, name)}, expected a positive number.")
        longest = np.linalg.norm(np.diff(self.points, axis=1), axis=-1).sum(axis=1).max()
        if not 0.9 * self.length < longest < 1.02 * self.length:
            raise ValueError(
                f"Along its traced points the wire measures {longest:.4g} m, expected its length, {self.length:g} m: "
                "check the scale of the photographs."
            )
        if not self.error < _RIG * self.length:
            raise ValueError(
                f"Photographs.error is {self.error:.3g} m, expected less than {_RIG:.0%} of the wire's length, "
                f"{self.length:g} m: with a larger one no deviation would count as a gap. `rig_error` holds for clamps "
                "that stay in one place."
            )
        first, last = (np.median(self.points[:, b, 0] - self.points[:, a, 0]) for a, b in ((0, 1), (-2, -1)))
        if first < 0 and last < 0:
            raise ValueError(
                "The wire runs from right to left at both clamps, expected the first coordinate to grow: reverse the "
                "order of the points, or negate their first coordinate."
            )
        ends = self.points[:, [0, -1], 1].mean(axis=1)
        if np.median(self.points[:, 1:-1, 1].mean(axis=1) - ends) > 0:
            raise ValueError(
                "The wire hangs upwards from its clamps, expected the second coordinate to grow upwards: negate it if "
                "it counts pixels of an image downwards."
            )

    @property
    def guess(self) -> Float[np.ndarray, "R M"]:
        """Angles of the model's links as they are traced [rad]."""
        along = np.diff(self.points, axis=1)
        return np.repeat(np.unwrap(np.arctan2(along[..., 1], along[..., 0]), axis=1), LINKS_PER_SPACING, axis=1)


class HangingWire(Simulator):
    """One wire in its photographs, between the traced ends.

    Args:
        photographs: of the wire.

    Raises:
        ValueError: JAX computes in single precision.
    """

    effects = EFFECTS
    plan = Plan(first_steps=40, last_steps=100, grown_steps=100, tolerance=1e-4, parts=1000)
    fits_unseen = True

    def __init__(self, photographs: Photographs):
        if jnp.zeros(()).dtype != jnp.float64:
            raise ValueError("Fits of hanging wires need double precision: call them under jax.enable_x64(True).")
        self.photographs = photographs
        self.recording = range(len(photographs.points))

    def own(self, one) -> int:
        """The angles of both clamps."""
        return 2

    def predict(self, explanations, episodes) -> Float[np.ndarray, "X E 1 N 2"]:
        """Points of the wire [m] in each photograph."""
        return self._run(explanations, episodes)[:, :, :1]

    def linearise(self, explanations, episodes):
        """By the implicit function theorem, exact."""
        result, owner = [], np.array([effect.name for effect in self.effects for _ in effect.parameters])
        for one, found in zip(explanations, self._run(explanations, episodes), strict=True):
            columns = [column for name in one.names for column in np.flatnonzero(owner == name)]
            slopes = np.moveaxis(found[:, 1:], 1, 0)[[*columns, -2, -1]]
            result.append((found[:, :1], slopes[:, :, None]))
        return result

    def report(self, term, values) -> Report:
        """In metres along the wire."""
        length, parameters = self.photographs.length, {}
        for parameter, value in zip(term.effect.parameters, values, strict=True):
            along = parameter.name in ("centre", "width")
            name, unit = (f"{parameter.name}_m", "m") if along else (parameter.name, parameter.unit)
            parameters[name] = float(np.clip(value, parameter.low, parameter.high)) * (length if along else 1), unit
        if "width_m" not in parameters:
            return Report(parameters, {})
        centre, half = parameters["centre_m"][0], parameters["width_m"][0] / 2
        return Report(parameters, {"along_cable_m": [max(centre - half, 0.0), min(centre + half, length)]})

    def _run(self, explanations: Sequence[Explanation], episodes) -> Float[np.ndarray, "X E 11 N 2"]:
        """Points, and their derivatives by the coordinates of all effects and by what the photograph has of its own."""
        count = len(PARAMETERS)
        z = np.zeros((len(explanations), len(episodes), count + 2))
        for row, one in zip(z, explanations, strict=True):
            present = {term.effect.name: part for term, part in one.by_term()}
            shared = [present.get(e.name, [p.coordinate(v) for p, v in zip(e.parameters, e.null, strict=True)])
                      for e in self.effects]  # fmt: skip
            row[:, :count] = np.concatenate(shared)
            row[:, count:] = self.with_own(one).own[np.asarray(episodes, int)]
        p = self.photographs
        points, guess = p.points[episodes], p.guess[episodes]
        believed, length = np.full(len(points), p.stiffness), np.full(len(points), p.length)
        return in_batches(_points_and_slopes, z, points, guess, believed, length, size=len(p.points))


@jax.jit
@jax.vmap
def _points_and_slopes(z, traced, guess, stiffness, length):
    def points(z):
        return wire_shape(z[:-2], CLAMP_ANGLE * z[-2:], traced, guess, stiffness, length)

    return jnp.concatenate([points(z)[None], jnp.moveaxis(jax.jacfwd(points)(z), -1, 0)])


@dataclasses.dataclass(frozen=True, kw_only=True)
class WireDiagnosis(Diagnosis):
    """The findings on one wire. Its episodes are the photographs.

    Attributes:
        stiffness: EI over the believed one, with its 90 % interval, over all explanations that fit it.
        examined: fits, and points of the wire as believed and with what explains it best.
    """

    stiffness: tuple[float, float, float]
    examined: Examined


def diagnose_wire(photographs: Photographs, progress: Callable[[str], None] = lambda text: None) -> WireDiagnosis:
    """Diagnoses one wire. Needs JAX in double precision.

    Args:
        photographs: of the wire, at least three.
        progress: called with a line of text before each stage.
    """
    begun = time.perf_counter()
    wire, noise = HangingWire(photographs), tracing_noise(photographs.points)
    observed = photographs.points[:, None].copy()
    # where the wire leaves the clamps is given to the model
    observed[:, :, [0, -1]] = np.nan
    calibration = Calibration(
        baseline=photographs.error,
        correlated_samples=observed[0].size - 4,
        fit_freedom=LEAST_SQUARES,
        prior_cost=1.0,
        as_good=1.0,
        max_effects=2,
    )
    spread = np.full((observed.shape[2], 1), noise)
    nominal = checked_nominal(wire, observed, spread)
    everyone = np.arange(len(observed))
    evidence = weighed(wire, observed, nominal, spread, everyone, calibration)
    examined = examine(evidence, np.ones(len(observed)), calibration, progress=progress)
    where = sizes_of(
        (observed - examined.before) ** 2,
        noise,
        np.linspace(0.0, photographs.length, observed.shape[2]),
        smallest_mm=1e3 * calibration.smallest_gap(noise),
        names=[f"photograph {k + 1}" for k in everyone],
    )
    return WireDiagnosis(
        **examined.fields(),
        where=where,
        seconds=time.perf_counter() - begun,
        settings=settings_of(wire, calibration),
        stiffness=_stiffness(examined.found),
        examined=examined,
    )


def tracing_noise(points: Float[np.ndarray, "R N 2"]) -> float:
    """Noise of a traced coordinate [m], from fourth differences along the wire, to which its shape adds little."""
    return float(noise_floor(points[:, :, None], None, order=4).std[0])


def rig_error(ends: Float[np.ndarray, "R 2"]) -> float:
    """Root mean square error of a coordinate [m] that photographs of one rig show.

    Args:
        ends: from the first clamp to the second, in every photograph of the rig [m]; the rig itself keeps this.

    Raises:
        ValueError: not at least two photographs, or not finite.
    """
    if np.ndim(ends) != 2 or len(ends) < 2 or not np.isfinite(ends).all():
        raise ValueError(
            f"The ends have shape {np.shape(ends)}, expected finite ones of shape [R, 2] of two photographs or more: "
            "state the error of one."
        )
    return float(np.sqrt(ends.var(axis=0, ddof=1).mean()))


def wire_verdict_json(diagnosis: WireDiagnosis) -> dict[str, Any]:
    """The verdict in the format `cablejax-verdict/1`, with `stiffness_ratio`: EI over the believed one."""
    value, *interval = diagnosis.stiffness
    return {**verdict_json(diagnosis), "stiffness_ratio": {"value": value, "ci90": interval, "unit": ""}}


def _stiffness(found: Search) -> tuple[float, float, float]:
    """Median and 90 % interval of the ratio of EI, over the explanations that fit it."""
    evidence, effect = found.evidence, EFFECTS[0]
    fits = [fit for fit in found.fits if effect.name in fit.explanation.names]
    best = found.fits[0].explanation
    if not any({*best.names, effect.name} == set(fit.explanation.names) for fit in fits):
        # a search ends where an explanation is adequate; EI is of interest all the same
        both = best.plus((effect, 0, effect.null))
        fits += refitted(evidence, improve(evidence, evaluate(evidence, [both]), evidence.simulator.plan.last_steps))
    weights = softmax(log_scores(fits, evidence, found.calibration))
    centres, spreads = np.array([_centre_and_spread(fit, evidence) for fit in fits]).T

    def missing(z, share):
        return float((weights * norm.cdf(z, centres, spreads)).sum()) - share

    reach = 20 * spreads.max() + np.ptp(centres)
    ends = centres.min() - reach, centres.max() + reach
    quantiles = [brentq(functools.partial(missing, share=share), *ends) for share in (0.5, 1 - _TAIL, _TAIL)]
    middle, low, high = (float(effect.parameters[0].value(np.asarray(z))) for z in quantiles)
    return middle, low, high


def _centre_and_spread(fit: Fit, evidence) -> tuple[float, float]:
    """Of the ratio's coordinate: posterior and jackknife over photographs together, as of a normal distribution."""
    assert fit.refits is not None  # the plan asks for them
    k = list(fit.explanation.names).index(EFFECTS[0].name)
    k = sum(term.size for term in fit.explanation.terms[:k])
    left_out = np.array([one.z[k] for one in fit.refits.explanations])
    variance = np.linalg.inv(fit.precision(evidence))[k, k] + (len(left_out) - 1) * left_out.var()
    wider = t.ppf(_TAIL, len(left_out) - 1) / norm.ppf(_TAIL)
    return float(fit.explanation.z[k]), float(wider * np.sqrt(variance))
