"""The fully connected network that every model is built from."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from cablejax.dynamics.config import ModelConfig


class MLP(nnx.Module):
    """ReLU network whose first layer takes the sum of several inputs, each with a weight matrix of its own.

    That sum is the same as one matrix on the inputs' concatenation; written apart, an input that many rows share can
    be multiplied before it is copied to them.

    Attributes:
        corner: half the width of the activations' rounded corners, see `rectified`.
    """

    corner: float = 0.0

    def __init__(self, inputs: tuple[int, ...], output: int, config: ModelConfig, *, normalise: bool, rngs: nnx.Rngs):
        share = nnx.initializers.variance_scaling(1.0 / len(inputs), "fan_in", "truncated_normal")
        self.first = nnx.List(
            [nnx.Linear(n, config.hidden, use_bias=i == 0, kernel_init=share, rngs=rngs) for i, n in enumerate(inputs)]
        )
        sizes = [config.hidden] * config.hidden_layers + [output]
        self.rest = nnx.List([nnx.Linear(a, b, rngs=rngs) for a, b in itertools.pairwise(sizes)])
        if not normalise:
            # The decoder starts at zero: an untrained model is its prior.
            self.rest[-1].kernel.set_value(jnp.zeros_like(self.rest[-1].kernel.get_value()))
        self.norm = nnx.LayerNorm(output, epsilon=1e-5, rngs=rngs) if normalise else None

    def after_first(self, x: Float[Array, "rows hidden"]) -> Float[Array, "rows output"]:
        """The network from the first layer's sum on."""
        for layer in self.rest:
            x = layer(rectified(x, self.corner))
        return x if self.norm is None else self.norm(x)

    def __call__(self, *inputs: Float[Array, "rows _"]) -> Float[Array, "rows output"]:
        """Applies the layers to the concatenation of the inputs, without concatenating them."""
        first = sum(layer(x) for layer, x in zip(self.first[1:], inputs[1:], strict=True))
        return self.after_first(self.first[0](inputs[0]) + first)


def rectified(x: Float[Array, "*shape"], corner: float) -> Float[Array, "*shape"]:
    """`max(x, 0)`, its corner rounded between -c and c by `(x + c)^3 (3 c - x) / 16 c^3`: twice differentiable.

    It is at most 3 c / 16 above `max(x, 0)`, at 0, and the same beyond the corner.
    """
    if corner == 0:
        return jax.nn.relu(x)
    inside = jnp.clip(x, -corner, corner)
    return jnp.where(x > corner, x, (inside + corner) ** 3 * (3 * corner - inside) / (16 * corner**3))
