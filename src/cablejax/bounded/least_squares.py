"""Base of the bounded least squares solvers: one linearisation, one model, one trial point after the other."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree, Scalar

from cablejax.bounded.certificate import projected_gradient_size
from cablejax.bounded.objective import aux_at, chosen, forward, promised_decrease, quadratic_info, value_of
from cablejax.bounded.quadratic import minimise_quadratic
from cablejax.bounded.secant import convex_part, secant_update
from cablejax.bounded.sets import ConvexSet


class _Linearisation(eqx.Module):
    """State that changes when the solve linearises."""

    at: Array
    residual: Float[Array, " M"]
    jacobian: Float[Array, "M P"]
    secant: Float[Array, "P P"]  # learned second-order part of the Hessian
    optimality: Scalar


class _Model(eqx.Module):
    """The quadratic model that steps are taken on: that of the last linearisation with Broyden's updates since."""

    f_info: Any  # FunctionInfo.EvalGradHessian
    residual: Float[Array, " M"]
    jacobian: Float[Array, "M P"]
    descent: Any
    updates: Int[Array, ""]


class _Trial(eqx.Module):
    """State that changes with every trial point."""

    search: Any
    step_size: Scalar
    objective: Scalar
    aux: Any  # of `fn` where the solve is
    stale: Bool[Array, ""]  # whether the solve has moved on from the last linearisation
    rounded: Bool[Array, ""]
    finite: Bool[Array, ""]  # whether all trials since the last real step had a value
    terminate: Bool[Array, ""]
    result: optx.RESULTS


class _State(eqx.Module):
    last: _Linearisation
    model: _Model
    trial: _Trial
    linearisations: Int[Array, ""]
    evaluations: Int[Array, ""]


class ModelDescent(optx.AbstractDescent):
    """Base of the descents that minimise a quadratic model over a convex set.

    Attributes:
        secant: whether the model's Hessian may have negative eigenvalues; these are cut off.
        feasible: the convex set; None until a solver has put in that of its options.
        y: where the model is made, in the set's own shape; likewise.
    """

    secant: bool = eqx.field(static=True)
    feasible: ConvexSet | None = None
    y: Array | None = None

    def within(self, feasible: ConvexSet, y: Array) -> Self:
        """The same descent on a set, around a point."""
        return dataclasses.replace(self, feasible=feasible, y=y)

    def convex(self, f_info: Any) -> Float[Array, "P P"]:
        """The model's Hessian, positive semi-definite."""
        hessian = f_info.hessian.as_matrix()
        return convex_part(hessian) if self.secant else hessian

    def minimum(self, hessian: Float[Array, "P P"], gradient: Float[Array, " P"]) -> Float[Array, " P"]:
        """The step to the minimum of `g'd + d'H d / 2` over the set. Raises `ValueError` before `within`."""
        if self.feasible is None or self.y is None:
            raise ValueError("The descent has no set yet: call `within` first.")
        return minimise_quadratic(hessian, gradient, self.feasible, self.y).point - self.y.ravel()


class AbstractBoundedLeastSquares(optx.AbstractLeastSquaresSolver):
    """Base of the bounded least squares solvers; `y` is one array, `fn` gives one flat array of residuals.

    One step linearises at y (unless its only trial was rejected: then the linearisation there still holds), proposes a
    trial point and evaluates the residuals there; `optimistix.AbstractGaussNewton` would linearise at every trial
    point, used or not. It ends where `|P(y - g) - y|_inf <= atol + rtol |y|_inf`, or where the model promises less than
    rounding resolves (`RESULTS.stagnation`, if the former does not hold).

    The descent is given `FunctionInfo.EvalGradHessian` of the flattened point with the Hessian `J'J + S`. Without
    `secant`, S = 0 (Gauss and Newton). With it, S is what the residuals' own curvature contributes, learned from the
    change of the Jacobian, which makes the last steps fast where residuals stay large.

    With `trials_per_linearisation` above 1 a step goes on to so many trial points, and the Jacobian follows them by
    Broyden's update (Math. Comp. 19, 1965): the least change with which the model predicts the residuals of the last
    trial, accepted or not. It costs nothing, but its gradients are not exact: only a linearisation ends a solve.

    Options: `feasible`, the set; `linearise`, a function `(y, args) -> (residuals, Jacobian [M, P])`, if there is a
    cheaper one than `jax.jacfwd`.

    Attributes:
        rtol, atol: relative and absolute tolerance on the projected gradient.
        secant: whether the curvature of the residuals is learned.
        trials_per_linearisation: trial points of one step, the Jacobian being updated in between.
        norm: `optimistix.max_norm`.
    """

    rtol: float = 0.0
    atol: float = 1e-8
    secant: bool = eqx.field(static=True, default=True)
    trials_per_linearisation: int = eqx.field(static=True, default=1)
    norm: Callable[[PyTree], Scalar] = eqx.field(default=optx.max_norm)

    def __check_init__(self):
        if not isinstance(self.trials_per_linearisation, int) or self.trials_per_linearisation < 1:
            raise ValueError(
                f"{type(self).__name__}: trials_per_linearisation is {self.trials_per_linearisation!r}, expected a "
                "whole number of at least 1."
            )

    @property
    @abc.abstractmethod
    def descent(self) -> ModelDescent:
        """The descent that proposes a step."""

    @property
    @abc.abstractmethod
    def search(self) -> optx.AbstractSearch:
        """The search that accepts a step and sets its size."""

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        """The state before the first step. Raises `ValueError` unless `fn` gives one flat array."""
        del tags
        if len(f_struct.shape) != 1:
            raise ValueError(f"{type(self).__name__} got residuals of shape {f_struct.shape}, expected a flat array.")
        dtype = f_struct.dtype
        square = jnp.zeros((y.size, y.size), dtype)
        info = quadratic_info(jnp.zeros((), dtype), jnp.zeros(y.size, dtype), square)
        descent = self.descent.within(options["feasible"].at(y), y)
        zero = jnp.zeros((), jnp.int32)
        residual, jacobian = jnp.zeros(f_struct.shape, dtype), jnp.zeros((*f_struct.shape, y.size), dtype)
        return _State(
            last=_Linearisation(y, residual, jacobian, square, jnp.asarray(jnp.inf, dtype)),
            model=_Model(info, residual, jacobian, descent.init(y.ravel(), info), zero),
            trial=_Trial(
                search=self.search.init(y.ravel(), info),
                step_size=jnp.ones((), dtype),
                objective=jnp.asarray(jnp.inf, dtype),
                # a linearisation that is given returns no aux
                aux=aux_at(fn, y, args, aux_struct),
                stale=jnp.array(True),
                rounded=jnp.array(False),
                finite=jnp.array(True),
                terminate=jnp.array(False),
                result=optx.RESULTS.successful,
            ),
            linearisations=zero,
            evaluations=zero,
        )

    def step(self, fn, y, args, options, state, tags):
        """Linearises once, then makes `trials_per_linearisation` trial points."""
        del tags
        linearise = options.get("linearise", None) or forward(lambda y, args: fn(y, args)[0])

        def renewed():
            return self._renewed(linearise, options["feasible"], y, args, state)

        def one_trial(_, at):
            return self._trial(fn, args, options["feasible"], *at)

        state = jax.lax.cond(state.trial.stale, renewed, lambda: state)
        y, state = jax.lax.fori_loop(0, self.trials_per_linearisation, one_trial, (y, state))
        return y, state, state.trial.aux

    def terminate(self, fn, y, args, options, state, tags):
        """Whether the last trial point met a stopping rule, and its result code."""
        del fn, y, args, options, tags
        return state.trial.terminate, state.trial.result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Adds the objective, the optimality and the counts of calls to the statistics."""
        del fn, args, options, tags, result
        stats = {
            "objective": state.trial.objective,
            "optimality": state.last.optimality,
            "evaluations": state.evaluations,
            "linearisations": state.linearisations,
        }
        return y, aux, stats

    def _trial(self, fn, args, feasible, y, state: _State) -> tuple[Array, _State]:
        """One trial point: where the solve goes on, and the state there."""
        info, exact, before = state.model.f_info, state.model.updates == 0, state.trial
        converged = exact & (state.last.optimality <= self.atol + self.rtol * self.norm(y))
        finite = jnp.isfinite(info.f) & jnp.isfinite(info.grad).all()
        ended = before.terminate | converged | ~finite

        def stay():
            return y, jnp.full_like(state.model.residual, jnp.inf), before.aux

        def go():
            at = feasible.at(y)
            move, _ = self.descent.within(at, y).step(before.step_size, state.model.descent)
            move = jnp.where(jnp.isfinite(move).all(), move, 0.0)
            trial = at.restore(y + move.reshape(y.shape))
            return trial, *fn(trial, args)

        trial, residual, aux = jax.lax.cond(ended, stay, go)
        value = value_of(residual)
        move = (trial - y).ravel()
        step_size, accept, _, search = self.search.step(
            jnp.array(False), y.ravel(), trial.ravel(), info, optx.FunctionInfo.Eval(value), before.search
        )
        promised = promised_decrease(info, move)
        rounding = 4 * jnp.finfo(y.dtype).eps * jnp.abs(info.f)
        rounded = promised <= rounding
        # Gradients are known better than values: two more steps are taken on trust where rounding hides their decrease.
        accept = (accept | (exact & rounded & (value <= info.f + rounding))) & jnp.isfinite(value) & ~ended
        stalled = exact & rounded & before.rounded & ~ended
        result = optx.RESULTS.where(stalled, optx.RESULTS.stagnation, before.result)  # pyright: ignore[reportArgumentType]
        met = jnp.isfinite(value) & ((accept & ~rounded) | before.finite)
        broken = ~finite | (stalled & ~met)
        after = _Trial(
            search=search,
            step_size=step_size.astype(y.dtype),
            objective=jnp.where(accept, value, info.f),
            aux=chosen(accept, aux, before.aux),
            stale=accept,
            rounded=jnp.where(exact, rounded, before.rounded),
            finite=met,
            terminate=ended | stalled,
            result=optx.RESULTS.where(broken, optx.RESULTS.nonfinite, result),  # pyright: ignore[reportArgumentType]
        )
        state = dataclasses.replace(state, trial=after, evaluations=state.evaluations + jnp.where(ended, 0, 1))
        y = jnp.where(accept, trial, y)
        return y, state if self.trials_per_linearisation == 1 else self._updated(feasible, y, move, residual, state)

    def _renewed(self, linearise, feasible, y, args, state: _State) -> _State:
        """The state with everything that belongs to a new point."""
        residual, jacobian = linearise(y, args)
        feasible = feasible.at(y)
        gradient = jacobian.T @ residual
        last = state.last
        secant, learned = last.secant, jnp.zeros_like(last.secant)
        if self.secant:
            moved = (y - last.at).ravel()
            bent = gradient - last.jacobian.T @ residual
            slope = gradient - last.jacobian.T @ last.residual
            # Used as long as it has predicted the change of the gradient better than nothing would have.
            left = slope - last.jacobian.T @ (last.jacobian @ moved)
            telling = jnp.linalg.norm(left - secant @ moved) <= jnp.linalg.norm(left)
            secant = jnp.where(state.linearisations > 0, secant_update(secant, moved, bent, slope), secant)
            learned = jnp.where(telling, secant, 0.0)
        info = quadratic_info(value_of(residual), gradient, jacobian.T @ jacobian + learned)
        descent = self.descent.within(feasible, y).query(y.ravel(), info, state.model.descent)
        optimality = projected_gradient_size(feasible, y, gradient)
        return dataclasses.replace(
            state,
            last=_Linearisation(y, residual, jacobian, secant, optimality),
            model=_Model(info, residual, jacobian, descent, jnp.zeros_like(state.model.updates)),
            linearisations=state.linearisations + 1,
        )

    def _updated(self, feasible, y, move, residual, state: _State) -> _State:
        """The state with a model that predicts the residuals of the last trial; `y` is where the solve goes on."""
        model = state.model
        missed = residual - model.residual - model.jacobian @ move
        square = jnp.sum(move**2)
        telling = (square > jnp.finfo(move.dtype).tiny) & jnp.isfinite(missed).all()
        change = jnp.outer(jnp.where(telling, missed, 0.0), move) / jnp.where(telling, square, 1.0)
        jacobian = model.jacobian + change
        residual = jnp.where(state.trial.stale, residual, model.residual)
        # what the model has learned beyond J'J stays until the next linearisation
        learned = model.f_info.hessian.as_matrix() - model.jacobian.T @ model.jacobian
        info = quadratic_info(value_of(residual), jacobian.T @ residual, jacobian.T @ jacobian + learned)
        descent = self.descent.within(feasible.at(y), y).query(y.ravel(), info, model.descent)
        return dataclasses.replace(
            state,
            model=_Model(info, residual, jacobian, descent, model.updates + 1),
            trial=dataclasses.replace(state.trial, stale=jnp.array(True)),
        )
