"""Spectral projected gradient descent (Birgin, Martinez, Raydan, SIAM J. Optim. 10, 2000)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree, Scalar

from cablejax.bounded.certificate import projected_gradient_size
from cablejax.bounded.objective import chosen, nothing_yet
from cablejax.bounded.sets import ConvexSet

_SLOPE = 1e-4
"""Share of the linear decrease that a trial point has to reach."""
_SHRINK = 0.3
"""Ratio of a step size and the one tried before."""


class _ArcState(eqx.Module):
    feasible: Any
    y: Array
    grad: Array
    length: Scalar
    first: Bool[Array, ""]
    optimality: Scalar


class ProjectionArc(optx.AbstractDescent):
    """`step(s) = P(y - s a g) - y`, where a is the Barzilai-Borwein length `s's / s'y` of the last accepted step.

    Attributes:
        feasible: the convex set that P projects onto; None until a solver has put in that of its options.
        initial_length: a before the first curvature is known.
        shortest: least a.
        longest: greatest a.
    """

    feasible: ConvexSet | None
    initial_length: float
    shortest: float = 1e-10
    longest: float = 1e10

    def init(self, y, f_info_struct):
        """Starts with steps of `initial_length` times the gradient."""
        del f_info_struct
        inf = jnp.asarray(jnp.inf, y.dtype)
        start = jnp.asarray(self.initial_length, y.dtype)
        return _ArcState(self.feasible, y, jnp.zeros_like(y), start, jnp.array(True), inf)

    def query(self, y, f_info, state):
        """Computes the next step's spectral length (Barzilai, Borwein) from the last move and change of gradient."""
        moved, bent = y - state.y, f_info.grad - state.grad
        curvature = jnp.sum(moved * bent)
        curved = curvature > 0
        spectral = jnp.sum(moved**2) / jnp.where(curved, curvature, 1.0)
        # Along a direction of no or negative curvature the model gives no length: try a longer one than before.
        length = jnp.clip(jnp.where(curved, spectral, 4.0 * state.length), self.shortest, self.longest)
        length = jnp.where(state.first, state.length, length)
        if self.feasible is None:
            raise ValueError('There is no feasible set: give one as options={"feasible": ...}.')
        optimality = projected_gradient_size(self.feasible, y, f_info.grad)
        return _ArcState(self.feasible, y, f_info.grad, length, jnp.array(False), optimality)

    def step(self, step_size, state):
        """The projection of a step against the gradient, `step_size` times the spectral length long."""
        target = state.y - step_size * state.length * state.grad
        return state.feasible.project(target) - state.y, optx.RESULTS.successful


class _MemoryState(eqx.Module):
    step_size: Scalar
    values: Float[Array, " M"]
    shrunk: Int[Array, ""]
    finite: Bool[Array, ""]  # whether all trials since the last accepted one had a value


class NonmonotoneArmijo(optx.AbstractSearch):
    """Backtracking until `f(y + d) <= max of the last M accepted values + slope g'd`, up to rounding.

    Grippo, Lampariello, Lucidi, SIAM J. Numer. Anal. 23, 1986.

    Attributes:
        memory: M; 1 makes every accepted step a descent.
    """

    memory: int = eqx.field(static=True)

    def init(self, y, f_info_struct):
        """A step size of one, and no values in memory."""
        values = jnp.full(self.memory, -jnp.inf, f_info_struct.f.dtype)
        return _MemoryState(jnp.ones((), y.dtype), values, jnp.zeros((), jnp.int32), jnp.array(True))

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        """Accepts a trial point that is lower than the worst value in memory, else shortens the step."""
        predicted = f_info.compute_grad_dot(y_eval - y)
        value = f_eval_info.as_min()
        reference = state.values.max()
        rounding = 4 * jnp.finfo(value.dtype).eps * jnp.abs(reference)
        sufficient = value <= reference + _SLOPE * predicted + rounding
        accept = first_step | (sufficient & (predicted <= rounding))
        values = jnp.where(accept, jnp.roll(state.values, 1).at[0].set(value), state.values)
        step_size = jnp.where(accept, 1.0, _SHRINK * state.step_size).astype(state.step_size.dtype)
        shrunk = jnp.where(accept, 0, state.shrunk + 1)
        finite = jnp.isfinite(value) & (accept | state.finite)
        state = _MemoryState(step_size, values, shrunk, finite)
        return step_size, accept, optx.RESULTS.successful, state


class _SpectralState(eqx.Module):
    inner: Any
    best: Array
    best_value: Scalar
    best_aux: Any
    linearisations: Int[Array, ""]
    steps: Int[Array, ""]


class SpectralProjectedGradient(optx.AbstractGradientDescent):
    """Minimiser over a feasible set: gradient steps of Barzilai-Borwein length along the projection arc.

    It ends where `|P(y - g) - y|_inf <= atol + rtol |y|_inf`, and returns the point where that holds; if it ends in
    another way, the best point that it has seen. Every trial point costs one evaluation of the function, every accepted
    one its gradient. All points are feasible if the first is.

    Options: `feasible`, the set.

    Attributes:
        rtol, atol: relative and absolute tolerance on the projected gradient.
        norm: always `optimistix.max_norm`.
        descent, search: the projection arc, and what accepts a point on it.
    """

    rtol: float
    atol: float
    norm: Callable[[PyTree], Scalar]
    descent: ProjectionArc
    search: NonmonotoneArmijo

    def __init__(
        self,
        rtol: float = 0.0,
        atol: float = 1e-8,
        memory: int = 10,
        initial_length: float = 1.0,
        lengths: tuple[float, float] = (1e-10, 1e10),
    ):
        """Makes the solver.

        Args:
            rtol: relative tolerance on the projected gradient.
            atol: absolute tolerance on it.
            memory: a trial is compared with the worst of so many last accepted values.
            initial_length: length of the first step, relative to the gradient.
            lengths: least and greatest length of a step, relative to the gradient.
        """
        if not isinstance(memory, int) or memory < 1:
            raise ValueError(f"SpectralProjectedGradient: memory is {memory!r}, expected a whole number of at least 1.")
        self.descent = ProjectionArc(None, initial_length, *lengths)
        self.search = NonmonotoneArmijo(memory)
        self.rtol, self.atol, self.norm = rtol, atol, optx.max_norm

    def within(self, feasible: ConvexSet) -> SpectralProjectedGradient:
        """The same solver on a convex set."""
        return eqx.tree_at(lambda s: s.descent.feasible, self, feasible, is_leaf=lambda x: x is None)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        """The state before the first step."""
        solver = self.within(options["feasible"].at(y))
        inner = super(SpectralProjectedGradient, solver).init(fn, y, args, options, f_struct, aux_struct, tags)
        zero, inf = jnp.zeros((), jnp.int32), jnp.asarray(jnp.inf, f_struct.dtype)
        return _SpectralState(inner, y, inf, nothing_yet(aux_struct), zero, zero)

    def step(self, fn, y, args, options, state: Any, tags):
        """One trial point; keeps the best one so far."""
        feasible = options["feasible"].at(state.inner.y_eval)
        solver = self.within(feasible)
        # the aux that this returns is that of the step before
        y, inner, _ = super(SpectralProjectedGradient, solver).step(fn, y, args, options, state.inner, tags)
        # the arc is a difference of points, which rounding may leave outside
        inner = eqx.tree_at(lambda s: s.y_eval, inner, feasible.restore(inner.y_eval))
        accepted = inner.search_state.shrunk == 0
        better = inner.f_info.f < state.best_value
        state = _SpectralState(
            inner=inner,
            best=jnp.where(better, y, state.best),
            best_value=jnp.where(better, inner.f_info.f, state.best_value),
            best_aux=chosen(better, inner.aux, state.best_aux),
            linearisations=state.linearisations + accepted,
            steps=state.steps + 1,
        )
        return y, state, state.best_aux

    def terminate(self, fn, y, args, options, state: Any, tags) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """Whether a stopping rule is met, and its result code."""
        del fn, args, options, tags
        inner = state.inner
        started = ~inner.first_step
        done = started & self._converged(inner)
        stalled = ~done & (inner.search_state.step_size < jnp.finfo(y.dtype).eps)
        broken = started & ~(jnp.isfinite(inner.f_info.f) & jnp.isfinite(inner.descent_state.optimality))
        broken = broken | (stalled & ~inner.search_state.finite)
        result = optx.RESULTS.where(stalled, optx.RESULTS.stagnation, inner.result)  # pyright: ignore[reportArgumentType]
        result = optx.RESULTS.where(broken, optx.RESULTS.nonfinite, result)
        return done | broken | stalled, result

    def postprocess(self, fn, y, aux, args, options, state: Any, tags, result) -> tuple[Any, Any, dict[str, Any]]:
        """Returns the last point where it is a minimum, else the best one, and the statistics."""
        del fn, y, aux, args, options, tags, result
        inner = state.inner
        # A lower value that was seen on the way does not meet the conditions of a minimum.
        done = self._converged(inner)
        stats = {
            "optimality": inner.descent_state.optimality,
            "objective": jnp.where(done, inner.f_info.f, state.best_value),
            "evaluations": state.steps,
            "linearisations": state.linearisations,
        }
        value = jnp.where(done, inner.descent_state.y, state.best)
        return value, chosen(done, inner.aux, state.best_aux), stats

    def _converged(self, inner) -> Bool[Array, ""]:
        descent = inner.descent_state
        return descent.optimality <= self.atol + self.rtol * self.norm(descent.y)
