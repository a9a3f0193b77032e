"""Effects of the arms: how they follow their commands. The actual gripper poses drive the cable."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import numpy as np

from cablejax.effects.base import CableEffect
from cablejax.effects.effect import Parameter
from cablejax.effects.physics import Physics


class ActuationGain(CableEffect):
    """The arms move more or less than commanded, seen from where they started."""

    name = "actuation_gain"
    hook = "input"
    symmetric = True
    parameters = (Parameter("gain", "", 0.1, 3.0, 1.0, 0.1),)
    null = (1.0,)
    amplitude, reversible = 0, True

    def apply(self, physics, values, variant, config):
        """Multiplies the distance that the arms move per commanded distance."""
        return replace(physics, actuation_gain=physics.actuation_gain * values[0])

    def starts(self, context):
        """None: a regression of measured on commanded motion estimates the gain without simulation."""
        return []


class ActuationLag(CableEffect):
    """The arms move later than commanded: by a pure delay, and by a first-order lag for the rest of the time."""

    name = "actuation_lag"
    hook = "input"
    symmetric = True
    parameters = (
        Parameter("time_s", "s", 0.0, 10.0, 0.2, 0.2),
        Parameter("delay_s", "s", 0.0, 5.0, 0.0, 0.2),
    )
    null = (0.0, 0.0)
    amplitude = 0

    def given(self, parameters, config):
        """See `CableEffect`; the delay is a part of the time, and an estimate may exceed it a little.

        Raises:
            ValueError: it is longer by more than a tenth.
        """
        (total, delay), variant = super().given(parameters, config)
        if delay > 1.1 * total:
            raise ValueError(f"{self.name}: delay_s is {delay:g}, expected at most time_s, {total:g} s in all.")
        return (max(total, delay), delay), variant

    def apply(self, physics, values, variant, config):
        """Adds the pure delay [s], and the rest of the time as the first-order lag's time constant [s]."""
        total, delay = values
        return replace(
            physics,
            actuation_delay=physics.actuation_delay + delay,
            actuation_time=physics.actuation_time + (total - delay),
        )

    def starts(self, context):
        """None: a regression of measured on commanded motion estimates the lag without simulation."""
        return []


def executed(physics: Physics, commanded: Any, interval: Any) -> Any:
    """Gripper poses of arms with gain, delay and lag. Differentiable in all arguments.

    The lag is exact for commands that are piecewise linear in time. Exact arms follow to the last bit.

    Args:
        physics: of these arms; `actuation_gain`, `actuation_delay` and `actuation_time` are used.
        commanded: poses of exact arms at even times, shape [T, Q, P]. NumPy in, NumPy out; JAX in, JAX out.
        interval: between two of them [s].

    Returns:
        Poses of the same shape.
    """
    amplified = commanded + (physics.actuation_gain - 1.0) * (commanded - commanded[:1])
    return lagged(amplified, interval, physics.actuation_delay, physics.actuation_time)


def lag_weights(ratio: Any) -> tuple[Any, Any, Any]:
    """Weights of one interval of a first-order lag: `y_1 = d y_0 + w_0 u_0 + w_1 u_1`.

    Exact for input that is linear over the interval dt: `slow y' + y = u` gives `d = exp(-dt / slow)`,
    `w_0 = r (1 - d) - d` and `w_1 = 1 - r (1 - d)` with `r = slow / dt`.

    Args:
        ratio: r >= 0, a NumPy or JAX number; 0 = no lag, to the last bit.
    """
    xp = ratio.__array_namespace__()
    # below a thousandth of an interval nothing is left of the past
    fresh = -xp.expm1(-1.0 / xp.maximum(ratio, 1e-3))
    return 1 - fresh, ratio * fresh - (1 - fresh), 1 - ratio * fresh


def executed_twist(physics: Physics, start: Any, twist: Any, interval: Any) -> Any:
    """Mean twist of arms with gain, delay and lag over each command; the arms rest at `start` before the first one.

    Args:
        physics: of these arms.
        start: pose at the first command, shape [Q, P].
        twist: commanded in the plane [m/s, rad/s], shape [T, Q, P]. NumPy in, NumPy out; JAX in, JAX out.
        interval: for which each twist is held [s].
    """
    xp = twist.__array_namespace__()
    commanded = xp.concatenate([start[None], start + xp.cumsum(interval * twist, axis=0)])
    off = executed(physics, commanded, interval) - commanded
    return twist + (off[1:] - off[:-1]) / interval


def follows_exactly(physics: Physics) -> bool:
    """Whether arms of known parameters do what they are commanded."""
    return bool(physics.actuation_gain == 1 and physics.actuation_delay == 0 and physics.actuation_time == 0)


def lagged(poses: Any, interval: Any, delay: Any, slow: Any) -> Any:
    """Poses after a pure delay [s], then a first-order lag of time constant `slow` [s]; shape [T, ...] as `poses`.

    Exact for piecewise linear input, see `lag_weights`.
    """
    xp, late = poses.__array_namespace__(), delayed(poses, delay / interval)
    ratio = xp.asarray(slow, dtype=poses.dtype) / interval
    decay, before_weight, after_weight = lag_weights(ratio)
    # from the first pose on: what rounding leaves of it would be lost anew with every sample
    moved = late - late[:1]
    driven = before_weight * moved[:-1] + after_weight * moved[1:]
    return late + (xp.concatenate([moved[:1], _recursion(xp, decay, driven)]) - moved)


def delayed(values: Any, samples: Any) -> Any:
    """Values [T, ...] so many samples late, linear between two samples; the first holds before. NumPy or JAX arrays.

    At whole samples its derivative is that of becoming later, the only one that there is for values without delay.
    """
    xp, n = values.__array_namespace__(), len(values)
    index = np.arange(n)
    back = xp.where(index > samples, index - samples, 0.0)
    before = xp.clip(xp.ceil(back).astype(int) - 1, 0, n - 2)
    t = (back - before).reshape(-1, *(1,) * (values.ndim - 1)).astype(values.dtype)
    return (1 - t) * values[before] + t * values[before + 1]


def _recursion(xp: Any, decay: Any, driven: Any) -> Any:
    """`y_k = decay y_(k - 1) + driven_k`, from `y_0 = 0` on."""
    if xp is np:
        result, last = np.empty_like(driven), np.zeros(driven.shape[1:], driven.dtype)
        for k in range(len(driven)):
            last = result[k] = decay * last + driven[k]
        return result
    factors = xp.broadcast_to(decay, driven.shape)
    return jax.lax.associative_scan(lambda a, b: (a[0] * b[0], b[0] * a[1] + b[1]), (factors, driven))[1]
