"""The simulators of a cable: MJX, threaded C MuJoCo, and the plants."""

from cablejax.simulate.compile import compiler_options
from cablejax.simulate.engine import Engine
from cablejax.simulate.mjx_engine import MjxEngine
from cablejax.simulate.threaded_engine import ThreadedEngine

__all__ = ["Engine", "MjxEngine", "ThreadedEngine", "compiler_options"]
