"""The same problem from several starts at once."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cablejax.mpc.plan import Plan, Solver
from cablejax.mpc.problem import ShapingProblem


def multi_start(
    problem: ShapingProblem, solver: Solver, guesses: Float[Array, "S T Q 3"]
) -> tuple[Plan, Plan, Float[Array, " S"]]:
    """The best plan of several starts; all of them, with a leading axis S; and their values [m^2], inf for NaN."""
    every = jax.vmap(lambda guess: solver(problem, problem.start(guess)))(guesses)
    values = jnp.where(jnp.isfinite(every.value), every.value, jnp.inf)
    best = jnp.argmin(values)
    return jax.tree.map(lambda leaf: leaf[best], every), every, values


def random_starts(problem: ShapingProblem, n_commands: int, count: int, seed: int = 0) -> Float[Array, "S T Q 3"]:
    """Feasible plans at random: each gripper goes about straight on, at random speed."""
    heading, noise = jax.random.split(jax.random.key(seed))
    dtype = problem.target.dtype
    way = jax.random.normal(heading, (count, 1, 2, 3), dtype)
    motion = problem.feasible.radius * (way + 0.3 * jax.random.normal(noise, (count, n_commands, 2, 3), dtype)) / 2.0
    return jax.vmap(problem.feasible.project)(motion)
