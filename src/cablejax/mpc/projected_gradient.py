"""Spectral projected gradient descent (Birgin, Martinez, Raydan, SIAM J. Optim. 10, 2000)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree, Scalar

from cablejax.mpc.feasible import FeasibleSet
from cablejax.mpc.problem import Outcome, Plan, ShapingProblem


@dataclasses.dataclass(frozen=True)
class ProjectedGradient:
    """Solver: gradient steps of Barzilai-Borwein length along the projection arc `P(u - s a g)`.

    Every evaluation costs one rollout, and an accepted one its gradient in reverse mode.

    Attributes:
        max_evaluations: trial plans, the guess included.
        tolerance: stop once a unit gradient step, projected, would move no gripper by more than this [m].
        initial_step: a before the first curvature is known. The objective's Hessian is near 1 per step of the horizon
            that a motion is felt in, and up to about 17 for the six-step sum, hence 0.1.
        memory: a trial is compared with the worst of this many last accepted values (Grippo, Lampariello, Lucidi
            1986); 1 makes every accepted step a descent.
    """

    max_evaluations: int = 12
    tolerance: float = 2e-5
    initial_step: float = 0.1
    memory: int = 1

    def __post_init__(self):
        if self.max_evaluations < 2 or self.memory < 1:
            raise ValueError(
                f"ProjectedGradient(max_evaluations={self.max_evaluations}, memory={self.memory}): expected at least "
                "2 evaluations (the guess and one step) and a memory of at least 1."
            )
        for name in ("tolerance", "initial_step"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"ProjectedGradient.{name} is {value}, expected a positive finite number.")

    def __call__(self, problem: ShapingProblem, guess: Float[Array, "T Q 3"]) -> Plan:
        solution = optx.minimise(
            lambda motion, problem: problem.value(motion),
            _SpectralDescent(
                descent=_ProjectionArc(problem.feasible, self.initial_step),
                search=_NonmonotoneArmijo(memory=self.memory),
                tolerance=self.tolerance,
            ),
            problem.feasible.project(guess),
            args=problem,
            max_steps=self.max_evaluations,
            # Reverse mode through the iterations: the implicit one is wrong where a bound is active.
            adjoint=optx.RecursiveCheckpointAdjoint(),
            throw=False,
        )
        converged = solution.result == optx.RESULTS.successful
        return Plan(
            motion=solution.value,
            evaluations=jnp.asarray(solution.stats["num_steps"], jnp.int32),
            outcome=jnp.where(converged, Outcome.CONVERGED, Outcome.STEP_LIMIT).astype(jnp.int32),
        )


class _ArcState(eqx.Module):
    motion: Array
    grad: Array
    length: Scalar
    first: Bool[Array, ""]


class _ProjectionArc(optx.AbstractDescent):
    """`step(s) = P(u - s a g) - u`, where a is the Barzilai-Borwein length `s's / s'y` of the last accepted step."""

    feasible: FeasibleSet
    initial_step: float

    def init(self, y, f_info_struct):
        del f_info_struct
        return _ArcState(y, jnp.zeros_like(y), jnp.asarray(self.initial_step, y.dtype), jnp.array(True))

    def query(self, y, f_info, state):
        moved, bent = y - state.motion, f_info.grad - state.grad
        curvature = jnp.sum(moved * bent)
        curved = curvature > 0
        spectral = jnp.sum(moved**2) / jnp.where(curved, curvature, 1.0)
        # Along a direction of no or negative curvature the model gives no length: try a longer one than before.
        length = jnp.clip(jnp.where(curved, spectral, 4.0 * state.length), 1e-3, 1e2)
        return _ArcState(y, f_info.grad, jnp.where(state.first, state.length, length), jnp.array(False))

    def step(self, step_size, state):
        target = state.motion - step_size * state.length * state.grad
        return self.feasible.project(target) - state.motion, optx.RESULTS.successful

    def optimality(self, state: _ArcState) -> Scalar:
        """Largest move of one gripper under a unit projected gradient step: 0 exactly at a stationary point [m]."""
        move = self.feasible.project(state.motion - state.grad) - state.motion
        return jnp.linalg.norm(move, axis=-1).max()


class _MemoryState(eqx.Module):
    step_size: Scalar
    values: Float[Array, " M"]


class _NonmonotoneArmijo(optx.AbstractSearch):
    """Backtracking until `f(u + d) <= max of the last M accepted values + slope g'd`, up to rounding."""

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
        accept = first_step | (sufficient & (predicted <= 0))
        values = jnp.where(accept, jnp.roll(state.values, 1).at[0].set(value), state.values)
        step_size = jnp.where(accept, 1.0, self.shrink * state.step_size).astype(state.step_size.dtype)
        return step_size, accept, optx.RESULTS.successful, _MemoryState(step_size, values)


class _SpectralDescent(optx.AbstractGradientDescent):
    descent: _ProjectionArc
    search: _NonmonotoneArmijo
    tolerance: float
    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable[[PyTree], Scalar] = optx.max_norm

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Bool[Array, ""], optx.RESULTS]:
        del fn, y, args, options, tags
        queried = ~state.first_step
        return queried & (self.descent.optimality(state.descent_state) <= self.tolerance), state.result

    def postprocess(self, fn, y, aux, args, options, state, tags, result) -> tuple[Any, Any, dict[str, Any]]:
        del fn, args, options, state, tags, result
        return y, aux, {}
