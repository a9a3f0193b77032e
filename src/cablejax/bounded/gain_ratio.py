"""Step sizes from the gain ratio: actual over predicted reduction."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Scalar

from cablejax.bounded.objective import promised_decrease

_ACCEPT_ABOVE = 1e-3
"""Least gain ratio of an accepted step."""


class _GainState(eqx.Module):
    step_size: Scalar
    rate: Scalar


class GainRatio(optx.AbstractSearch):
    """Step sizes from the ratio rho of actual to predicted reduction (Nielsen, IMM-REP-1999-05).

    A step is accepted if rho > 1/1000. Then the step size is divided by `max(1/10, 1 - (2 rho - 1)^3)`, smooth
    in rho and 1 at rho = 1/2; a rejected one is divided by 2, then 4, 8, ... as long as steps are rejected, so
    that a model that was trusted far too much is found out in few trials.

    Attributes:
        largest: the step size does not grow above this.
    """

    largest: float = 1e8

    def init(self, y, f_info_struct):
        """A step size of one, not yet tried."""
        del y
        one = jnp.ones((), f_info_struct.f.dtype)
        return _GainState(one, 2 * one)

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        """Accepts or rejects a trial point by its gain ratio, and gives the next step size."""
        move = y_eval - y
        promised = promised_decrease(f_info, move)
        actual = f_info.as_min() - f_eval_info.as_min()
        promising = promised > 0
        ratio = jnp.where(promising, actual / jnp.where(promising, promised, 1.0), -1.0)
        # NaN compares as false
        accept = first_step | (ratio > _ACCEPT_ABOVE)
        grown = state.step_size / jnp.maximum(0.1, 1.0 - (2.0 * jnp.minimum(ratio, 1.0) - 1.0) ** 3)
        step_size = jnp.where(accept, jnp.minimum(grown, self.largest), state.step_size / state.rate)
        rate = jnp.where(accept, 2.0, jnp.minimum(2.0 * state.rate, 1e6)).astype(state.rate.dtype)
        return step_size, accept, optx.RESULTS.successful, _GainState(step_size, rate)
