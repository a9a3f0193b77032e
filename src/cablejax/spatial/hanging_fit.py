"""Which effects explain photographs of a hanging wire: fits, and what each fit foretells of a photograph left out.

An explanation is a set of effects with values that all photographs of the wire share. The angles of both clamps in each
photograph are nuisances: fitted with a normal prior about the horizontal, in every explanation alike. Priors,
likelihood and cost per effect are those of the planar diagnosis (`cablejax.diagnose.belief`): the squared residual of a
photograph is measured against `n (b^2 + (rho g)^2)`, with n all its coordinates, for the errors of one photograph are
one error; b the position error that the rig itself shows; g the gap of the wire as it is believed to be, and rho the
error of a law. A photograph's probability is Student's, from a fit to the others.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from cablejax.bounded import BatchedGaussNewton, Linearised, Minimised
from cablejax.diagnose.belief import Calibration
from cablejax.spatial.hanging_effects import EFFECTS, PARAMETERS, SLICES, linearised

CALIBRATION = Calibration()

LINKS_PER_SPACING = 2
"""Links of the model from one traced point to the next."""

CLAMP_ANGLE = np.radians(10.0)
"""Prior standard deviation of a clamp's angle [rad]: a wire leaves a clamp as level as one can hold it."""

_CENTRES = (0.2, 0.5, 0.8)
# Steps are limited in prior standard deviations of the effects and in radians of the clamps.
_SOLVER = BatchedGaussNewton(
    tolerance=1e-4, max_steps=100, largest_step=1.0, damping=1e-3, least_damping=0.0, least_raised=0.0, most_damping=1e6
)


@dataclasses.dataclass(frozen=True)
class Photographs:
    """Photographs of one wire.

    Attributes:
        points: traced at equal arc lengths, horizontal and vertical coordinate [m], shape [R, N, 2].
        length: of the wire [m].
        stiffness: EI over the weight per length that is believed true [m^3].
        error: root mean square error of a coordinate that the rig shows [m].
    """

    points: Float[np.ndarray, "R N 2"]
    length: float
    stiffness: float
    error: float

    def __post_init__(self):
        shape = self.points.shape
        if len(shape) != 3 or shape[0] < 3 or shape[1] < 5 or shape[2] != 2 or not np.isfinite(self.points).all():
            raise ValueError(
                f"Photographs have points of shape {shape}, expected finite ones of shape [R, N, 2] with at least "
                "three photographs, so that one can be left out, and five points."
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


@dataclasses.dataclass(frozen=True)
class WireFit:
    """An explanation after fitting.

    Attributes:
        names: of its effects.
        z: coordinates of all parameters, see `Parameter`; 0 for those of other effects, shape [P].
        clamps: fitted angles of both clamps in each photograph, from the horizontal [rad], shape [R, 2].
        residual: fitted less traced points of each photograph [m], shape [R, 2 N - 4].
        held_out: root mean square residual of each photograph, from a fit to the others [m], shape [R].
        left_out_z: coordinates from these fits, shape [R, P].
        spread: posterior standard deviation of z from the fit to all, shape [P].
        score: log probability of the photographs, each from the others, less the cost of the effects and their priors.
    """

    names: tuple[str, ...]
    z: Float[np.ndarray, " P"]
    clamps: Float[np.ndarray, "R 2"]
    residual: Float[np.ndarray, "R C"]
    held_out: Float[np.ndarray, " R"]
    left_out_z: Float[np.ndarray, "R P"]
    spread: Float[np.ndarray, " P"]
    score: float

    def values(self, name: str) -> tuple[float, ...]:
        """The fitted values of an effect's parameters."""
        pairs = zip(EFFECTS[name], self.z[SLICES[name]], strict=True)
        return tuple(float(parameter.value(np.asarray(z))) for parameter, z in pairs)


EXPLANATIONS: tuple[tuple[str, ...], ...] = (
    (),
    *((name,) for name in EFFECTS),
    *itertools.combinations(EFFECTS, 2),
)
"""No effect, each effect, and each two: more than five photographs of a shape at rest can tell apart."""


def fit_wire(
    photographs: Photographs,
    explanations: Sequence[tuple[str, ...]] = EXPLANATIONS,
    progress: Callable[[str], None] = lambda text: None,
) -> list[WireFit]:
    """Fits each explanation to all photographs, and to all but one in turn. Needs JAX in double precision.

    Args:
        photographs: of one wire.
        explanations: sets of effects by name; the empty one is the wire as it is believed to be.
        progress: is told how it goes.

    Raises:
        ValueError: JAX computes in single precision.
    """
    if jnp.zeros(()).dtype != jnp.float64:
        raise ValueError("Fits of hanging wires need double precision: call them under jax.enable_x64(True).")
    problem = _Problem(photographs)
    fits: list[WireFit] = []
    for names in explanations:
        fits.append(problem.explain(names, fits))
        progress(
            f"{' + '.join(names) or 'no effect'}: {1e3 * np.sqrt((fits[-1].held_out ** 2).mean()):.2f} mm left out"
        )
    return fits


@dataclasses.dataclass(frozen=True)
class _Shapes:
    """Where a fit stands: `z`, `clamps` and `residual` as in `WireFit`, of the photographs fitted."""

    z: Float[np.ndarray, " P"]
    clamps: Float[np.ndarray, "R 2"]
    residual: Float[np.ndarray, "R C"]


class _Problem:
    """Photographs with what does not depend on the explanation: guesses, and the scale of their residuals."""

    def __init__(self, photographs: Photographs):
        self.photographs = photographs
        along = np.diff(photographs.points, axis=1)
        traced = np.unwrap(np.arctan2(along[..., 1], along[..., 0]), axis=1)
        self.guess = np.repeat(traced, LINKS_PER_SPACING, axis=1)
        self.count = 2 * (photographs.points.shape[1] - 2)
        everyone = np.arange(len(photographs.points))
        self.scale = np.full(len(everyone), np.sqrt(self.count) * photographs.error)
        nominal = self._fit(np.zeros(len(PARAMETERS)), (), everyone).best.kept
        gap = np.sqrt((nominal.residual**2).mean(axis=1))
        self.scale = np.sqrt(self.count * (photographs.error**2 + (CALIBRATION.law_error * gap) ** 2))

    def explain(self, names: tuple[str, ...], simpler: Sequence[WireFit]) -> WireFit:
        """Begins at fixed places, and at the parts of the explanation that were fitted before by themselves."""
        everyone = np.arange(len(self.photographs.points))
        parts = [fit.z for fit in simpler if len(fit.names) == 1 and fit.names[0] in names]
        starts = _starts(names) if len(names) < 2 else parts
        starts = [*starts, np.sum(parts, axis=0)] if len(parts) > 1 else starts or _starts(names)
        best = min((self._fit(start, names, everyone) for start in starts), key=lambda ended: ended.best.value).best
        found = best.kept
        left_out_z, held_out = [], []
        for one in everyone:
            others = np.delete(everyone, one)
            there = self._fit(found.z, names, others, found.clamps[others]).best.kept.z
            foretold = self._fit(there, (), np.array([one]), found.clamps[[one]]).best.kept.residual
            left_out_z.append(there)
            held_out.append(np.sqrt((foretold**2).mean()))
        spread, free = np.zeros(len(PARAMETERS)), _free(names)
        spread[free] = np.sqrt(np.diag(np.linalg.inv(best.curvature))[: len(free)])
        surprise = self.count * np.square(held_out) / self.scale**2
        freedom = CALIBRATION.freedom
        likelihood = -0.5 * (freedom + 1) * np.log1p(surprise / freedom).sum()
        score = float(likelihood - CALIBRATION.term_cost * len(names) - 0.5 * (found.z**2).sum())
        return WireFit(
            names, found.z, found.clamps, found.residual, np.array(held_out), np.array(left_out_z), spread, score
        )

    def _fit(self, start, names, members, clamps=None) -> Minimised[_Shapes]:
        """Fits the parameters of the named effects, and the clamps' angles in each photograph among `members`."""
        clamps = np.zeros((len(members), 2)) if clamps is None else clamps
        at = self._linearised(start, clamps, names, members)

        def linearise(trials):
            (point,) = trials.values()
            z, free = start.copy(), _free(names)
            z[free] = point[: len(free)]
            return [self._linearised(z, point[len(free) :].reshape(-1, 2), names, members)]

        return _SOLVER.minimise([at], linearise)[0]

    def _linearised(self, z, clamps, names, members) -> Linearised[_Shapes]:
        """The cost with its derivatives by the named effects' coordinates, then by the clamps of each photograph."""
        # Always as many photographs, so that one program is compiled.
        places = np.resize(members, len(self.photographs.points))
        rows = np.resize(np.arange(len(members)), len(places))
        residual, by_z, by_clamps = (
            np.asarray(part)[: len(members)]
            for part in linearised(
                z, clamps[rows], self.photographs.points[places], self.guess[places], self.photographs.stiffness,
                self.photographs.length,
            )
        )  # fmt: skip
        free = _free(names)
        point = np.r_[z[free], clamps.ravel()]
        prior = np.r_[np.ones(len(free)), np.full(clamps.size, CLAMP_ANGLE**-2)]
        value = 0.5 * float(z @ z + prior[len(free) :] @ clamps.ravel() ** 2)
        gradient, curvature = prior * point, np.diag(prior)
        blocks = tuple(len(free) + 2 * k + np.arange(2) for k in range(len(members)))
        for k, (member, block) in enumerate(zip(members, blocks, strict=True)):
            columns, off = np.r_[: len(free), block], residual[k] / self.scale[member]
            jacobian = np.concatenate([by_z[k][:, free], by_clamps[k]], axis=1) / self.scale[member]
            value += 0.5 * float(off @ off)
            gradient[columns] += jacobian.T @ off
            curvature[np.ix_(columns, columns)] += jacobian.T @ jacobian
        bounds = np.array([parameter.z_bounds for parameter in PARAMETERS])[free]
        wide = np.full((clamps.size, 2), [-np.inf, np.inf])
        lower, upper = np.concatenate([bounds, wide]).T
        return Linearised(point, lower, upper, value, gradient, curvature, _Shapes(z, clamps, residual), blocks)


def _free(names: tuple[str, ...]) -> Int[np.ndarray, " F"]:
    """Indices of the named effects' parameters."""
    return np.concatenate([np.zeros(0, int), *(np.arange(len(PARAMETERS))[SLICES[name]] for name in names)])


def _starts(names: tuple[str, ...]) -> list[np.ndarray]:
    """Where fits begin: local effects at some places, with either sign."""
    starts = [np.zeros(len(PARAMETERS))]
    for name in names:
        if name not in ("intrinsic_curvature", "stiffness_profile"):
            continue
        group = EFFECTS[name]
        spread = []
        for start in starts:
            for centre in _CENTRES:
                for sign in (-0.5, 0.5):
                    z = start.copy()
                    z[SLICES[name]] = group[0].coordinate(centre), group[1].coordinate(0.3), sign
                    spread.append(z)
        starts = spread
    return starts
