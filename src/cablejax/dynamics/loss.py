"""The training loss: keypoint errors after one or several steps of the model's own rollout."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from cablejax.dataset.windows import Window
from cablejax.dynamics.model import OneStepModel
from cablejax.types import History, advance


def random_walk_noise(key: PRNGKeyArray, history: History, final_std: float) -> History:
    """Adds to every free keypoint a random walk over the history whose last sample has standard deviation `final_std`.

    After Sanchez-Gonzalez et al. 2020: the model meets in training the errors that its own rollout accumulates. The
    held ends are prescribed, no error accumulates there, so they stay exact.
    """
    h, n, d = history.keypoints.shape
    walk = jnp.cumsum(jax.random.normal(key, (h, n - 2, d), history.keypoints.dtype), axis=0) * (final_std / h**0.5)
    return dataclasses.replace(history, keypoints=history.keypoints + jnp.pad(walk, ((0, 0), (1, 1), (0, 0))))


def rollout_loss(dynamics: OneStepModel, window: Window, *, scale: float, interval: float) -> Float[Array, ""]:
    """Robust position error of a rollout, averaged over the K steps of a window.

    The mean of `2 (sqrt(1 + m) - 1)`, m being the mean square error over free keypoints and coordinates in units of
    `scale`. Near zero this is m. Beyond 1 it grows like sqrt(m), so that steps in which the cable snaps through, which
    no model predicts to the millimetre, do not dominate: on random motions 1 % of the steps hold half of the sum of m.
    With K = 1 and a noisy history this is the one-step loss whose target is corrected for the noise: the displacement
    that leads from the noisy position to the true next one. Differentiable in the weights behind `dynamics`.

    Args:
        dynamics: one-step model.
        window: history, commands and true future, unbatched.
        scale: unit of the error [m].
        interval: duration of one step [s].
    """

    def step(history: History, now):
        twist, truth = now
        history = advance(history, dynamics(history, twist), twist, interval)
        error = (history.keypoints[-1] - truth)[1:-1] / scale
        return history, 2 * (jnp.sqrt(1 + jnp.mean(error**2)) - 1)

    _, errors = jax.lax.scan(step, window.history, (window.twist, window.future))
    return jnp.mean(errors)
