"""What the bounded least squares solvers share: one linearisation, one model, one trial point after the other."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from equinox import AbstractVar
from jaxtyping import Array, Bool, Float, Int, PyTree, Scalar

from cablejax.bounded.sets import AbstractSet


class _State(eqx.Module):
    f_info: Any  # FunctionInfo.EvalGradHessian
    residual: Float[Array, " M"]
    jacobian: Float[Array, "M P"]
    secant: Float[Array, "P P"]
    linearised_at: Float[Array, " P"]
    descent_state: Any
    search_state: Any
    step_size: Scalar
    optimality: Scalar
    stale: Bool[Array, ""]
    rounded: Bool[Array, ""]
    terminate: Bool[Array, ""]
    result: optx.RESULTS
    linearisations: Int[Array, ""]


class AbstractProjectedLeastSquares(optx.AbstractLeastSquaresSolver):
    """Base of the bounded least squares solvers; `y` is one flat array, `fn` gives one.

    One step linearises at y (unless the last trial was rejected: then the linearisation there still holds), proposes
    one trial point and evaluates the residuals there; `optimistix.AbstractGaussNewton` would linearise at every trial
    point, used or not. It ends where `norm(P(y - g) - y) <= atol + rtol norm(y)`, or where the model promises less than
    rounding.

    The descent is given `FunctionInfo.EvalGradHessian` with the Hessian `J'J + S`. Without `secant`, S = 0 (Gauss and
    Newton). With it, S is the part that the residuals' own curvature contributes, learned from the change of the
    Jacobian (Dennis, Gay, Welsch, ACM TOMS 7, 1981), which makes the last steps fast where residuals stay large.

    Supports the option `linearise`: a function `(y, args) -> (residuals, Jacobian [M, P])`, if there is a cheaper one
    than `jax.jacfwd`.
    """

    feasible: AbstractVar[AbstractSet]
    rtol: AbstractVar[float]
    atol: AbstractVar[float]
    norm: AbstractVar[Callable[[PyTree], Scalar]]
    descent: AbstractVar[optx.AbstractDescent]
    search: AbstractVar[optx.AbstractSearch]
    secant: AbstractVar[bool]

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        del fn, args, options, aux_struct, tags
        if y.ndim != 1 or len(f_struct.shape) != 1:
            raise ValueError(
                f"{type(self).__name__} got y of shape {y.shape} and residuals of shape {f_struct.shape}, expected one "
                "flat array each: ravel them."
            )
        dtype = f_struct.dtype
        square = jnp.zeros((y.size, y.size), dtype)
        info = _info(jnp.zeros((), dtype), jnp.zeros_like(y), square)
        return _State(
            f_info=info,
            residual=jnp.zeros(f_struct.shape, dtype),
            jacobian=jnp.zeros((*f_struct.shape, y.size), dtype),
            secant=square,
            linearised_at=y,
            descent_state=self.descent.init(y, info),
            search_state=self.search.init(y, info),
            step_size=jnp.ones((), y.dtype),
            optimality=jnp.asarray(jnp.inf, y.dtype),
            stale=jnp.array(True),
            rounded=jnp.array(False),
            terminate=jnp.array(False),
            result=optx.RESULTS.successful,
            linearisations=jnp.zeros((), jnp.int32),
        )

    def step(self, fn, y, args, options, state, tags):
        del tags
        linearise = options.get("linearise", None) or _forward(fn)
        state = jax.lax.cond(state.stale, lambda: self._renewed(linearise, y, args, state), lambda: state)
        converged = state.optimality <= self.atol + self.rtol * self.norm(y)
        finite = jnp.isfinite(state.f_info.f) & jnp.isfinite(state.f_info.grad).all()

        def stay():
            return y, jnp.full_like(state.f_info.f, jnp.inf), jnp.zeros_like(y), optx.RESULTS.successful

        def go():
            move, result = self.descent.step(state.step_size, state.descent_state)
            move = jnp.where(jnp.isfinite(move).all(), move, 0.0)
            value = 0.5 * jnp.sum(fn(y + move, args)[0] ** 2)
            return y + move, value, move, result

        trial, value, move, result = jax.lax.cond(converged | ~finite, stay, go)
        step_size, accept, _, search_state = self.search.step(
            jnp.array(False), y, trial, state.f_info, optx.FunctionInfo.Eval(value), state.search_state
        )
        hessian = state.f_info.hessian.as_matrix()
        promised = -(jnp.sum(state.f_info.grad * move) + 0.5 * move @ hessian @ move)
        rounding = 4 * jnp.finfo(y.dtype).eps * jnp.abs(state.f_info.f)
        rounded = promised <= rounding
        # Gradients are known better than values: two more steps are taken on trust where values cannot tell.
        accept = (accept | (rounded & (value <= state.f_info.f + rounding))) & jnp.isfinite(value)
        result = optx.RESULTS.where(finite, result, optx.RESULTS.nonfinite)
        failed = result != optx.RESULTS.successful
        state = eqx.tree_at(
            lambda s: (s.search_state, s.step_size, s.stale, s.rounded, s.terminate, s.result),
            state,
            (search_state, step_size, accept, rounded, converged | (rounded & state.rounded) | failed, result),
        )
        return jnp.where(accept & ~failed, trial, y), state, None

    def terminate(self, fn, y, args, options, state, tags):
        del fn, y, args, options, tags
        return state.terminate, state.result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        del fn, args, options, tags, result
        return y, aux, {"linearisations": state.linearisations, "optimality": state.optimality}

    def _renewed(self, linearise, y, args, state: _State) -> _State:
        """The state with everything that belongs to a new point."""
        residual, jacobian = linearise(y, args)
        gradient = jacobian.T @ residual
        secant = state.secant
        if self.secant:
            moved = y - state.linearised_at
            bent = gradient - state.jacobian.T @ residual
            slope = gradient - state.jacobian.T @ state.residual
            secant = jnp.where(state.linearisations > 0, _secant_update(secant, moved, bent, slope), secant)
        info = _info(0.5 * jnp.sum(residual**2), gradient, jacobian.T @ jacobian + secant)
        optimality = self.norm(self.feasible.project(y - gradient) - y)
        return eqx.tree_at(
            lambda s: (
                *(s.f_info, s.residual, s.jacobian, s.secant, s.linearised_at),
                *(s.descent_state, s.optimality, s.linearisations),
            ),
            state,
            (
                *(info, residual, jacobian, secant, y),
                *(self.descent.query(y, info, state.descent_state), optimality, state.linearisations + 1),
            ),
        )


def _info(value: Scalar, gradient: Float[Array, " P"], hessian: Float[Array, "P P"]):
    return optx.FunctionInfo.EvalGradHessian(value, gradient, lx.MatrixLinearOperator(hessian))


def _forward(fn):
    """`fn` and its Jacobian in forward mode."""

    def linearise(y, args):
        def twice(y):
            residual = fn(y, args)[0]
            return residual, residual

        jacobian, residual = jax.jacfwd(twice, has_aux=True)(y)
        return residual, jacobian

    return linearise


def _secant_update(secant, moved, bent, slope):
    """The symmetric S nearest to the last one with `S s = y#`, after sizing it (Dennis, Gay, Welsch 1981, eq. 3.5)."""
    curved = jnp.sum(moved * bent)
    expected = moved @ secant @ moved
    tiny = jnp.finfo(moved.dtype).tiny
    size = jnp.minimum(jnp.abs(curved) / jnp.maximum(jnp.abs(expected), tiny), 1.0)
    sized = size * secant
    along = jnp.sum(moved * slope)
    rest = bent - sized @ moved
    correction = (jnp.outer(rest, slope) + jnp.outer(slope, rest)) / along
    correction = correction - jnp.sum(moved * rest) * jnp.outer(slope, slope) / along**2
    # a slope that does not see the move says nothing
    telling = along > 1e-8 * jnp.linalg.norm(moved) * jnp.linalg.norm(slope)
    return jnp.where(telling & jnp.isfinite(correction).all(), sized + correction, secant)
