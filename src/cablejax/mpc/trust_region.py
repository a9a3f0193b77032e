"""Levenberg-Marquardt steps that stay inside the feasible set."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree, Scalar

from cablejax.mpc.feasible import FeasibleSet
from cablejax.mpc.problem import Outcome, Plan, ShapingProblem


@dataclasses.dataclass(frozen=True)
class TrustRegion:
    """Solver: Gauss-Newton models of the objective, minimised over the feasible set with damping.

    Each iteration minimises `||r + J d||^2 / 2 + damping ||d||^2 / 2` over the d with u + d feasible, so that active
    bounds are part of the model and not an afterthought; a plain Levenberg-Marquardt step projected back onto the set
    need not be a descent (Bertsekas, SIAM J. Control Optim. 20, 1982). The damping follows the ratio of actual to
    predicted reduction (`optimistix.ClassicalTrustRegion`).

    Attributes:
        max_iterations: linearisations at most. One costs as much as about nine gradients.
        tolerance: stop once a step moves no gripper by more than this [m].
        damping: initial damping, relative to the largest eigenvalue of J'J.
        inner_iterations: splitting iterations on each quadratic model; they cost no model evaluations.
    """

    max_iterations: int = 2
    tolerance: float = 2e-5
    damping: float = 1e-3
    inner_iterations: int = 30

    def __post_init__(self):
        if self.max_iterations < 1 or self.inner_iterations < 1:
            raise ValueError(
                f"TrustRegion(max_iterations={self.max_iterations}, inner_iterations={self.inner_iterations}): "
                "expected at least one of each."
            )
        for name in ("tolerance", "damping"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"TrustRegion.{name} is {value}, expected a positive finite number.")

    def __call__(self, problem: ShapingProblem, guess: Float[Array, "T Q 3"]) -> Plan:
        shape = guess.shape
        solution = optx.least_squares(
            lambda flat, problem: problem.residuals(flat.reshape(shape)),
            _BoundedGaussNewton(
                descent=_BoundedQuadratic(problem.feasible, self.damping, self.inner_iterations),
                search=optx.ClassicalTrustRegion(),
                tolerance=self.tolerance,
            ),
            problem.feasible.project(guess).ravel(),
            args=problem,
            options={"linearise": lambda flat, problem: problem.linearise(flat.reshape(shape))},
            max_steps=self.max_iterations,
            # Reverse mode through the iterations: the implicit one is wrong where a bound is active.
            adjoint=optx.RecursiveCheckpointAdjoint(),
            throw=False,
        )
        converged = solution.result == optx.RESULTS.successful
        return Plan(
            motion=solution.value.reshape(shape),
            evaluations=jnp.asarray(solution.stats["num_steps"], jnp.int32),
            outcome=jnp.where(converged, Outcome.CONVERGED, Outcome.STEP_LIMIT).astype(jnp.int32),
        )


class _QuadraticState(eqx.Module):
    y: Float[Array, " P"]
    slope: Float[Array, " P"]
    eigenvalues: Float[Array, " P"]
    eigenvectors: Float[Array, "P P"]


class _BoundedQuadratic(optx.AbstractDescent):
    """`step(s)` minimises `g'd + d'(J'J + damping / s) d / 2` over the d with y + d feasible.

    By the alternating direction method of multipliers (Boyd et al. 2011, section 5.2): the quadratic and the
    projection are split, so that each iteration is a product with a factored matrix and a projection. J'J is
    diagonalised once for all dampings.
    """

    feasible: FeasibleSet
    damping: float
    iterations: int = eqx.field(static=True)

    def init(self, y, f_info_struct):
        del f_info_struct
        return _QuadraticState(y, jnp.zeros_like(y), jnp.zeros_like(y), jnp.zeros((y.size, y.size), y.dtype))

    def query(self, y, f_info, state):
        del state
        jacobian = f_info.jac.as_matrix()
        eigenvalues, eigenvectors = jnp.linalg.eigh(jacobian.T @ jacobian)
        return _QuadraticState(y, jacobian.T @ f_info.residual, jnp.maximum(eigenvalues, 0.0), eigenvectors)

    def step(self, step_size, state):
        largest = state.eigenvalues[-1] + jnp.finfo(state.y.dtype).tiny
        damped = state.eigenvalues + self.damping * largest / step_size
        # Fewest iterations over problems with none to all bounds active (1/100 and 1/5 of the largest need twice).
        penalty = largest / 20.0
        basis = state.eigenvectors

        def solve(linear, diagonal):
            return basis @ ((basis.T @ linear) / diagonal)

        def split(carry, _):
            point, dual = carry
            free = solve(penalty * (point - dual) - state.slope, damped + penalty)
            relaxed = 1.6 * free - 0.6 * point
            point = self.project_step(state.y, relaxed + dual)
            return (point, dual + relaxed - point), None

        start = self.project_step(state.y, solve(-state.slope, damped))
        (point, _), _ = jax.lax.scan(split, (start, jnp.zeros_like(start)), length=self.iterations)
        return point, optx.RESULTS.successful

    def project_step(self, y: Float[Array, " P"], step: Float[Array, " P"]) -> Float[Array, " P"]:
        """The step nearest to `step` that ends in the feasible set."""
        return self.feasible.project((y + step).reshape(-1, 2, 3)).ravel() - y


class _GaussNewtonState(eqx.Module):
    f_info: Any  # FunctionInfo.ResidualJac
    descent_state: _QuadraticState
    search_state: Any
    step_size: Scalar
    stale: Bool[Array, ""]
    terminate: Bool[Array, ""]


class _BoundedGaussNewton(optx.AbstractLeastSquaresSolver):
    """`optimistix.AbstractGaussNewton`, but with a Jacobian from the problem, and none for a point that is not used.

    One step linearises at y (unless the last trial was rejected: then the linearisation there still holds), proposes
    one trial point and evaluates the residuals there.
    """

    descent: _BoundedQuadratic
    search: optx.ClassicalTrustRegion
    tolerance: float
    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable[[PyTree], Scalar] = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        del fn, args, options, aux_struct, tags
        info = _info(jnp.zeros(f_struct.shape, f_struct.dtype), jnp.zeros((*f_struct.shape, y.size), f_struct.dtype))
        return _GaussNewtonState(
            f_info=info,
            descent_state=self.descent.init(y, info),
            search_state=self.search.init(y, info),
            step_size=jnp.ones((), y.dtype),
            stale=jnp.array(True),
            terminate=jnp.array(False),
        )

    def step(self, fn, y, args, options, state, tags):
        del tags

        def renew():
            info = _info(*options["linearise"](y, args))
            return info, self.descent.query(y, info, state.descent_state)

        info, descent_state = jax.lax.cond(state.stale, renew, lambda: (state.f_info, state.descent_state))
        move, _ = self.descent.step(state.step_size, descent_state)
        trial = y + move
        residual, aux = fn(trial, args)
        step_size, accept, _, search_state = self.search.step(
            jnp.array(False), y, trial, info, optx.FunctionInfo.Residual(residual), state.search_state
        )
        longest = jnp.linalg.norm(move.reshape(-1, 3), axis=-1).max()
        state = _GaussNewtonState(
            f_info=info,
            descent_state=descent_state,
            search_state=search_state,
            step_size=step_size,
            stale=accept,
            terminate=longest <= self.tolerance,
        )
        return jnp.where(accept, trial, y), state, aux

    def terminate(self, fn, y, args, options, state, tags):
        del fn, y, args, options, tags
        return state.terminate, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        del fn, args, options, state, tags, result
        return y, aux, {}


def _info(residual: Float[Array, " M"], jacobian: Float[Array, "M P"]):
    return optx.FunctionInfo.ResidualJac(residual, lx.MatrixLinearOperator(jacobian))
