"""Checks an effect before it is used in a diagnosis."""

from __future__ import annotations

import functools
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np

from cablejax.cable import Discretisation
from cablejax.diagnose.planar import physics_of
from cablejax.diagnose.protocol import Explanation, explanation
from cablejax.effects.base import CableEffect, Context, Hook
from cablejax.effects.camera import seen_by_camera
from cablejax.effects.physics import Physics, nominal_physics
from cablejax.simulate.chain.replay import Chain
from cablejax.simulate.compile import compiler_options
from cablejax.simulate.equilibrium import equilibrium_state

_CONFIG = Discretisation(n_links=13)
_SAMPLES, _INTERVAL = 60, 0.1
# Of central differences, in prior standard deviations: so small that no contact, yield or slip begins within it.
_STEP = 1e-6
_TOLERANCE = 1e-4
# A derivative below this [m per prior standard deviation] is of a parameter that does nothing.
_NOTHING = 1e-9


def check_effect(effect: CableEffect) -> None:
    """Tries an effect on six seconds of a short built-in motion, in double precision.

    Raises:
        ValueError: the null value changes the rollout, no start changes it at all, or the forward derivative of the
            rollout in some parameter is not what central differences give.
    """
    if not isinstance(effect, CableEffect):
        raise ValueError(
            f"The effect is {effect!r}, expected a `CableEffect`{': add brackets' if isinstance(effect, type) else ''}."
        )
    # only data generation asks for one
    hook = getattr(effect, "hook", None)
    if hook is not None and hook not in get_args(Hook):
        raise ValueError(f"Effect {effect.name!r} has the hook {hook!r}, expected one of {', '.join(get_args(Hook))}.")
    with jax.enable_x64(True):
        (replay, _), (motion, angles) = _compiled(), _motion()
        nominal = nominal_physics(_CONFIG, dtype=jnp.float64)
        still = np.asarray(replay(nominal, motion, angles))
        for variant in effect.variants[:2]:
            null = effect.apply(nominal, [np.float64(v) for v in effect.null], variant, _CONFIG)
            if not isinstance(null, Physics):
                raise ValueError(
                    f"Effect {effect.name!r}: `apply` gave a {type(null).__name__}, expected the changed Physics: "
                    "dataclasses.replace(physics, ...)."
                )
            if not np.array_equal(np.asarray(replay(null, motion, angles)), still):
                raise ValueError(
                    f"Effect {effect.name!r}: its null value {effect.null} (variant {variant}) changes the nominal "
                    "rollout; expected no change at all."
                )
        starts = effect.starts(_context(still))
        if not starts:
            raise ValueError(f"Effect {effect.name!r}: `starts` gave none for an ordinary log; expected at least one.")
        trials = [explanation((effect, variant, values)) for variant, values in starts]
        moved = [
            np.abs(np.asarray(replay(physics_of(c, nominal, _CONFIG, c.z), motion, angles)) - still).max()
            for c in trials
        ]
        if not max(moved) > 1e-6:
            raise ValueError(
                f"Effect {effect.name!r}: none of its {len(starts)} starts moves a keypoint by more than a micrometre; "
                "expected an effect that shows."
            )
        best = trials[int(np.argmax(moved))]
        for i, parameter in enumerate(effect.parameters):
            try:
                exact, difference = _derivatives(best, i, nominal, motion, angles)
            except jax.errors.JAXTypeError as error:
                raise ValueError(
                    f"Effect {effect.name!r}: `apply` cannot be traced by JAX ({str(error).splitlines()[0]}) Write it "
                    "with the array namespace of its values, without `float`, rounding or branches on them."
                ) from error
            if not np.abs(difference).max() > _NOTHING:
                raise ValueError(
                    f"Effect {effect.name!r}: {parameter.name!r} changes nothing from one of its values to the next; "
                    "expected an `apply` that uses it, without rounding."
                )
            error = np.abs(exact - difference).max()
            if not error <= _TOLERANCE * np.abs(difference).max() + 1e-7:
                raise ValueError(
                    f"Effect {effect.name!r}: the derivative in {parameter.name!r} is off by {error:.2e} m of "
                    f"{np.abs(difference).max():.2e} m against central differences; write `apply` with the array "
                    "namespace of its values, without rounding or branches on them."
                )


def _derivatives(best: Explanation, i: int, nominal, motion, angles):
    direction = jnp.zeros(len(best.z)).at[i].set(1.0)
    # at a place where nothing is at a kink by design
    z = jnp.asarray(best.z) + 0.01

    def physics(z):
        return jax.tree.map(jnp.asarray, physics_of(best, nominal, _CONFIG, z))

    value, change = jax.jvp(physics, (z,), (direction,))
    replay, tangent = _compiled()
    exact = tangent(value, change, motion, angles)
    ahead, behind = (replay(physics(z + s * _STEP * direction), motion, angles) for s in (1, -1))
    return np.asarray(exact), np.asarray(ahead - behind) / (2 * _STEP)


@functools.cache
def _compiled():
    chain = Chain(_CONFIG)

    def replay(physics, motion, angles):
        points = chain.rollout(physics, angles, motion, jnp.asarray(_INTERVAL), n_substeps=2)
        return seen_by_camera(physics, points, jnp.asarray(_INTERVAL))

    def tangent(physics, change, motion, angles):
        return jax.jvp(lambda p: replay(p, motion, angles), (physics,), (change,))[1]

    return tuple(jax.jit(f, compiler_options=compiler_options()) for f in (replay, tangent))


def _motion():
    """Grippers that approach, turn and sway: an arch that bends more and more on one side."""
    t = np.linspace(0.0, 1.0, _SAMPLES)
    pose = np.zeros((_SAMPLES, 2, 3))
    pose[:, 0] = np.stack([0.02 * np.sin(3 * t), 0.05 * t, 0.5 + 0.3 * t], axis=1)
    pose[:, 1] = np.stack([0.8 - 0.15 * t, 0.08 * t**2, -0.4 - 0.6 * t], axis=1)
    angles = np.asarray(equilibrium_state(_CONFIG, pose[0]).qpos)[2:]
    return jnp.asarray(pose), jnp.asarray(angles)


def _context(keypoints: np.ndarray) -> Context:
    residual = np.zeros_like(keypoints)
    # a cable pushed aside in its middle
    residual[:, 5:8, 1] = 0.01
    return Context(
        config=_CONFIG, keypoints=keypoints[None], residual=residual[None], duration=6.0, max_curvature=np.array([6.0])
    )
