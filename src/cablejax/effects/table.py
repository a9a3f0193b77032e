"""Effects of the table and of what lies on it."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from cablejax.arrays import filled
from cablejax.cable import Discretisation
from cablejax.effects.base import CableEffect, Context
from cablejax.effects.effect import Parameter

# Discs tried as obstacles: how many, and of which size at most, how far apart [lengths of the cable].
_MOST_DISCS, _LARGEST, _APART = 3, 0.06, 0.05
# Of the search for them: every which sample, and the grid's step, how near touches [lengths of the cable].
_EVERY, _GRID, _CONTACT = 4, 0.015, 6e-3
_MOST_PLACES = 10_000


def _believed(config: Discretisation) -> float:
    """The nominal coefficient; a table believed to be smooth gets a small one to be a multiple of."""
    return config.cable.friction_coefficient or 0.01


class TableFriction(CableEffect):
    """The Coulomb coefficient differs everywhere. Variant 1 also sticks harder than it slides, by a fitted excess."""

    name = "table_friction"
    hook = "table"
    symmetric = True
    parameters = (
        Parameter("ratio", "", 0.01, 50.0, 1.0, 1.0, log=True),
        Parameter("static_excess", "", 0.0, 1.5, 0.0, 0.2),
    )
    null = (1.0, 0.0)
    variants = (0, 1)
    amplitude, reversible, alone = 0, True, True

    def besides(self, believed):
        """Where friction is believed to stick harder than it slides, the coefficient alone."""
        return self._with(variants=(0,)) if believed.static_excess > 0 else self

    def apply(self, physics, values, variant, config):
        """Multiplies the coefficient by the ratio; in variant 1 also sets the excess of static friction."""
        nominal = physics.friction + (_believed(config) if config.cable.friction_coefficient == 0 else 0.0)
        excess = physics.static_excess * (1 - variant) + variant * values[1]
        return replace(physics, friction=nominal * values[0], static_excess=excess)

    def starts(self, context):
        """A table 2.5 times smoother and one 2.5 times rougher, in both variants."""
        return [(0, (0.4, 0.0)), (0, (2.5, 0.0)), (1, (0.4, 0.2)), (1, (2.5, 0.2))]

    def reported(self, values, variant, config):
        """The coefficient instead of its ratio to the nominal one, and the excess in variant 1."""
        coefficient = {"coefficient": (float(values[0]) * _believed(config), "")}
        return {**coefficient, "static_excess": (float(values[1]), "")} if variant else coefficient

    def _from_reported(self, parameters, config):
        ratio = parameters["coefficient"] / _believed(config)
        return {"static_excess": 0.0, **parameters, "ratio": ratio, "variant": float("static_excess" in parameters)}


def _swept(context: Context, spacing: float) -> np.ndarray:
    """Centres of the squares of the table that the cable sweeps [m], the most visited first, shape [K, 2]."""
    points = context.keypoints[:, :, 1:-1].reshape(-1, 2)
    points = points[np.isfinite(points).all(axis=1)]
    squares, visits = np.unique(np.round(points / spacing).astype(int), axis=0, return_counts=True)
    return squares[np.argsort(-visits)] * spacing


class _AtPlace(CableEffect):
    """An effect about a place on the table, whose parameters begin with x_m and y_m [m]."""

    def around(self, place):
        """Bounds, prior medians and null values of its centre lie about the place."""
        shifts = [*map(float, place), *[0.0] * (len(self.parameters) - 2)]
        parameters = tuple(
            dataclasses.replace(p, low=p.low + shift, high=p.high + shift, centre=p.centre + shift) if shift else p
            for p, shift in zip(self.parameters, shifts, strict=True)
        )
        null = tuple(value + shift for value, shift in zip(self.null, shifts, strict=True))
        return self._with(parameters=parameters, null=null)

    def seen_from(self, parameters, place):
        """Its centre moves."""
        by = {"x_m": place[0], "y_m": place[1]}
        return {name: value - by.get(name, 0.0) for name, value in parameters.items()}

    def location(self, values, variant, config):
        """The centre on the table [m]."""
        return {"table_m": [float(values[0]), float(values[1])]}


class FrictionPatch(_AtPlace):
    """Another coefficient inside a round region of the table."""

    name = "friction_patch"
    hook = "table"
    parameters = (
        Parameter("x_m", "m", -3.0, 3.0, 0.4, 0.4, difference=0.01),
        Parameter("y_m", "m", -3.0, 3.0, 0.1, 0.4, difference=0.01),
        Parameter("radius_m", "m", 0.02, 0.6, 0.12, 0.5, log=True),
        Parameter("ratio", "", 0.01, 50.0, 1.0, 1.2, log=True),
    )
    null = (0.4, 0.1, 0.12, 1.0)
    amplitude, reversible, stage, alone = 3, True, 1, True

    def apply(self, physics, values, variant, config):
        """Sets the patch's centre and radius [m] and the coefficient inside, whatever it is outside."""
        x, y, radius, ratio = values
        xp = ratio.__array_namespace__()
        return replace(
            physics,
            patch_centre=xp.stack([x, y]),
            patch_radius=physics.patch_radius * 0.0 + radius,
            patch_friction=ratio * _believed(config) - physics.friction,
        )

    def starts(self, context):
        """A patch three times as rough in each of the 14 squares of the table that the cable visits most."""
        length = context.config.cable.length
        return [(0, (x, y, 0.12 * length, 3.0)) for x, y in _swept(context, 0.14 * length)[:14]]

    def reported(self, values, variant, config):
        """Centre and radius [m], and the coefficient inside instead of its ratio to the nominal one."""
        x, y, radius, ratio = (float(v) for v in values)
        return {
            "x_m": (x, "m"),
            "y_m": (y, "m"),
            "radius_m": (radius, "m"),
            "coefficient": (ratio * _believed(config), ""),
        }

    def _from_reported(self, parameters, config):
        return {**parameters, "ratio": parameters["coefficient"] / _believed(config)}


class ViscousDrag(CableEffect):
    """Drag per length proportional to velocity."""

    name = "viscous_drag"
    hook = "table"
    symmetric = True
    parameters = (Parameter("coefficient_n_s_per_m2", "N s/m^2", 1e-3, 1e3, 1.0, 1.2, log=True),)
    null = (0.0,)
    amplitude = 0

    def apply(self, physics, values, variant, config):
        """Adds to the drag per length and velocity [N s/m^2]."""
        return replace(physics, drag=physics.drag + values[0])

    def starts(self, context):
        """A drag of 1 and of 8 N s/m^2."""
        return [(0, (1.0,)), (0, (8.0,))]


class GravityTilt(CableEffect):
    """The table's tilt differs from the stated one. Fitted as the additional in-plane gravity over g."""

    name = "gravity_tilt"
    hook = "table"
    parameters = (
        Parameter("sine_x", "", -1.0, 1.0, 0.0, 0.15),
        Parameter("sine_y", "", -1.0, 1.0, 0.0, 0.15),
    )
    null = (0.0, 0.0)

    def apply(self, physics, values, variant, config):
        """Adds gravity's component in the plane of the table [m/s^2]."""
        xp = values[0].__array_namespace__()
        return replace(physics, tilt=physics.tilt + physics.gravity * xp.stack([values[0], values[1]]))

    def starts(self, context):
        """A tilt of 0.1 in eight directions."""
        angle = np.arange(8) * np.pi / 4
        return [(0, (0.1 * np.cos(a), 0.1 * np.sin(a))) for a in angle]

    def reported(self, values, variant, config):
        """The table's slope [rad] and the direction in which it falls [rad]."""
        x, y = float(values[0]), float(values[1])
        sine = float(np.clip(np.hypot(x, y), 0.0, 1.0))
        return {"angle_rad": (float(np.arcsin(sine)), "rad"), "direction_rad": (float(np.arctan2(y, x)), "rad")}

    def _from_reported(self, parameters, config):
        angle, direction = parameters["angle_rad"], parameters["direction_rad"]
        # verdicts round
        if not 0 <= angle <= 1.5708:
            raise ValueError(f"{self.name}: angle_rad is {angle:g}, expected 0 to 1.5708 rad.")
        sine = np.sin(angle)
        return {"sine_x": sine * np.cos(direction), "sine_y": sine * np.sin(direction)}


class Obstacle(_AtPlace):
    """An unmodelled fixed disc touches the cable."""

    name = "obstacle"
    hook = "obstacle"
    parameters = (
        Parameter("x_m", "m", -3.0, 3.0, 0.4, 0.4, difference=0.003),
        Parameter("y_m", "m", -3.0, 3.0, 0.1, 0.4, difference=0.003),
        Parameter("radius_m", "m", 0.005, 0.2, 0.03, 0.5, log=True),
    )
    null = (3.0, 3.0, 0.005)
    alone = True

    def apply(self, physics, values, variant, config):
        """Sets the disc's centre and radius [m]."""
        x, y, radius = values
        return replace(
            physics,
            obstacle_centre=x.__array_namespace__().stack([x, y]),
            obstacle_radius=physics.obstacle_radius * 0.0 + radius,
        )

    def starts(self, context):
        """Discs that the simulated cable passes through and the observed one lies against."""
        return [(0, disc) for disc in _in_the_way(context, self.parameters[2])]


def _in_the_way(context: Context, size: Parameter) -> list[tuple[float, float, float]]:
    """Candidate discs (x, y, radius) [m], best first: none overlaps the observed cable at any time.

    Every point of a grid gets the largest such disc. It is as good as the simulated cable is deep in it, summed over
    the times at which the observed cable lies against it: a cable that is stopped stays there, one that merely moves
    otherwise does not. The prior of the radius decides between a disc and a larger one behind it.
    """
    residual, simulated, known = (
        points[:, ::_EVERY].reshape(-1, *points.shape[2:])
        for points in (_completed(context.residual), context.keypoints, context.residual)
    )
    seen = np.isfinite(known).any(axis=(1, 2)) & np.isfinite(simulated + residual).all(axis=(1, 2))
    if not seen.any():
        return []
    simulated, observed = simulated[seen], (simulated + residual)[seen]
    low, high = simulated.min(axis=(0, 1)), simulated.max(axis=(0, 1))
    # a fit moves the disc from there: a short cable that is carried far needs no finer grid
    length = context.config.cable.length
    step = max(_GRID * length, float(np.sqrt(np.prod(high - low) / _MOST_PLACES)))
    axes = [np.arange(begin, end + step, step) for begin, end in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    away = _distances(grid, observed)
    radius = away.min(axis=1)
    fits = (radius > size.low) & (radius < _LARGEST * length)
    grid, away, radius = grid[fits], away[fits], radius[fits]
    depth = np.maximum(radius[:, None] - _distances(grid, simulated), 0.0)
    against = np.exp(-(((away - radius[:, None]) / (_CONTACT * length)) ** 2))
    prior = np.exp(-0.5 * (np.log(radius / size.centre) / size.scale) ** 2)
    score = (np.sqrt(depth) * against).sum(axis=1) * prior
    result: list[tuple[float, float, float]] = []
    for i in np.argsort(-score, kind="stable"):
        if score[i] <= 0 or len(result) == _MOST_DISCS:
            break
        if all(np.hypot(*(grid[i] - disc[:2])) > _APART * length for disc in result):
            result.append((float(grid[i, 0]), float(grid[i, 1]), float(radius[i])))
    return result


def _completed(residual: Float[np.ndarray, "E T N 2"]) -> Float[np.ndarray, "E T N 2"]:
    """Keypoints that were not seen are off as they were before and after; those never seen, as their neighbours are.

    NaN in an episode of which nothing was seen.
    """
    residual = np.array(residual)
    for episode in residual:
        seen = np.isfinite(episode).all(axis=2)
        ever = seen.any(axis=0)
        for n in np.flatnonzero(ever & ~seen.all(axis=0)):
            episode[:, n] = filled(episode[:, n])
        if ever.any() and not ever.all():
            episode[:] = [filled(points) for points in episode]
    return residual


def _distances(points: Float[np.ndarray, "P 2"], cables: Float[np.ndarray, "M N 2"]) -> Float[np.ndarray, "P M"]:
    """Distance of every point from every cable, straight between keypoints [m]."""
    begin, along = cables[:, :-1].astype(np.float32), np.diff(cables, axis=1).astype(np.float32)
    square = np.maximum((along**2).sum(axis=-1), 1e-12)
    result = np.empty((len(points), len(cables)), np.float32)
    for i, point in enumerate(points.astype(np.float32)):
        there = point - begin
        share = np.clip((there * along).sum(axis=-1) / square, 0.0, 1.0)
        result[i] = np.sqrt(((there - share[..., None] * along) ** 2).sum(axis=-1).min(axis=-1))
    return result
