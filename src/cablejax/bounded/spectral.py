"""Spectral projected gradient descent (Birgin, Martinez, Raydan, SIAM J. Optim. 10, 2000)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree, Scalar

from cablejax.bounded.sets import AbstractSet


class _ArcState(eqx.Module):
    y: Array
    grad: Array
    length: Scalar
    first: Bool[Array, ""]
    projected_gradient: Array


class ProjectionArc(optx.AbstractDescent):
    """`step(s) = P(y - s a g) - y`, where a is the Barzilai-Borwein length `s's / s'y` of the last accepted step.

    Attributes:
        feasible: the set that P projects onto.
        initial_length: a before the first curvature is known.
        shortest: least a.
        longest: greatest a.
    """

    feasible: AbstractSet
    initial_length: float
    shortest: float = 1e-10
    longest: float = 1e10

    def init(self, y, f_info_struct):
        del f_info_struct
        return _ArcState(y, jnp.zeros_like(y), jnp.asarray(self.initial_length, y.dtype), jnp.array(True), y)

    def query(self, y, f_info, state):
        moved, bent = y - state.y, f_info.grad - state.grad
        curvature = jnp.sum(moved * bent)
        curved = curvature > 0
        spectral = jnp.sum(moved**2) / jnp.where(curved, curvature, 1.0)
        # Along a direction of no or negative curvature the model gives no length: try a longer one than before.
        length = jnp.clip(jnp.where(curved, spectral, 4.0 * state.length), self.shortest, self.longest)
        length = jnp.where(state.first, state.length, length)
        # 0 exactly at a stationary point
        projected_gradient = self.feasible.project(y - f_info.grad) - y
        return _ArcState(y, f_info.grad, length, jnp.array(False), projected_gradient)

    def step(self, step_size, state):
        target = state.y - step_size * state.length * state.grad
        return self.feasible.project(target) - state.y, optx.RESULTS.successful


class _MemoryState(eqx.Module):
    step_size: Scalar
    values: Float[Array, " M"]


class NonmonotoneArmijo(optx.AbstractSearch):
    """Backtracking until `f(y + d) <= max of the last M accepted values + slope g'd`, up to rounding.

    Grippo, Lampariello, Lucidi, SIAM J. Numer. Anal. 23, 1986.

    Attributes:
        memory: M; 1 makes every accepted step a descent.
        slope: share of the linear decrease that is asked for.
        shrink: ratio of a step size and the one tried before.
    """

    memory: int = eqx.field(static=True)
    slope: float = 1e-4
    shrink: float = 0.3

    def init(self, y, f_info_struct):
        return _MemoryState(jnp.ones((), y.dtype), jnp.full(self.memory, -jnp.inf, f_info_struct.f.dtype))

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        predicted = f_info.compute_grad_dot(y_eval - y)
        value = f_eval_info.as_min()
        reference = state.values.max()
        rounding = 4 * jnp.finfo(value.dtype).eps * jnp.abs(reference)
        sufficient = value <= reference + self.slope * predicted + rounding
        accept = first_step | (sufficient & (predicted <= rounding))
        values = jnp.where(accept, jnp.roll(state.values, 1).at[0].set(value), state.values)
        step_size = jnp.where(accept, 1.0, self.shrink * state.step_size).astype(state.step_size.dtype)
        return step_size, accept, optx.RESULTS.successful, _MemoryState(step_size, values)


class SpectralProjectedGradient(optx.AbstractGradientDescent):
    """Minimiser over a feasible set: gradient steps of Barzilai-Borwein length along the projection arc.

    It ends where `norm(P(y - g) - y) <= atol + rtol norm(y)`. Every evaluation costs one of the function, every
    accepted one its gradient. Start from a feasible point; every iterate is feasible. A function that is not finite at
    the start ends it with `RESULTS.nonfinite`.
    """

    descent: ProjectionArc
    search: NonmonotoneArmijo
    rtol: float
    atol: float
    norm: Callable[[PyTree], Scalar]
    measure: Callable[[PyTree], Scalar]

    def __init__(
        self,
        feasible: AbstractSet,
        rtol: float,
        atol: float,
        norm: Callable[[PyTree], Scalar] = optx.max_norm,
        memory: int = 10,
        initial_length: float = 1.0,
        lengths: tuple[float, float] = (1e-10, 1e10),
    ):
        """**Arguments:**

        - `feasible`: the set to minimise over.
        - `rtol`: relative tolerance on the projected gradient.
        - `atol`: absolute tolerance on it.
        - `norm`: the norm it is measured in.
        - `memory`: a trial is compared with the worst of so many last accepted values.
        - `initial_length`: length of the first step, relative to the gradient.
        - `lengths`: least and greatest length of a step, relative to the gradient.
        """
        self.descent = ProjectionArc(feasible, initial_length, *lengths)
        self.search = NonmonotoneArmijo(memory)
        self.rtol, self.atol, self.measure = rtol, atol, norm
        # The base class also measures changes of the function's value with it, for a test that is not used here.
        self.norm = optx.max_norm

    @property
    def feasible(self) -> AbstractSet:
        """The set to minimise over."""
        return self.descent.feasible

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Bool[Array, ""], optx.RESULTS]:
        del fn, args, options, tags
        queried = ~state.first_step
        optimality = self.measure(state.descent_state.projected_gradient)
        broken = queried & ~jnp.isfinite(state.f_info.f)
        done = queried & (optimality <= self.atol + self.rtol * self.measure(y))
        result = optx.RESULTS.where(broken, optx.RESULTS.nonfinite, state.result)
        return done | broken, result

    def postprocess(self, fn, y, aux, args, options, state, tags, result) -> tuple[Any, Any, dict[str, Any]]:
        del fn, args, options, tags, result
        return y, aux, {"optimality": self.measure(state.descent_state.projected_gradient)}
