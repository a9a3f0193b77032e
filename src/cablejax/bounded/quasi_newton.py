"""Quasi-Newton steps that stay inside a feasible set: gradients only, and fast at the end."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Int, PyTree, Scalar

from cablejax.bounded.certificate import projected_gradient_size
from cablejax.bounded.gain_ratio import GainRatio
from cablejax.bounded.levenberg_marquardt import DampedQuadratic
from cablejax.bounded.objective import chosen, nothing_yet, promised_decrease, quadratic_info
from cablejax.bounded.secant import positive_update, sized


class _State(eqx.Module):
    f_info: Any  # FunctionInfo.EvalGradHessian
    trial: Array
    aux: Any  # of `fn` where the solve is
    descent_state: Any
    search_state: Any
    step_size: Scalar
    optimality: Scalar
    rounded: Bool[Array, ""]
    finite: Bool[Array, ""]  # whether all trials since the last real step had a value and a gradient
    terminate: Bool[Array, ""]
    result: optx.RESULTS
    evaluations: Int[Array, ""]


class BoundedQuasiNewton(optx.AbstractMinimiser):
    """Minimiser over a feasible set: a model of the Hessian that learns from gradients, minimised over the set.

    Every step takes the function and its gradient at one trial point. If that is accepted, the change of the gradient
    updates the model (`positive_update`, after Broyden, Fletcher, Goldfarb and Shanno). The model's minimum over the
    set, damped as in Levenberg and Marquardt's method, is the next trial point. It ends where
    `|P(y - g) - y|_inf <= atol + rtol |y|_inf`, or where the model promises less than rounding resolves
    (`RESULTS.stagnation`, if the former does not hold).

    It keeps a dense P by P matrix. Where bounds couple variables, or are active at the minimum, the model is minimised
    with them: no active set has to be guessed.

    Options: `feasible`, the set; `hessian`, a function `(y, args) -> [P, P]` that gives the first model, positive
    semi-definite. Without it the model begins as a multiple of the identity, with which the first step is not longer
    than 1 nor than the gradient. `least_squares` gives `J'J` at the start.

    Attributes:
        rtol, atol: relative and absolute tolerance on the projected gradient.
        norm: `optimistix.max_norm`.
    """

    rtol: float = 0.0
    atol: float = 1e-8
    norm: Callable[[PyTree], Scalar] = eqx.field(default=optx.max_norm)

    @property
    def descent(self) -> DampedQuadratic:
        """The minimum of the damped model over the set."""
        return DampedQuadratic(secant=False)

    @property
    def search(self) -> GainRatio:
        """The damping follows the reductions."""
        # a model that is hardly damped any more gains nothing by less, and takes more trials to come back from it
        return GainRatio(largest=10.0)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        """The state before the first step; `options["hessian"]`, where given, is the first model."""
        del fn, tags
        dtype, model = f_struct.dtype, options.get("hessian")
        hessian = jnp.zeros((y.size, y.size), dtype) if model is None else model(y, args)
        info = quadratic_info(jnp.asarray(jnp.inf, dtype), jnp.zeros(y.size, dtype), hessian)
        descent = self.descent.within(options["feasible"].at(y), y)
        zero = jnp.zeros((), jnp.int32)
        return _State(
            f_info=info,
            trial=y,
            aux=nothing_yet(aux_struct),
            descent_state=descent.init(y.ravel(), info),
            search_state=self.search.init(y.ravel(), info),
            step_size=jnp.ones((), dtype),
            optimality=jnp.asarray(jnp.inf, dtype),
            rounded=jnp.array(False),
            finite=jnp.array(True),
            terminate=jnp.array(False),
            result=optx.RESULTS.successful,
            evaluations=zero,
        )

    def step(self, fn, y, args, options, state: _State, tags):
        """Takes the gradient at the trial point, decides on it, and finds the next one."""
        del tags
        (value, aux), gradient = jax.value_and_grad(fn, has_aux=True)(state.trial, args)
        given = options.get("hessian") is not None
        y, state = self._decide(y, value, aux, gradient.ravel(), given, state)
        return y, self._next_trial(options["feasible"], y, state), state.aux

    def _decide(self, y, value, aux, gradient, given: bool, state: _State) -> tuple[Array, _State]:
        """The next point and its model; `given` = the first model was."""
        info, first = state.f_info, state.evaluations == 0
        move, bent = (state.trial - y).ravel(), gradient - info.grad
        finite = jnp.isfinite(value) & jnp.isfinite(gradient).all()
        step_size, accept, _, search_state = self.search.step(
            *(first, y.ravel(), state.trial.ravel(), info),
            # a point without a gradient is no place to go on from, whatever its value
            *(optx.FunctionInfo.Eval(jnp.where(finite, value, jnp.nan)), state.search_state),
        )
        # Gradients are known better than values: where rounding hides the decrease, a step is taken on trust.
        rounding = 4 * jnp.finfo(y.dtype).eps * jnp.abs(info.f)
        accept = (accept | (state.rounded & (value <= info.f + rounding))) & finite
        # the start is no step, and has no size to learn from
        step_size = jnp.where(first, state.step_size, step_size).astype(y.dtype)
        search_state = jax.tree.map(lambda new, old: jnp.where(first, old, new), search_state, state.search_state)

        met = finite & ((accept & ~state.rounded) | state.finite)
        model = info.hessian.as_matrix()
        begun = model
        if not given:
            begun = jnp.eye(y.size, dtype=y.dtype) * jnp.maximum(jnp.linalg.norm(gradient), 1.0)
            # the first step's length was a guess: the curvature along it is better
            model = jnp.where(state.evaluations == 1, sized(model, move, bent), model)
        learned = jnp.where(accept, positive_update(model, move, bent), model)
        info = quadratic_info(
            jnp.where(accept, value, info.f),
            jnp.where(accept, gradient, info.grad),
            jnp.where(first, begun, learned),
        )
        broken = first & ~finite
        state = dataclasses.replace(
            state,
            f_info=info,
            aux=chosen(accept | first, aux, state.aux),
            search_state=search_state,
            step_size=step_size,
            finite=met,
            terminate=broken,
            result=optx.RESULTS.where(broken, optx.RESULTS.nonfinite, state.result),
            evaluations=state.evaluations + 1,
        )
        return jnp.where(accept, state.trial, y), state

    def _next_trial(self, feasible, y, state: _State) -> _State:
        """The state with the next trial point, and with the verdict on this one."""
        info, feasible = state.f_info, feasible.at(y)
        descent = self.descent.within(feasible, y)
        descent_state = descent.query(y.ravel(), info, state.descent_state)
        move, _ = descent.step(state.step_size, descent_state)
        trial = feasible.restore(y + jnp.where(jnp.isfinite(move).all(), move, 0.0).reshape(y.shape))
        move = (trial - y).ravel()
        promised = promised_decrease(info, move)
        rounded = promised <= 4 * jnp.finfo(y.dtype).eps * jnp.abs(info.f)

        # a start without a value has no gradient
        optimality = jnp.where(state.terminate, jnp.inf, projected_gradient_size(feasible, y, info.grad))
        converged = optimality <= self.atol + self.rtol * self.norm(y)
        # after a step that was taken on trust
        stalled = state.rounded & rounded & ~converged & ~state.terminate
        result = optx.RESULTS.where(stalled, optx.RESULTS.stagnation, state.result)  # pyright: ignore[reportArgumentType]
        result = optx.RESULTS.where(stalled & ~state.finite, optx.RESULTS.nonfinite, result)  # pyright: ignore[reportArgumentType]
        return dataclasses.replace(
            state,
            trial=trial,
            descent_state=descent_state,
            optimality=optimality,
            rounded=rounded,
            terminate=state.terminate | converged | stalled,
            result=result,
        )

    def terminate(self, fn, y, args, options, state: _State, tags):
        """Whether the last step met a stopping rule, and its result code."""
        del fn, y, args, options, tags
        return state.terminate, state.result

    def postprocess(self, fn, y, aux, args, options, state: _State, tags, result):
        """Adds the objective, the optimality and the counts of calls to the statistics."""
        del fn, args, options, tags, result
        stats = {
            "objective": state.f_info.f,
            "optimality": state.optimality,
            "evaluations": state.evaluations,
            "linearisations": state.evaluations,
        }
        return y, aux, stats
