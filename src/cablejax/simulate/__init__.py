"""The simulators of a cable: the closed-form chain, MJX, threaded C MuJoCo, and the plants."""

from collections.abc import Mapping, Sequence

from cablejax.effects.given import GivenEffect, check_hooks
from cablejax.simulate.chain.engine import ChainEngine
from cablejax.simulate.compile import compiler_options
from cablejax.simulate.engine import Engine
from cablejax.simulate.mjx_engine import MjxEngine
from cablejax.simulate.threaded_engine import ThreadedEngine

ENGINES: Mapping[str, type[Engine]] = {engine.name: engine for engine in (ThreadedEngine, MjxEngine, ChainEngine)}
"""The engines that make data, by the names of configurations."""


def check_effects(effects: Sequence[GivenEffect], engine: str) -> None:
    """Raises `ValueError` if an engine cannot simulate an effect; the message names both, and the engines that can."""
    check_hooks(effects, ENGINES[engine].hooks, engine, {name: other.hooks for name, other in ENGINES.items()})


__all__ = ["ENGINES", "ChainEngine", "Engine", "MjxEngine", "ThreadedEngine", "check_effects", "compiler_options"]
