"""Effects of how the cable is observed; they do not change its motion."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cablejax.arrays import quarter_turn
from cablejax.effects.arms import delayed
from cablejax.effects.base import CableEffect
from cablejax.effects.effect import Parameter
from cablejax.effects.physics import Physics
from cablejax.limits import LIMITS


class CameraSimilarity(CableEffect):
    """Scale, rotation and offset of the keypoints' frame.

    The verdict's offset is that of scale and rotation about the world's origin; `x_m` and `y_m` of the parameters are
    for those about `origin`, a place near the cable.
    """

    name = "camera_similarity"
    hook = "observation"
    parameters = (
        Parameter("scale", "", 0.5, 2.0, 1.0, 0.02),
        Parameter("angle_rad", "rad", -1.0, 1.0, 0.0, 0.02),
        Parameter("x_m", "m", -0.5, 0.5, 0.0, 0.01),
        Parameter("y_m", "m", -0.5, 0.5, 0.0, 0.01),
    )
    null = (1.0, 0.0, 0.0, 0.0)
    side = "observation"
    alone = True
    origin = (0.0, 0.0)
    """Place that the keypoints are scaled and turned about in the fit [m]."""

    def around(self, place):
        """Scale and rotation are about the place: elsewhere a small rotation comes with a large offset."""
        other = copy.copy(self)
        vars(other).update(origin=(float(place[0]), float(place[1])))
        return other

    def sized(self, length):
        """A camera's place is off by as much above any cable."""
        del length
        return self

    def apply(self, physics, values, variant, config):
        """Scales, turns [rad] and shifts [m] the keypoints' frame."""
        xp = values[0].__array_namespace__()
        x, y = _shifted(values, self.origin, 1.0)
        return replace(
            physics,
            camera_scale=physics.camera_scale * values[0],
            camera_angle=physics.camera_angle + values[1],
            camera_offset=physics.camera_offset + xp.stack([x, y]),
        )

    def reported(self, values, variant, config):
        """The offset [m] is that about the world's origin."""
        x, y = _shifted([np.float64(value) for value in values], self.origin, 1.0)
        return super().reported((values[0], values[1], x, y), variant, config)

    def seen_from(self, parameters, place):
        """A scale or a rotation about another origin comes with another offset."""
        named = {p.name: p.centre for p in self.parameters} | dict(parameters)
        x, y = _shifted([np.float64(named[p.name]) for p in self.parameters], place, -1.0)
        return {**named, "x_m": float(x), "y_m": float(y)}

    def _from_reported(self, parameters, config):
        return self.seen_from(parameters, self.origin)

    def starts(self, context):
        """The similarity nearest to the observed keypoints, by linear least squares."""
        seen = np.isfinite(context.residual).all(axis=-1)
        x, y = context.keypoints[seen].T
        zero, one = np.zeros_like(x), np.ones_like(x)
        x, y = x - self.origin[0], y - self.origin[1]
        columns = np.concatenate([np.stack([x, -y, one, zero], axis=1), np.stack([y, x, zero, one], axis=1)])
        a, b, dx, dy = np.linalg.lstsq(columns, context.residual[seen].T.ravel(), rcond=None)[0]
        return [(0, (np.hypot(1 + a, b), np.arctan2(b, 1 + a), dx, dy))]


def _shifted(values: Any, origin: Sequence[float], sign: float) -> tuple[Any, Any]:
    """The offset about the world's origin from that about another one, or with the other sign the reverse."""
    scale, angle, x, y = values
    if not any(origin):
        return x, y
    xp, (ox, oy) = scale.__array_namespace__(), origin
    cosine, sine = scale * xp.cos(angle), scale * xp.sin(angle)
    return x + sign * (ox - cosine * ox + sine * oy), y + sign * (oy - sine * ox - cosine * oy)


class CameraLag(CableEffect):
    """Keypoints are stamped late."""

    name = "camera_lag"
    hook = "observation"
    parameters = (Parameter("time_s", "s", 0.0, 5.0, 0.2, 0.2),)
    null = (0.0,)
    side = "observation"

    def apply(self, physics, values, variant, config):
        """Adds to the keypoints' lag [s]."""
        return replace(physics, camera_lag=physics.camera_lag + values[0])

    def starts(self, context):
        """A lag of 0.15 and of 0.6 s."""
        return [(0, (0.15,)), (0, (0.6,))]


class KeypointBias(CableEffect):
    """One keypoint sits off its nominal arc length or off the centreline; several are found one after the other.

    The variant is twice the keypoint's index, plus one for an offset across the cable.
    """

    name = "keypoint_bias"
    hook = "observation"
    parameters = (Parameter("offset_m", "m", -0.1, 0.1, 0.0, 0.01),)
    null = (0.0,)
    amplitude, reversible = 0, True
    side = "observation"
    variants = range(2 * int(LIMITS["keypoints"].high))
    variant_name = "index"
    repeatable = True

    def apply(self, physics, values, variant, config):
        """Adds to the offset [m] of one keypoint, along or across the cable."""
        index, across = divmod(variant, 2)
        xp = values[0].__array_namespace__()
        one = (np.arange(config.cable.n_keypoints) == index).astype(np.float32)
        field = "bias_across" if across else "bias_along"
        return replace(physics, **{field: getattr(physics, field) + values[0] * xp.asarray(one)})

    def starts(self, context):
        """The three offsets that take away most of the residual, by least squares against tangent and normal."""
        tangent = np.gradient(context.keypoints, axis=2)
        tangent = tangent / np.linalg.norm(tangent, axis=-1, keepdims=True)
        normal = quarter_turn(tangent)
        gains = []
        for index in range(context.config.cable.n_keypoints):
            for across, direction in ((0, tangent), (1, normal)):
                projected = np.sum(context.residual[:, :, index] * direction[:, :, index], axis=-1)
                if not np.isfinite(projected).any():
                    continue
                mean = float(np.nanmean(projected))
                gains.append((mean**2, 2 * index + across, mean))
        return [(variant, (mean,)) for _, variant, mean in sorted(gains, reverse=True)[:3]]

    def reported(self, values, variant, config):
        """The keypoint, whether its offset is across the cable, and the offset [m]."""
        return {"index": (variant // 2, ""), "across": (variant % 2, ""), "offset_m": (float(values[0]), "m")}

    def _from_reported(self, parameters, config):
        count = config.cable.n_keypoints
        if not 0 <= parameters["index"] < count:
            raise ValueError(f"{self.name}: index is {parameters['index']:g}, expected 0 to {count - 1}.")
        if parameters.get("across", 0) not in (0, 1):
            raise ValueError(f"{self.name}: across is {parameters['across']:g}, expected 0 or 1.")
        return parameters | {"variant": 2 * parameters["index"] + parameters.get("across", 0)}

    def location(self, values, variant, config):
        """The keypoint's arc length [m], as a section without length."""
        s = float(config.cable.keypoint_arclength[variant // 2])
        return {"along_cable_m": [s, s]}


def seen_by_camera(physics: Physics, keypoints: Any, interval: Any) -> Any:
    """Keypoints as the camera reports them: late, then scaled, turned and moved. Differentiable in all arguments.

    Args:
        physics: `camera_lag`, `camera_scale`, `camera_angle` and `camera_offset` are used.
        keypoints: where they are, at even times [m], shape [T, N, 2]. NumPy in, NumPy out; JAX in, JAX out.
        interval: between two samples [s].
    """
    return in_camera_frame(physics, delayed(keypoints, physics.camera_lag / interval))


def without_bias(physics: Physics) -> Physics:
    """The physics with keypoints each at its place along the cable, for keypoints that no camera has seen."""
    return replace(
        physics,
        bias_along=physics.bias_along * 0.0,
        bias_across=physics.bias_across * 0.0,
    )


def in_camera_frame(physics: Physics, keypoints: Any) -> Any:
    """Keypoints [..., 2] scaled and turned about the world's origin, then moved [m]; see `seen_by_camera`."""
    xp, x, y = keypoints.__array_namespace__(), keypoints[..., 0], keypoints[..., 1]
    cosine, sine = xp.cos(physics.camera_angle), xp.sin(physics.camera_angle)
    turned = xp.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
    return xp.asarray(physics.camera_scale * turned + physics.camera_offset)
