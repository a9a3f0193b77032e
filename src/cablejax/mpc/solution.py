"""Solving one planning problem by itself: outside the control loop, with a certificate, from one start or from many."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from cablejax.bounded.certificate import Certificate, certify
from cablejax.mpc.outcome import Outcome, Plan, Solver
from cablejax.mpc.problem import ShapingProblem


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Solution:
    """A plan and the problem that it solves.

    Attributes:
        problem: what was solved.
        plan: the plan, its cost and its outcome.
        value: of the objective [m^2], shape [].
    """

    problem: ShapingProblem
    plan: Plan
    value: Float[Array, "*batch"]

    @property
    def motion(self) -> Float[Array, "*batch T Q 3"]:
        """The plan's motions [m]."""
        return self.plan.motion

    @property
    def outcome(self) -> Int[Array, "*batch"]:
        """An `Outcome`."""
        return self.plan.outcome

    @property
    def message(self) -> str:
        """The outcome as a sentence; outside compiled code, for one problem."""
        return Outcome(int(self.outcome)).message

    def certificate(self) -> Certificate:
        """The first-order conditions of a minimum at the plan, from one gradient [m]; no other solver is asked."""
        return certify(self.problem.feasible, self.motion, jax.grad(self.problem.value)(self.motion))


def solve(problem: ShapingProblem, solver: Solver, guess: Float[Array, "T Q 3"]) -> Solution:
    """One solve, with an outcome for whatever is wrong with the problem; pure, to be compiled and vmapped.

    Differentiable in the problem's `target`, `weights`, `history`, `feasible` for every solver but the sampling ones:
    at a converged plan, as the fixed point `u = P(u - grad J(u))`, also where bounds are active.

    Args:
        problem: see `ShapingProblem`.
        solver: any `Solver`.
        guess: where to start [m]; need not be feasible.
    """
    plan = guarded_plan(problem, solver, guess)
    return Solution(problem=problem, plan=plan, value=problem.value(plan.motion))


def guarded_plan(problem: ShapingProblem, solver: Solver, guess: Float[Array, "T Q 3"]) -> Plan:
    """The solver's plan where there is a finite and feasible one; otherwise the guess made feasible, or rest."""
    feasible = problem.feasible
    possible = feasible.possible()
    # Contradicting bounds would spoil the projection: solve something, and do not use it.
    harmless = jax.tree.map(lambda leaf: jnp.where(possible, leaf, 0.0 * leaf), feasible)
    harmless = jax.tree.map(lambda leaf: jnp.where(jnp.isfinite(leaf), leaf, 0.0), harmless)
    problem = dataclasses.replace(problem, feasible=harmless)
    start = jnp.where(jnp.isfinite(guess), guess, 0.0)
    plan = solver(problem, start)
    kept = jnp.isfinite(plan.motion).all() & possible
    motion = jnp.where(kept, plan.motion, jnp.where(possible, harmless.restore(start), 0.0))
    outcome = jnp.where(harmless.starts_outside() & (plan.outcome <= Outcome.STEP_LIMIT), Outcome.OUTSIDE, plan.outcome)
    outcome = jnp.where(feasible.radius > 0, outcome, Outcome.NO_ROOM)
    outcome = jnp.where(jnp.isfinite(plan.motion).all(), outcome, Outcome.NONFINITE)
    # a bound on the change may leave no way to stop in time
    broken = harmless.violation(motion) > 1e-5 * (1.0 + harmless.max_distance)
    outcome = jnp.where(~possible | broken, Outcome.INFEASIBLE, outcome)
    return dataclasses.replace(plan, motion=motion, outcome=outcome.astype(jnp.int32))


def multi_start(problem: ShapingProblem, solver: Solver, guesses: Float[Array, "S T Q 3"]) -> tuple[Solution, Solution]:
    """The best of several starts, and all of them (with a leading axis S), solved side by side."""
    every = jax.vmap(lambda guess: solve(problem, solver, guess))(guesses)
    best = jnp.argmin(jnp.where(jnp.isfinite(every.value), every.value, jnp.inf))
    chosen = jax.tree.map(lambda leaf: leaf[best], (every.plan, every.value))
    return Solution(problem, *chosen), every


def random_starts(problem: ShapingProblem, n_commands: int, count: int, seed: int = 0) -> Float[Array, "S T Q 3"]:
    """Feasible plans at random: each gripper goes about straight on, at random speed."""
    heading, noise = jax.random.split(jax.random.key(seed))
    dtype = problem.target.dtype
    way = jax.random.normal(heading, (count, 1, 2, 3), dtype)
    motion = problem.feasible.radius * (way + 0.3 * jax.random.normal(noise, (count, n_commands, 2, 3), dtype)) / 2.0
    return jax.vmap(problem.feasible.restore)(motion)
