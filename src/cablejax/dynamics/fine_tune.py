"""Starts a training from an existing model instead of from random weights."""

from __future__ import annotations

import dataclasses
import os

import jax.numpy as jnp
from flax import nnx

from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.weights import load_weights


def starting_from(source: str | os.PathLike[str], config: ModelConfig) -> tuple[ModelConfig, nnx.State]:
    """The weights of a trained model, for `train(..., initial=...)` of a model that is at least as general.

    At first the new model predicts what the trained one does. It may in addition be conditioned: the weights of the
    cable's inputs start at zero. It need not be symmetric, so that it can learn an end or a side of the cable.

    Args:
        source: see `load_weights`.
        config: what is to be trained; its normalisation does not matter.

    Returns:
        `config` with the scales of the trained model, and the weights.

    Raises:
        WeightsError: no such model.
        ValueError: it differs from `config` in more than that.
    """
    trained, _, weights = load_weights(source)
    config = dataclasses.replace(config, normalisation=trained.normalisation)
    same = dataclasses.replace(config, conditioned=trained.conditioned, symmetric=trained.symmetric)
    if same != trained or trained.conditioned > config.conditioned or config.symmetric > trained.symmetric:
        pairs = [(f.name, getattr(trained, f.name), getattr(config, f.name)) for f in dataclasses.fields(config)]
        other = [
            f"{name} is {_short(there)} in that model and {_short(here)} here"
            for name, there, here in pairs
            if there != here
        ]
        raise ValueError(
            f"The model to start from has other settings: {'; '.join(other)}. Only adding `conditioned` and dropping "
            "`symmetric` are allowed. Train with the settings of that model."
        )
    flat = dict(nnx.to_flat_state(weights))
    kernel, bias = (flat["node_encoder", "first", 0, name] for name in ("kernel", "bias"))
    rows = kernel.get_value()
    # a symmetric model counts the arc length, which follows the positions and displacements, from the middle
    shift = 0.5 * (trained.symmetric - config.symmetric) * rows[2 * config.history]
    deaf = jnp.zeros((config.node_features - trained.node_features, rows.shape[1]), rows.dtype)
    flat["node_encoder", "first", 0, "kernel"] = kernel.replace(jnp.concatenate([rows, deaf]))
    flat["node_encoder", "first", 0, "bias"] = bias.replace(bias.get_value() - shift)
    return config, nnx.from_flat_state(flat.items())


def _short(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else repr(value)
