"""Multiplies a network's slopes in bfloat16: the same values, and a Jacobian accurate to about a thousandth.

Most of a control call is the Jacobian of the network, and most of that are products of cotangents with weights.
Processors that multiply bfloat16 in hardware do these several times faster. A planner that accepts a step by the exact
objective does not mind: a slope that is a little off costs it a little of the step.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from cablejax.dynamics.networks import GNS


@jax.custom_vjp
def product(x: Float[Array, "*rows inputs"], kernel: Float[Array, "inputs outputs"]) -> Float[Array, "*rows outputs"]:
    """`x @ kernel`, with a rounded derivative by x.

    In float32, reverse mode rounds the factors of that derivative to bfloat16 and sums in float32. In any other
    precision it is exact, and so is the derivative by the kernel. There is no derivative in forward mode.
    """
    return x @ kernel


def _forward(x, kernel):
    return x @ kernel, (x, kernel)


def _backward(kept, cotangent):
    x, kernel = kept
    of_kernel = x.reshape(-1, x.shape[-1]).T @ cotangent.reshape(-1, cotangent.shape[-1])
    if cotangent.dtype != jnp.float32:
        return cotangent @ kernel.T, of_kernel
    low, transposed = cotangent.astype(jnp.bfloat16), kernel.T.astype(jnp.bfloat16)
    return jnp.matmul(low, transposed, preferred_element_type=jnp.float32), of_kernel


product.defvjp(_forward, _backward)


def _of_linear_layer(x, kernel, dimension_numbers, **options):
    """`product` as `nnx.Linear` calls it, which contracts the last axis of x with the first of the kernel."""
    del dimension_numbers, options
    return product(x, kernel)


def with_bfloat16_slopes(network: GNS) -> GNS:
    """The network, changed in place so that all its linear layers have rough slopes by their input."""
    for _, module in nnx.iter_graph(network):
        if isinstance(module, nnx.Linear):
            module.dot_general = _of_linear_layer
    return network
