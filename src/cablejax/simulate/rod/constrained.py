"""An elastic chain whose edges keep their length: one linear system in the nodes, one constraint per edge.

Finds the free nodes X [m] and the tensions lambda of

    A0 x + D' (lambda o D x) = b,        (|D x|^2 - h^2) / 2 = eps lambda,

where x are all nodes with the four held ones among them. Since A0 is the same for x, y and z, and a squared length has
the unit matrix for a Hessian, Newton's method on (X, lambda) is exact with matrices of nodes by nodes only,

    A = A0 + D' diag(lambda) D,    S = (D x)(D x)' o (D A^-1 D') + eps,

instead of three times as many rows (the Schur complement of Goldenthal et al., Efficient simulation of inextensible
cloth, 2007, with the geometric stiffness of Tournier et al., Stable constrained dynamics, 2015). A little compliance
`eps` keeps the system regular where the clamps are further apart than the cable is long.

Newton steps are damped by the natural monotonicity test (Deuflhard, Newton methods for nonlinear problems, 2004,
chapter 3): a step s is shortened until the correction that would follow it with the same matrices, s2, is shorter than
s. The test does not depend on units or conditioning; s2 estimates in metres what is still missing, and costs a few
products. A full step is followed by s2 and by further corrections with the same matrices (the simplified Newton method,
chapter 2 there) for as long as each is much shorter than the last: factors cost as much as several of them.

Derivatives are those of the solution, by the implicit function theorem, in forward and in reverse mode.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

TOLERANCE = 1e-9
"""The system is solved once no node is further than this from where the next correction would take it [m]. Edges then
keep their length within twice this."""
# Newton's method converges in two or three iterations or not at all; halving a time step is cheaper than more of them.
_MOST_ITERATIONS = 12
_SHORTEST_SHARE = 2.0**-6
# Corrections with the same matrices follow each other while each is at most this part of the last.
_SHRINKS = 0.1
# An edge must not turn over in one step: no node moves by more than this part of an edge.
_LONGEST = 0.7
# From far away: so many steps without compression first, and at most so many in all.
_CONVEX = 8
_MOST_FAR = 600


def edges_of(nodes: Float[Array, "n 3"]) -> Float[Array, "e 3"]:
    """D x: the edges that may move, all but the two that are held."""
    return nodes[2:-1] - nodes[1:-2]


def _spread(forces: Float[Array, "e 3"]) -> Float[Array, "f 3"]:
    """D' f at the free nodes."""
    return forces[:-1] - forces[1:]


def bends_of(nodes: Float[Array, "n 3"]) -> Float[Array, "J 3"]:
    """D2 x: second differences at all nodes but the first and the last."""
    return nodes[2:] - 2.0 * nodes[1:-1] + nodes[:-2]


def spread_bends(forces: Float[Array, "J 3"]) -> Float[Array, "f 3"]:
    """D2' f at the free nodes."""
    return forces[2:] - 2.0 * forces[1:-1] + forces[:-2]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ElasticChain:
    """The constant part of the system: A0 x = weight o x + D2' (bending o D2 x) + P' P x.

    Attributes:
        weight: of each free node, shape [f].
        bending: of each joint, shape [J].
        edge: h, length of an edge [m].
        compliance: eps.
        pins: P, rows that tie free nodes to what is observed, shape [m, f]; none in a time step that is shown nothing.
    """

    weight: Float[Array | np.ndarray, "f"]
    bending: Float[Array | np.ndarray, "J"]
    edge: Float[Array | np.ndarray, ""]
    compliance: Float[Array | np.ndarray, ""]
    pins: Float[Array | np.ndarray, "m f"]


def with_held(free: Float[Array, "f 3"], held: Float[Array, "4 3"]) -> Float[Array, "n 3"]:
    """All nodes: two held ones, the free ones, two held ones."""
    return jnp.concatenate([held[:2], free, held[2:]])


class Solution(NamedTuple):
    """Solution of the system, or the last iterate if it was not solved.

    Attributes:
        free: nodes [m].
        tension: lambda.
        error: length of the longest correction of a node that the last iteration made [m]; the solution is found where
            it is at most `TOLERANCE`. Has no derivative.
    """

    free: Float[Array, "f 3"]
    tension: Float[Array, "e"]
    error: Float[Array, ""]


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def constrained(
    far: bool,
    chain: ElasticChain,
    force: Float[Array, "f 3"],
    held: Float[Array, "4 3"],
    free: Float[Array, "f 3"],
    tension: Float[Array, "e"],
) -> Solution:
    """Solves the system by Newton's method from `free` and `tension`.

    Far from the solution, compression makes the matrix indefinite, and pushes the nodes into a wrong fold; a cable that
    is pressed together along its length is near such a point. So the first steps leave it out of the matrix. They
    converge slowly to a minimum of the energy; where Newton's method does not take over, twice as many follow.

    Args:
        far: whether the guess may be far from the solution. A time step is rather made again in two halves.
        chain: A0, h and eps.
        force: b.
        held: the first two and the last two nodes [m].
        free: first guess of the free nodes [m]; no derivative passes through it.
        tension: first guess of lambda; no derivative passes through it.
    """
    stiffness, most = _matrix(chain), _MOST_FAR if far else _MOST_ITERATIONS
    # a step is measured in lengths, tensions too
    size = partial(_size, chain.edge / jnp.mean(jnp.diagonal(stiffness)))

    def newton(at):
        free, tension, _, count, left, run = at
        convex = far & (left > 0)
        edges, residual, violation = _residuals(chain, force, held, free, tension)
        matrices = _inverses(chain, stiffness, edges, jnp.where(convex, jnp.maximum(tension, 0.0), tension))
        step, change = _solve(*matrices, edges, residual, violation)
        whole, longest = size(step, change), _longest(step)

        def trial(share):
            _, residual, violation = _residuals(chain, force, held, free + share * step, tension + share * change)
            more = _solve(*matrices, edges, residual, violation)
            return share, more, size(*more) / whole

        def rises(tried):
            share, _, ratio = tried
            return ~(ratio <= 1 - 0.25 * share) & (share > _SHORTEST_SHARE) & (longest > TOLERANCE) & ~convex

        begin = trial(jnp.minimum(1.0, _LONGEST * chain.edge / (longest + 1e-30)))
        share, more, ratio = jax.lax.while_loop(rises, lambda tried: trial(0.5 * tried[0]), begin)
        # of a step that is nothing but rounding, the correction is too
        ended = ~convex & (longest <= TOLERANCE)
        full = ~convex & (share >= 1.0) & (ratio < 0.5)
        lower = convex | ended | (ratio <= 1 - 0.25 * share)

        def again(at):
            """Makes the correction, and finds the next."""
            free, tension, more, *_ = at
            free, tension = free + more[0], tension + more[1]
            _, residual, violation = _residuals(chain, force, held, free, tension)
            following = _solve(*matrices, edges, residual, violation)
            return free, tension, following, _longest(more[0]), size(*following) / size(*more)

        def missing(at):
            *_, last, ratio = at
            return full & (last > TOLERANCE) & (ratio <= _SHRINKS)

        stepped = (free + share * step, tension + jnp.where(convex, 1.0, share) * change)
        # the first correction is made in any case
        moved, pulled, _, last, _ = jax.lax.while_loop(missing, again, (*stepped, more, longest, jnp.zeros_like(ratio)))
        error = jnp.where(full | ended, last, jnp.inf)
        return (
            jnp.where(lower, moved, free),
            jnp.where(lower, pulled, tension),
            error,
            # no share of the step is an improvement: the next iterations would do no better
            jnp.where(lower | far, count + 1, most),
            jnp.where(convex, left - 1, jnp.where(lower, 0, run)),
            jnp.where(lower, run, 2 * run),
        )

    start = (free, tension, jnp.asarray(jnp.inf, free.dtype), 0, _CONVEX, 2 * _CONVEX)
    free, tension, error, *_ = jax.lax.while_loop(lambda at: ~(at[2] <= TOLERANCE) & (at[3] < most), newton, start)
    return Solution(free, tension, error)


@constrained.defjvp
def _constrained_jvp(far, primals, tangents):
    chain, _, held, *_ = primals
    d_chain, d_force, d_held, *_ = tangents
    solution = constrained(far, *primals)
    free = solution.free
    # where there is no solution there is no derivative; what stands in for it is finite, so that it can be left out
    tension = jnp.where(solution.error <= TOLERANCE, solution.tension, 0.0)
    nodes, d_nodes = with_held(free, held), with_held(jnp.zeros_like(free), d_held)
    edges, d_edges = edges_of(nodes), edges_of(d_nodes)
    residual = (
        d_chain.weight[:, None] * free
        + d_chain.pins.T @ (chain.pins @ free)
        + chain.pins.T @ (d_chain.pins @ free)
        + spread_bends(d_chain.bending[:, None] * bends_of(nodes) + chain.bending[:, None] * bends_of(d_nodes))
        - d_force
        + _spread(tension[:, None] * d_edges)
    )
    violation = jnp.sum(edges * d_edges, axis=1) - chain.edge * d_chain.edge - d_chain.compliance * tension
    step, change = _solve(*_inverses(chain, _matrix(chain), edges, tension), edges, residual, violation)
    return solution, Solution(step, change, jnp.zeros_like(solution.error))


def _size(unit, step, change):
    return jnp.sqrt(jnp.sum(step**2) + unit**2 * jnp.sum(change**2)) + 1e-30


def _longest(step: Float[Array, "f 3"]) -> Float[Array, ""]:
    return jnp.sqrt(jnp.max(jnp.sum(step**2, axis=1)))


def _residuals(chain, force, held, free, tension):
    """Edges, what the forces lack of balance, and by how much edges are too long."""
    nodes = with_held(free, held)
    edges = edges_of(nodes)
    violation = 0.5 * (jnp.sum(edges**2, axis=1) - chain.edge**2) - chain.compliance * tension
    return edges, _balance(chain, nodes, tension, edges) - force, violation


def _balance(chain, nodes, tension, edges):
    """A0 x + D' (lambda o D x)."""
    bent = spread_bends(chain.bending[:, None] * bends_of(nodes))
    pulled = chain.pins.T @ (chain.pins @ nodes[2:-2])
    return chain.weight[:, None] * nodes[2:-2] + bent + pulled + _spread(tension[:, None] * edges)


def _matrix(chain):
    """A0 between free nodes."""
    free = chain.weight.shape[0]
    eye = jnp.eye(free, dtype=chain.weight.dtype)
    second = jnp.zeros((free + 2, free)).at[:-2].add(eye).at[1:-1].add(-2.0 * eye).at[2:].add(eye)
    return jnp.diag(chain.weight) + chain.pins.T @ chain.pins + second.T @ (chain.bending[:, None] * second)


def _inverses(chain, stiffness, edges, tension):
    """A^-1, D A^-1 and S^-1: inverses, for all tangents share them, and products are faster than many substitutions."""
    # D' diag(lambda) D of a chain: tridiagonal
    off = -tension[1:-1]
    inverse = jnp.linalg.inv(stiffness + jnp.diag(tension[:-1] + tension[1:]) + jnp.diag(off, 1) + jnp.diag(off, -1))
    rows = _pad_difference(inverse)
    across = _pad_difference(rows.T)
    schur = (edges @ edges.T) * across + chain.compliance * jnp.eye(edges.shape[0], dtype=edges.dtype)
    return inverse, rows, jnp.linalg.inv(schur)


def _pad_difference(x):
    """D of what is zero at the held nodes, along the first axis."""
    zero = jnp.zeros_like(x[:1])
    return jnp.concatenate([x, zero]) - jnp.concatenate([zero, x])


def _solve(inverse, rows, schur_inverse, edges, residual, violation):
    """One Newton step of nodes and tensions."""
    free_step = inverse @ residual
    change = schur_inverse @ (violation - jnp.sum(edges * _pad_difference(free_step), axis=1))
    return -(free_step + rows.T @ (change[:, None] * edges)), change
