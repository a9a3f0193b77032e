"""Gymnasium's environment `cablejax/ShapeCable-v0`, its vector form, and the same for learners written in JAX.

Importing this package registers the first two.
"""

try:
    import gymnasium
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("cablejax.environment needs Gymnasium: pip install 'cablejax[rl]'.") from error

from cablejax.environment.config import ShapeCableConfig
from cablejax.environment.mjx_env import MjxShapeCable
from cablejax.environment.policy import LinkPolicy
from cablejax.environment.shape_cable import ShapeCableEnv, ShapeCableVectorEnv

__all__ = ["ENVIRONMENT", "LinkPolicy", "MjxShapeCable", "ShapeCableConfig", "ShapeCableEnv", "ShapeCableVectorEnv"]

ENVIRONMENT = "cablejax/ShapeCable-v0"
"""Name of the environment for `gymnasium.make` and `gymnasium.make_vec`."""

if ENVIRONMENT not in gymnasium.registry:
    gymnasium.register(
        ENVIRONMENT,
        entry_point=f"{__name__}.shape_cable:ShapeCableEnv",
        vector_entry_point=f"{__name__}.shape_cable:ShapeCableVectorEnv",
    )
