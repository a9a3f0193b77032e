"""Effects of the table and of what lies on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cablejax.cable import Discretisation
from cablejax.effects.base import CableEffect, Context
from cablejax.effects.effect import Parameter

_DISC, _MOST_PLACES = 0.03, 10


def _believed(config: Discretisation) -> float:
    """The nominal coefficient; a table believed to be smooth gets a small one to be a multiple of."""
    return config.cable.friction_coefficient or 0.01


class TableFriction(CableEffect):
    """The Coulomb coefficient differs everywhere. Variant 1 also sticks harder than it slides, by a fitted excess."""

    name = "table_friction"
    hook = "table"
    parameters = (
        Parameter("ratio", "", 0.01, 50.0, 1.0, 1.0, log=True),
        Parameter("static_excess", "", 0.0, 1.5, 0.0, 0.2),
    )
    null = (1.0, 0.0)
    variants = (0, 1)
    amplitude, reversible = 0, True

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


class FrictionPatch(CableEffect):
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
    amplitude, reversible = 3, True

    def apply(self, physics, values, variant, config):
        """Sets the patch's centre and radius [m] and what it adds to the coefficient inside."""
        x, y, radius, ratio = values
        xp = ratio.__array_namespace__()
        return replace(
            physics,
            patch_centre=xp.stack([x, y]),
            patch_radius=physics.patch_radius * 0.0 + radius,
            patch_friction=(ratio - 1.0) * _believed(config),
        )

    def starts(self, context):
        """A patch three times as rough in each of the 14 squares of the table that the cable visits most."""
        return [(0, (x, y, 0.12, 3.0)) for x, y in _swept(context, 0.14)[:14]]

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

    def location(self, values, variant, config):
        """The patch's centre on the table [m]."""
        return {"table_m": [float(values[0]), float(values[1])]}


class ViscousDrag(CableEffect):
    """Drag per length proportional to velocity."""

    name = "viscous_drag"
    hook = "table"
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
    """The table is tilted against what is believed. Fitted as what gravity's part in its plane is more, over g."""

    name = "gravity_tilt"
    hook = "table"
    parameters = (
        Parameter("sine_x", "", -0.9, 0.9, 0.0, 0.15),
        Parameter("sine_y", "", -0.9, 0.9, 0.0, 0.15),
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
        sine, direction = np.sin(parameters["angle_rad"]), parameters["direction_rad"]
        return {"sine_x": sine * np.cos(direction), "sine_y": sine * np.sin(direction)}


class Obstacle(CableEffect):
    """An unmodelled fixed disc touches the cable."""

    name = "obstacle"
    hook = "obstacle"
    parameters = (
        Parameter("x_m", "m", -3.0, 3.0, 0.4, 0.4, difference=0.003),
        Parameter("y_m", "m", -3.0, 3.0, 0.1, 0.4, difference=0.003),
        Parameter("radius_m", "m", 0.005, 0.2, 0.03, 0.5, log=True),
    )
    null = (3.0, 3.0, 0.005)

    def apply(self, physics, values, variant, config):
        """Sets the disc's centre and radius [m]."""
        x, y, radius = values
        return replace(
            physics,
            obstacle_centre=x.__array_namespace__().stack([x, y]),
            obstacle_radius=physics.obstacle_radius * 0.0 + radius,
        )

    def starts(self, context):
        """A disc of 3 cm at the places from which the cable seems to be pushed."""
        return [(0, (x, y, _DISC)) for x, y in _pushed(context)]

    def location(self, values, variant, config):
        """The disc's centre on the table [m]."""
        return {"table_m": [float(values[0]), float(values[1])]}


def _pushed(context: Context) -> list[tuple[float, float]]:
    """Candidate places of a disc: next to the observed cable, on the side from which it is pushed, never inside it.

    The candidates are points a radius away from observed keypoints that deviate, against the deviation. An observed
    cable never passes through the obstacle, so candidates that it comes closer to than half a radius are dropped.
    """
    deviation = np.linalg.norm(context.residual, axis=-1)
    observed = context.keypoints + context.residual
    usable = np.isfinite(deviation)
    usable[:, :, [0, -1]] = False
    if not usable.any():
        return []
    limit = np.nanquantile(deviation[usable], 0.95)
    chosen = usable & (deviation >= limit)
    at = observed[chosen]
    against = -context.residual[chosen] / deviation[chosen][:, None]
    centres = at + _DISC * against
    squares, first, visits = np.unique(
        np.round(centres / 0.03).astype(int), axis=0, return_index=True, return_counts=True
    )
    del squares
    every = observed[:, ::3].reshape(-1, 2)
    every = every[np.isfinite(every).all(axis=1)]
    result = []
    for index in first[np.argsort(-visits)]:
        centre = centres[index]
        clear = np.sqrt(((every - centre) ** 2).sum(axis=1).min()) > 0.5 * _DISC
        apart = all(np.hypot(*(centre - other)) > 0.05 for other in result)
        if clear and apart:
            result.append((float(centre[0]), float(centre[1])))
        if len(result) == _MOST_PLACES:
            break
    return result
