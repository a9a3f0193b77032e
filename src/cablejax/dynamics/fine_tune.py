"""Starts a training from an existing model instead of from random weights."""

from __future__ import annotations

import dataclasses
import os

import jax.numpy as jnp
from flax import nnx

from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.weights import load_weights


def starting_from(source: str | os.PathLike[str], config: ModelConfig) -> tuple[ModelConfig, nnx.State]:
    """The weights of a trained model for `train(..., initial=...)` of a model that may in addition be conditioned.

    A conditioned model starts as if it did not listen: the weights of what is known of the cable are zero.

    Args:
        source: see `load_weights`.
        config: what is to be trained; its normalisation does not matter.

    Returns:
        `config` with the scales of the trained model, and the weights.

    Raises:
        WeightsError: no such model.
        ValueError: it differs from `config` in more than being conditioned.
    """
    trained, _, weights = load_weights(source)
    config = dataclasses.replace(config, normalisation=trained.normalisation)
    if config == trained:
        return config, weights
    if dataclasses.replace(config, conditioned=False) != trained:
        other = [
            f"{field.name} is {getattr(trained, field.name)!r} there and {getattr(config, field.name)!r} here"
            for field in dataclasses.fields(config)
            if getattr(trained, field.name) != getattr(config, field.name)
        ]
        raise ValueError(
            f"The model to start from differs: {'; '.join(other)}. Only `conditioned` may differ. Train with the "
            "settings of that model."
        )
    encoder = ("node_encoder", "first", 0, "kernel")
    flat = dict(nnx.to_flat_state(weights))
    kernel = flat[encoder].get_value()
    deaf = jnp.zeros((config.node_features - trained.node_features, kernel.shape[1]), kernel.dtype)
    flat[encoder] = flat[encoder].replace(jnp.concatenate([kernel, deaf]))
    return config, nnx.from_flat_state(flat.items())
