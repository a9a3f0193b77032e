"""An elastic chain whose edges keep their length: one linear system in the nodes, one constraint per edge.

Finds the free nodes X [m] and the tensions lambda of

    A0 x + D' (lambda o D x) = b,        (|D x|^2 - h^2) / 2 = eps lambda,

where x are all nodes with the four held ones among them. Since A0 is the same for x, y and z, and a squared length has
the unit matrix for a Hessian, Newton's method on (X, lambda) is exact with matrices of nodes by nodes only,

    A = A0 + D' diag(lambda) D,    S = (D x)(D x)' o (D A^-1 D') + eps,

instead of three times as many rows (the Schur complement of Goldenthal et al., Efficient simulation of inextensible
cloth, 2007, with the geometric stiffness of Tournier et al., Stable constrained dynamics, 2015). A little compliance
`eps` keeps the system regular where the clamps are further apart than the cable is long.

Derivatives are those of the solution, by the implicit function theorem, in forward mode.
"""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Up to so many iterations the guess is taken to be near the solution.
_NEAR = 4


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
        pins: P, rows that tie free nodes to what was observed, shape [m, f]; none in a time step.
    """

    weight: Float[Array | np.ndarray, "f"]
    bending: Float[Array | np.ndarray, "J"]
    edge: Float[Array | np.ndarray, ""]
    compliance: Float[Array | np.ndarray, ""]
    pins: Float[Array | np.ndarray, "m f"]


def with_held(free: Float[Array, "f 3"], held: Float[Array, "4 3"]) -> Float[Array, "n 3"]:
    """All nodes: two held ones, the free ones, two held ones."""
    return jnp.concatenate([held[:2], free, held[2:]])


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def constrained(
    iterations: int,
    chain: ElasticChain,
    force: Float[Array, "f 3"],
    held: Float[Array, "4 3"],
    free: Float[Array, "f 3"],
    tension: Float[Array, "e"],
) -> tuple[Float[Array, "f 3"], Float[Array, "e"]]:
    """Newton's method from `free` and `tension`; returns both at the solution.

    Args:
        iterations: of Newton's method.
        chain: A0, h and eps.
        force: b.
        held: the first two and the last two nodes [m].
        free: first guess of the free nodes [m]; no derivative passes through it.
        tension: first guess of lambda; no derivative passes through it.
    """
    stiffness = _matrix(chain)

    def newton(_, state):
        free, tension = state
        nodes = with_held(free, held)
        edges = edges_of(nodes)
        residual = _balance(chain, nodes, tension, edges) - force
        violation = 0.5 * (jnp.sum(edges**2, axis=1) - chain.edge**2) - chain.compliance * tension
        # compression would make the matrix indefinite far from the solution, where it is pushed into a wrong fold
        held_up = jnp.maximum(tension, 0.0) if iterations > _NEAR else tension
        step, change = _solve(*_inverses(chain, stiffness, edges, held_up), edges, residual, violation)
        # far guesses are walked to, not jumped to: an edge must not turn over in one step
        size = jnp.sqrt(jnp.max(jnp.sum(step**2, axis=1)) + 1e-30)
        return free + step * jnp.minimum(1.0, 0.7 * chain.edge / size), tension + change

    return jax.lax.fori_loop(0, iterations, newton, (free, tension))


@constrained.defjvp
def _constrained_jvp(iterations, primals, tangents):
    chain, _, held, *_ = primals
    d_chain, d_force, d_held, *_ = tangents
    free, tension = constrained(iterations, *primals)
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
    return (free, tension), (step, change)


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
