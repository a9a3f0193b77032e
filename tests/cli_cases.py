"""A network small enough for tests of the command line. Untrained, it does what its prior does."""

import pathlib

from flax import nnx

from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.gns import GNS
from cablejax.dynamics.weights import FILE_NAME, save_weights


def small_model(folder: pathlib.Path) -> pathlib.Path:
    """Writes the weights file of a small network into a folder, as `cablejax train` would, and returns the folder."""
    config = ModelConfig(latent=8, hidden=8, hidden_layers=1, message_passing=1, prior="rigid")
    folder.mkdir(parents=True, exist_ok=True)
    save_weights(folder / FILE_NAME, config, nnx.split(GNS(config, nnx.Rngs(0)))[1], {"source": "test"})
    return folder
