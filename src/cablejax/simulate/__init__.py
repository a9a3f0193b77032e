"""The cable as a MuJoCo composite, in three engines: MJX, threaded C MuJoCo, and the plant."""

from cablejax.simulate.compile import compiler_options
from cablejax.simulate.config import CableConfig
from cablejax.simulate.engine import Engine
from cablejax.simulate.mjx_engine import MjxEngine
from cablejax.simulate.threaded_engine import ThreadedEngine

__all__ = ["CableConfig", "Engine", "MjxEngine", "ThreadedEngine", "compiler_options"]
