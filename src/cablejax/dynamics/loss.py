"""What training minimises: keypoint errors after one or several steps of the model's own rollout."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from cablejax.dynamics.gns import Dynamics
from cablejax.dynamics.windows import Window
from cablejax.types import History, advance


def random_walk_noise(key: PRNGKeyArray, history: History, final_std: float) -> History:
    """Adds to every free keypoint a random walk over the history whose last sample has standard deviation `final_std`.

    After Sanchez-Gonzalez et al. 2020: the model meets in training the errors that its own rollout accumulates. The
    held ends are prescribed, no error accumulates there, so they stay exact.
    """
    h, n, d = history.keypoints.shape
    walk = jnp.cumsum(jax.random.normal(key, (h, n - 2, d), history.keypoints.dtype), axis=0) * (final_std / h**0.5)
    return History(
        keypoints=history.keypoints + jnp.pad(walk, ((0, 0), (1, 1), (0, 0))), gripper_pose=history.gripper_pose
    )


def rollout_loss(
    dynamics: Dynamics, window: Window, *, scale: float, interval: float, pushforward: bool
) -> Float[Array, ""]:
    """Mean squared position error over the K steps of a window, free keypoints and coordinates, in units of `scale`.

    With K = 1 and a noisy history this is the one-step loss whose target is corrected for the noise: the displacement
    that leads from the noisy position to the true next one. Differentiable in the weights behind `dynamics`.

    Args:
        dynamics: one-step model.
        window: history, commands and true future, unbatched.
        scale: unit of the error [m].
        interval: duration of one step [s].
        pushforward: no gradient from a step's input back into the steps before (Brandstetter et al. 2022).
    """

    def step(history: History, now):
        twist, truth = now
        history = advance(history, dynamics(history, twist), twist, interval)
        error = (history.keypoints[-1] - truth)[1:-1] / scale
        return jax.lax.stop_gradient(history) if pushforward else history, jnp.mean(error**2)

    _, errors = jax.lax.scan(step, window.history, (window.twist, window.future))
    return jnp.mean(errors)
